"""Table 3 of the paper with our figures beside it, as HTML."""

from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from mcx_jax.paper import table3
from mcx_jax.report.noise import Sweep
from mcx_jax.results import GROUPS

_GROUPS = ("all", "worst 5 %", "worst 1 %", "max")
_UNITS = (("pos", "pos_mm", "dp, mm"), ("ang", "ang_mrad", "da, mrad"))


def table(rows: dict[str, list[dict[str, Any]]], papers_world: bool) -> str:
    """The table.

    Args:
        rows: label -> result rows of `evaluate`, one a sea, the same seas for everyone.
        papers_world: the paper's figures belong beside them.
    """
    body = []
    for i, first in enumerate(next(iter(rows.values()))):
        delay, sea = first["delay"], first["sea"]
        published = table3().get((delay, sea)) if papers_world else None
        block = []
        for label, part in rows.items():
            block.append(_line(label, "", [_ours(part[i], *unit) for unit in _UNITS]))
            if label == "ik" and published:
                implied = [
                    [f"{published[f'ik_{key}_implied']:.2f}", *_dashes()] for _, key, _ in _UNITS
                ]
                block.append(_line("paper’s ik, implied", "paper", implied))
        if published:
            agents = [_papers(published, *unit) for unit in _UNITS]
            block.append(_line("paper’s agents", "paper", agents))
        heading = f'<th scope="rowgroup" rowspan="{len(block)}">{escape(sea)}</th>'
        block[0] = block[0].replace("<tr>", f"<tr>{heading}", 1)  # ik's own row has no class
        body.append(f"<tbody>{''.join(block)}</tbody>")
    return (
        '<div class="wide"><table><thead>'
        + '<tr><th rowspan="3">sea</th><th rowspan="3">controller</th>'
        + "".join(f'<th colspan="5" class="part">{name}</th>' for _, _, name in _UNITS)
        + "</tr><tr>"
        + '<th rowspan="2" class="part">mean ± std</th><th colspan="4">below ik by, %</th>' * 2
        + "</tr><tr>"
        + "".join(f"<th>{name}</th>" for name in _GROUPS) * 2
        + f"</tr></thead>{''.join(body)}</table></div>"
    )


def noise_table(sweeps: Sequence[Sweep]) -> str:
    """Mean errors of every controller at every level of noise."""
    levels = sweeps[0].levels
    body = [
        _line(s.label, "", [[_number(x) for x in values] for values in (s.pos_mm, s.ang_mrad)])
        for s in sweeps
    ]
    heads = "".join(
        f'<th class="part">{levels[0]:g}</th>' + "".join(f"<th>{x:g}</th>" for x in levels[1:])
        for _ in _UNITS
    )
    parts = "".join(
        f'<th colspan="{len(levels)}" class="part">{name}, at a noise of … mm and mrad</th>'
        for _, _, name in _UNITS
    )
    return (
        f'<div class="wide"><table><thead><tr><th rowspan="2">controller</th>{parts}</tr>'
        f"<tr>{heads}</tr></thead><tbody>{''.join(body)}</tbody></table></div>"
    )


def _number(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else "diverged"


def _line(label: str, kind: str, units: Sequence[Sequence[str]]) -> str:
    cells = "".join(
        f'<td class="part">{first}</td>' + "".join(f"<td>{cell}</td>" for cell in rest)
        for first, *rest in units
    )
    attribute = f' class="{kind}"' if kind else ""
    return f'<tr{attribute}><th scope="row">{escape(label)}</th>{cells}</tr>'


def _ours(row: dict[str, Any], short: str, key: str, _: str) -> list[str]:
    mean = f"{row[key]['mean']:.2f} ± {row[key]['std']:.2f}"
    if row["who"] == "ik":
        return [mean, *_dashes()]
    return [mean, *(f"{100 * row['improvement'][short][group]:.0f}" for group in GROUPS)]


def _papers(cell: dict[str, float], short: str, key: str, _: str) -> list[str]:
    mean = f"{cell[f'{key}_mean']:.2f} ± {cell[f'{key}_std']:.2f}"
    return [mean, *(f"{100 * cell[f'{short}_imp_{group}']:.0f}" for group in GROUPS)]


def _dashes() -> list[str]:
    return ["–"] * len(GROUPS)
