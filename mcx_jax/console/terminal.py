"""What the commands write to a terminal, a file or a pipe: tables, paragraphs, signs of life.

Names of runs and files are data: no markup is read in them, and what cannot be printed is escaped.
"""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, TextIO

from mcx_jax.errors import printable

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

PIPED_COLUMNS = 150
"""Width where the output is no terminal: every table of the commands fits."""
SILENT_COLUMNS = 80
"""Width of a terminal that does not say how wide it is."""
FOLDED = 12
"""Width that a name needs at least where it does not fit into one line."""


def silent(what: str) -> None:
    """Say nothing: in place of what `working` yields."""


def columns(out: Any = None) -> int:
    """Width to write for: the variable COLUMNS, else that of the terminal behind `out`."""
    out = sys.stdout if out is None else out
    asked = os.environ.get("COLUMNS", "")
    if asked.isdecimal() and int(asked) > 0:
        return int(asked)
    try:
        return os.get_terminal_size(out.fileno()).columns or SILENT_COLUMNS
    except (AttributeError, OSError, ValueError):  # no stream, no terminal, closed
        return PIPED_COLUMNS


def console(out: TextIO | None = None, width: int | None = None) -> "Console":
    """The one way to rich: it takes what it prints literally.

    Args:
        out: default standard output.
        width: default `columns(out)`.
    """
    from rich.console import Console

    width = columns(out) if width is None else width
    return Console(file=out, width=width, markup=False, emoji=False, highlight=False)


def paragraph(text: str, out: TextIO | None = None) -> None:
    """Print a text, wrapped between words."""
    console(out).print(printable(text), overflow="fold")


def table(head: Sequence[str], rows: Sequence[Sequence[str]], texts: int) -> "Table":
    """A table whose numbers are never cut.

    Args:
        head: names of the columns.
        rows: of cells.
        texts: so many columns at the left are names, which are folded where they do not fit; the
            others are numbers, which keep their width.
    """
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    made = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    for i, name in enumerate(head):
        width = max(len(x) for x in (name, *(row[i] for row in rows)))
        if i < texts:
            made.add_column(name, overflow="fold", min_width=min(width, FOLDED))
        else:
            made.add_column(name, justify="right", no_wrap=True, min_width=width)
    for row in rows:
        made.add_row(*(printable(cell) for cell in row))
    return made


def fits(made: "Table", out: TextIO | None = None) -> bool:
    """Whether nothing of a table has to be folded."""
    return console(out).measure(made).maximum == console(width=10_000).measure(made).maximum


def show(made: "Table", out: TextIO | None = None) -> None:
    """Print a table; a terminal that is narrower than its numbers wraps the lines."""
    least = sum(column.min_width or 0 for column in made.columns) + 2 * len(made.columns)
    console(out, max(columns(out), least)).print(made)


@contextlib.contextmanager
def working(first: str, out: TextIO | None = None) -> Iterator[Callable[[str], None]]:
    """Signs of life of work that takes more than a few seconds.

    Args:
        first: the step that it begins with, named on a terminal alone.
        out: default standard output.

    Yields:
        say(what): names the step that begins. On a terminal it stands beside a spinner and its
        seconds until the next one; elsewhere each is a line.
    """
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    to = console(out)
    if not to.is_interactive:
        yield lambda what: print(what, file=out, flush=True)
        return
    # A process that is killed would leave a hidden cursor behind.
    to.show_cursor = lambda show=True: False
    parts = SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn()
    with Progress(*parts, console=to, transient=True, refresh_per_second=4) as progress:
        task = progress.add_task(first)
        yield lambda what: progress.reset(task, description=what)
