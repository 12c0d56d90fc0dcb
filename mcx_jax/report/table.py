"""Table 3 of the paper with our figures beside it, as HTML."""

from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

import numpy as np

from mcx_jax.evaluation.paper import table3
from mcx_jax.evaluation.statistics import GROUPS
from mcx_jax.report.noise import Sweep

_GROUPS = ("all", "5 %", "1 %", "max")
"""The mean of all points, of the worst 5 % and 1 %, and the maximum."""
_UNITS = (
    ("pos", "pos_mm", "Position error dp, mm"),
    ("ang", "ang_mrad", "Orientation error da, mrad"),
)


def table(rows: dict[str, list[dict[str, Any]]], papers_world: bool) -> str:
    """Two tables, one for each error, which stand side by side where there is room.

    Args:
        rows: label -> result rows of `evaluate`, one a sea, the same seas for everyone.
        papers_world: the paper's figures belong beside them.
    """
    heads = (
        '<tr><th rowspan="2">controller</th><th rowspan="2">mean ± std</th>'
        + f'<th colspan="{len(_GROUPS)}">below ik by, %</th></tr><tr>'
        + "".join(f"<th>{name}</th>" for name in _GROUPS)
        + "</tr>"
    )
    seas = range(len(next(iter(rows.values()))))
    return _side_by_side(
        (name, heads, "".join(_sea(rows, i, short, key, papers_world) for i in seas))
        for short, key, name in _UNITS
    )


def _sea(rows: dict[str, list[dict[str, Any]]], i: int, short: str, key: str, papers: bool) -> str:
    """One sea's lines of one error."""
    first = next(iter(rows.values()))[i]
    published = table3().get((first["delay"], first["sea"])) if papers else None
    lines = [_heading(first["sea"], 2 + len(_GROUPS))]
    for label, part in rows.items():
        lines.append(_line(label, "", _ours(part[i], short, key)))
        if label == "ik" and published:
            implied = [f"{published[f'ik_{key}_implied']:.2f}", *_dashes()]
            lines.append(_line("paper’s ik, implied", "paper", implied))
    if published:
        lines.append(_line("paper’s agents", "paper", _papers(published, short, key)))
    return f"<tbody>{''.join(lines)}</tbody>"


def noise_table(sweeps: Sequence[Sweep]) -> str:
    """Mean errors of every controller at every level of noise."""
    levels = sweeps[0].levels
    heads = (
        '<tr><th rowspan="2">controller</th>'
        f'<th colspan="{len(levels)}">mean, at a noise of … mm and mrad</th></tr>'
        f"<tr>{''.join(f'<th>{x:g}</th>' for x in levels)}</tr>"
    )
    parts = []
    for _, key, name in _UNITS:
        body = [_line(s.label, "", [_number(x) for x in getattr(s, key)]) for s in sweeps]
        parts.append((name, heads, f"<tbody>{''.join(body)}</tbody>"))
    return _side_by_side(parts)


def _side_by_side(parts: Iterable[tuple[str, str, str]]) -> str:
    """Tables of (caption, rows of the head, bodies)."""
    return (
        '<div class="tables">'
        + "".join(
            f"<table><caption>{name}</caption><thead>{heads}</thead>{body}</table>"
            for name, heads, body in parts
        )
        + "</div>"
    )


def _number(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else "diverged"


def _heading(text: str, columns: int) -> str:
    return f'<tr><th scope="rowgroup" colspan="{columns}">{escape(text)}</th></tr>'


def _line(label: str, kind: str, cells: Sequence[str]) -> str:
    attribute = f' class="{kind}"' if kind else ""
    values = "".join(f"<td>{cell}</td>" for cell in cells)
    return f'<tr{attribute}><th scope="row">{escape(label)}</th>{values}</tr>'


def _ours(row: dict[str, Any], short: str, key: str) -> list[str]:
    mean = f"{row[key]['mean']:.2f} ± {row[key]['std']:.2f}"
    if row["who"] == "ik":
        return [mean, *_dashes()]
    return [mean, *(_percent(row["improvement"][short][group]) for group in GROUPS)]


def _papers(cell: dict[str, float], short: str, key: str) -> list[str]:
    mean = f"{cell[f'{key}_mean']:.2f} ± {cell[f'{key}_std']:.2f}"
    return [mean, *(_percent(cell[f"{short}_imp_{group}"]) for group in GROUPS)]


def _percent(share: float) -> str:
    """A whole number, and never -0."""
    return f"{round(100 * share):d}"


def _dashes() -> list[str]:
    return ["–"] * len(GROUPS)
