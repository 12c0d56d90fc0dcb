"""The result of `evaluate`, and of `train` at its end, as tables that fit the terminal."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TextIO

from mcx_jax.config.task import EnvConfig, MotionConfig
from mcx_jax.console import terminal
from mcx_jax.controllers.by_name import WHO
from mcx_jax.evaluation.paper import is_papers_world
from mcx_jax.evaluation.statistics import paper_errors

Row = dict[str, Any]
"""One result row of `mcx_jax.evaluation.statistics`; docs/commands.md lists its fields."""

PAPER_NOTE = (
    "paper: table 3's mean error of the paper's trained agents; with ~, for ik, of the baseline "
    "that their improvements imply"
)
ONE_DIRECTION_NOTE = (
    "note: trained agents hold for waves from one direction (heading 170 deg, long-crested); at "
    "other headings they can be worse than no correction: see docs/results.md"
)
"""For whatever shows results of a trained policy."""
REPEAT_NOTE = (
    "note: a maximum repeats to about 2 %, a mean to 0.1 %, when other seas, controllers or "
    "episodes share the call: the servos chatter, which magnifies rounding"
)
EFFORT_NOTE = (
    "shift, turn: largest correction; mm/s, mrad/s: its mean rate; load: mean torque of the most "
    "loaded joint in per cent of its limit; at limit: share of steps that it is at it; each number "
    "is from the sea where it is largest"
)


@dataclass(frozen=True)
class Column:
    """A column of numbers."""

    head: str
    text: Callable[[Row], str]
    """The cell of a row."""


def percent(share: float) -> str:
    """A share as whole per cents; nothing is "0 %", never "-0 %"."""
    return f"{round(100 * share)} %"


def _statistic(part: str, name: str, head: str, digits: int = 2) -> Column:
    return Column(head, lambda r: f"{r[part][name]:.{digits}f}")


def _gain(part: str) -> Column:
    return Column("vs ik", lambda r: percent(r["improvement"][part]["all"]))


def _paper(index: int) -> Column:
    """Table 3's mean, mm (0) or mrad (1)."""

    def text(r: Row) -> str:
        means = paper_errors(r["who"], r["delay"], r["sea"])
        implied = "~" if r["who"] == "ik" else ""
        return f"{implied}{means[index]:.2f}" if means else "-"

    return Column("paper", text)


NAMES = Column("who", lambda r: r["who"]), Column("sea", lambda r: r["sea"])
POSITION = (
    _statistic("pos_mm", "mean", "dp mm", 3),
    _statistic("pos_mm", "std", "std"),
    _statistic("pos_mm", "top5", "top 5%"),
    _statistic("pos_mm", "top1", "top 1%"),
    _statistic("pos_mm", "max", "max"),
    _gain("pos"),
)
ORIENTATION = (
    _statistic("ang_mrad", "mean", "da mrad", 3),
    _statistic("ang_mrad", "std", "std"),
    _statistic("ang_mrad", "max", "max"),
    _gain("ang"),
)
COUNTS = (Column("invalid", lambda r: f"{r['invalid_episodes']}/{r['episodes']}"),)


def _most(part: str, name: str, factor: float, head: str, digits: int = 0) -> Column:
    """The largest value over the rows of one controller, which are in `seas`."""
    largest = lambda r: max(one[part][name] for one in r["seas"])  # noqa: E731
    return Column(head, lambda r: f"{factor * largest(r):.{digits}f}")


EFFORT = (
    _most("correction", "max_cm", 10, "shift mm", 1),
    _most("correction", "max_crad", 10, "turn mrad", 1),
    _most("correction", "rate_cm_s", 10, "mm/s"),
    _most("correction", "rate_crad_s", 10, "mrad/s"),
    _most("torque_share", "mean", 100, "load %"),
    _most("torque_share", "at_limit", 100, "at limit %", 1),
)


def print_table(
    rows: list[Row], env: EnvConfig, motion: MotionConfig, out: TextIO | None = None
) -> None:
    """Print result rows: the errors in one table or, where that does not fit, in two; what the
    tracking takes; and what has to be known to read them.

    Args:
        rows: with their improvements, of one task.
        env, motion: the task; table 3 stands beside its results where the paper measured them.
        out: default standard output.
    """
    found = any(paper_errors(r["who"], r["delay"], r["sea"]) for r in rows)
    beside = found and is_papers_world(env, motion)
    position, orientation = (
        (*part, _paper(k)) if beside else part for k, part in enumerate((POSITION, ORIENTATION))
    )
    terminal.paragraph(f"tracking error, delay {rows[0]['delay']}", out)
    for made in _fitting(rows, position, (*orientation, *COUNTS), out):
        terminal.show(made, out)
        print(file=out)
    whos = dict.fromkeys(r["who"] for r in rows)
    by_who = [{"who": who, "seas": [r for r in rows if r["who"] == who]} for who in whos]
    terminal.show(_table(by_who, NAMES[:1], EFFORT), out)
    for note in _notes(rows, env, beside):
        terminal.paragraph(note, out)


def _fitting(rows: list[Row], position: tuple, rest: tuple, out: TextIO | None) -> list[Any]:
    """One table if the output is wide enough, otherwise two."""
    whole = _table(rows, NAMES, (*position, *rest))
    if terminal.fits(whole, out):
        return [whole]
    return [_table(rows, NAMES, part) for part in (position, rest)]


def _table(rows: list[Row], names: tuple, numbers: tuple) -> Any:
    shown = (*names, *numbers)
    cells = [[column.text(r) for column in shown] for r in rows]
    return terminal.table([column.head for column in shown], cells, texts=len(names))


def _strains(rows: list[Row]) -> list[str]:
    """Where the arm was asked for what it cannot do: a line a controller and sea."""
    said = []
    for r in rows:
        found = r["strain"]
        share = lambda name: f"in {found[name]} of {found['steps']} control steps"  # noqa: B023, E731
        parts = []
        if found["out_of_reach"]:
            parts.append(f"the corrected goal out of the arm's reach {share('out_of_reach')}")
        if found["too_fast"]:
            parts.append(f"a joint asked to be faster than its servo takes {share('too_fast')}")
        if parts:
            said.append(f"{r['who']}, {r['sea']}: {'; '.join(parts)}")
    return said


def _notes(rows: list[Row], env: EnvConfig, beside: bool) -> list[str]:
    """What the numbers mean and how far they hold."""
    notes = [EFFORT_NOTE, *_strains(rows)]
    if beside:
        notes.append(PAPER_NOTE)
    if env.integrator != "quiet":
        notes.append(REPEAT_NOTE)
    if any(r["who"] not in WHO for r in rows):
        notes.append(ONE_DIRECTION_NOTE)
    return notes
