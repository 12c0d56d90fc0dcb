"""Packages that only some commands need: which extra brings them, and the command to type."""

import importlib.util
import sys
from pathlib import Path

from mcx_jax.errors import UserError

EXTRAS = {
    "matplotlib": "viz",
    "viser": "viz",
    "imageio_ffmpeg": "viz",
    "PIL": "viz",
    "tensorboardX": "viz",
    "onnx": "export",
    "gymnasium": "gym",
}
"""{module: extra of pyproject.toml}."""
PACKAGES = {"imageio_ffmpeg": "imageio[ffmpeg]", "PIL": "pillow"}
"""{module: package}, where the names differ."""
ROOT = Path(__file__).resolve().parent.parent
"""Of the source tree, if this is one."""


def require(module: str, what: str) -> None:
    """Refuse, before anything is computed, what a missing package has to do.

    Args:
        what: begins the message, e.g. "--plot".

    Raises:
        UserError: the package is not installed.
    """
    if importlib.util.find_spec(module) is None:
        raise UserError(missing(module, what))


def missing(module: str, what: str) -> str:
    """The message of `require`."""
    return f"{what} needs {PACKAGES.get(module, module)}: {install(EXTRAS[module])}"


def install(extra: str) -> str:
    """The command that installs an extra: in a source tree README's, with the pinned versions."""
    if not (ROOT / "constraints.txt").is_file():
        return f"pip install 'mcx_jax[{extra}]'"
    python = ".venv/bin/python" if Path(sys.prefix).resolve() == ROOT / ".venv" else "python"
    return f"{python} -m pip install -c constraints.txt -e '.[{extra}]'"
