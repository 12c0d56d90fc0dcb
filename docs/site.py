"""What mkdocs does for this site (`hooks` in mkdocs.yml): the README is one of its pages.

On a forge docs/ links to ../README.md and README.md to docs/; in the site both are pages of it.
"""

import re
from pathlib import Path

from mkdocs.structure.files import File

PAGE = "readme.md"


def on_files(files, config):
    """Add the README."""
    text = Path(config.config_file_path).with_name("README.md").read_text(encoding="utf-8")
    files.append(File.generated(config, PAGE, content=of_the_site(text)))
    return files


def on_page_markdown(markdown, **_):
    """Lead links to the README to its page."""
    return markdown.replace("](../README.md", f"]({PAGE}")


def of_the_site(text):
    """The README with links into docs/ made relative to it; other files are not in the site."""
    elsewhere = re.compile(r"(?<!!)\[([^\]]*)\]\((?!docs/|https?:|#)[^)]*\)")
    return elsewhere.sub(r"\1", text).replace("](docs/", "](")
