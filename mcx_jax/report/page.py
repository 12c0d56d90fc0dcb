"""The HTML page: one file, pictures and style inside, nothing fetched."""

import re
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from mcx_jax.errors import printable
from mcx_jax.report.sections import Section
from mcx_jax.report.style import css_colours, svg

STYLE = Path(__file__).with_name("page.css")
CODE = ("command", "task", "motion")
"""Facts that are code."""
MADE = "How it was made"
"""Title of the last section."""


def page(
    title: str,
    subtitle: str,
    lead: Sequence[str],
    sections: Sequence[Section],
    facts: Mapping[str, str],
) -> str:
    """The page as text.

    Args:
        lead: sentences that say the result.
        facts: how the numbers were made.
    """
    style = css_colours() + STYLE.read_text(encoding="utf-8")
    head = (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{_text(title)}</title><style>{style}</style></head>"
    )
    body = [f'<header><h1>{_text(title)}</h1><p class="sub">{_text(subtitle)}</p>']
    if lead:
        sentences = "".join(f"<p>{_text(sentence)}</p>" for sentence in lead)
        body.append(f'<div class="lead">{sentences}</div>')
    body.append(f"</header>{_contents([s.title for s in sections] + [MADE])}<main>")
    body += [_section(section) for section in sections]
    items = "".join(f"<dt>{_text(k)}</dt><dd>{_value(k, v)}</dd>" for k, v in facts.items())
    body.append(f"<section>{_heading(MADE)}<dl>{items}</dl></section></main>")
    return f"{head}\n<body>{chr(10).join(body)}</body></html>\n"


def _contents(titles: Sequence[str]) -> str:
    items = "".join(f'<li><a href="#{_anchor(title)}">{_text(title)}</a></li>' for title in titles)
    return f'<nav aria-label="Contents"><ul>{items}</ul></nav>'


def _heading(title: str) -> str:
    return f'<h2 id="{_anchor(title)}">{_text(title)}</h2>'


def _anchor(title: str) -> str:
    return re.sub(r"\W+", "-", title.lower()).strip("-")


def _section(section: Section) -> str:
    images = "".join(svg(panel.figure, panel.name, panel.alt) for panel in section.panels)
    panels = f'<div class="panels">{images}</div>' if images else ""
    return (
        f"<section>{_heading(section.title)}<figure>{section.table}{panels}"
        f"<figcaption>{_text(section.caption)}</figcaption></figure></section>"
    )


def _value(name: str, text: str) -> str:
    return f"<code>{_text(text)}</code>" if name in CODE else _text(text)


def _text(text: str) -> str:
    """Any text as HTML: a path may hold bytes of no encoding."""
    return escape(printable(text))
