"""Error statistics of evaluation episodes, as the paper reports them (table 3)."""

import math
from typing import Any

import numpy as np

from mcx_jax.config.delay import CONTROL_DT_S
from mcx_jax.errors import UserError
from mcx_jax.evaluation.paper import table3

WARM_UP_STEPS = 50
"""The first second of every episode is dropped (paper)."""
LEAST_STEPS = WARM_UP_STEPS + 2
"""Of an episode that is evaluated: a rate needs two of them."""
GROUPS = ("all", "top5", "top1", "max")
"""Improvements: of the mean over all points, the worst 5 %, the worst 1 %, and of the maximum."""


def error_statistics(errors: np.ndarray) -> dict[str, float]:
    """Mean, std, mean of the worst 5 % and 1 %, and maximum over all points.

    Args:
        errors: (steps, episodes) after the warm-up, in the unit to report.
    """
    points = np.sort(errors.ravel().astype(np.float64))[::-1]
    top = lambda share: float(points[: max(1, math.ceil(share * points.size))].mean())  # noqa: E731
    return {
        "mean": float(points.mean()),
        "std": float(points.std()),
        "top5": top(0.05),
        "top1": top(0.01),
        "max": float(points[0]),
    }


def interquartile_mean(values: np.ndarray) -> float:
    """Mean of the middle half, weights at its ends in part (Agarwal et al. 2021, rliable): with one
    to three values their mean, with five the middle one counts 1, its neighbours 3/4 each."""
    ordered = np.sort(np.asarray(values, np.float64).ravel())
    if ordered.size < 4:
        return float(ordered.mean())
    edges = np.arange(ordered.size + 1) / ordered.size
    inside = np.clip(edges[1:], 0.25, 0.75) - np.clip(edges[:-1], 0.25, 0.75)
    return float(ordered @ inside / inside.sum())


def bootstrap_interval(
    values: np.ndarray, share: float = 0.95, draws: int = 10_000, seed: int = 0
) -> tuple[float, float]:
    """Percentile bootstrap interval of the interquartile mean over seeds.

    Args:
        values: (seeds,) or (strata, seeds): every row is resampled by itself, with replacement.
    """
    table = np.atleast_2d(np.asarray(values, np.float64))
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(draws):
        chosen = rng.integers(table.shape[1], size=table.shape)
        found.append(interquartile_mean(np.take_along_axis(table, chosen, axis=1)))
    low, high = np.quantile(found, [0.5 - share / 2, 0.5 + share / 2])
    return float(low), float(high)


def improvement(ours: dict[str, float], baseline: dict[str, float]) -> dict[str, float]:
    """1 - ours / baseline for each of GROUPS."""
    keys = {"all": "mean", "top5": "top5", "top1": "top1", "max": "max"}
    return {group: 1.0 - ours[key] / baseline[key] for group, key in keys.items()}


def row(
    who: str, delay: str, sea: str, pos_m: np.ndarray, ang_rad: np.ndarray, valid: np.ndarray
) -> dict[str, Any]:
    """One result row of the evaluation's JSON (without the improvement).

    Invalid episodes count like the others; only those with a number that is not finite can not
    (they are among `invalid_episodes`).

    Args:
        pos_m, ang_rad: (steps, episodes) errors of whole episodes.
        valid: (episodes,) bool.

    Raises:
        UserError: no episode has finite errors, or their statistics are beyond all numbers.
    """
    finite = finite_episodes(pos_m, ang_rad)
    if not finite.any():
        raise UserError(f"{who}, {delay}, {sea}: every episode diverged: nothing to report")
    with np.errstate(over="ignore", invalid="ignore"):  # refused below
        mm, mrad = (error_statistics(1e3 * x[WARM_UP_STEPS:, finite]) for x in (pos_m, ang_rad))
    if not np.isfinite([*mm.values(), *mrad.values()]).all():
        raise UserError(f"{who}, {delay}, {sea}: errors beyond all numbers: nothing to report")
    return {
        "who": who,
        "delay": delay,
        "sea": sea,
        "episodes": int(valid.size),
        "invalid_episodes": int((~valid).sum()),
        "pos_mm": mm,
        "ang_mrad": mrad,
    }


def effort(correction: np.ndarray, torque_share: np.ndarray) -> dict[str, Any]:
    """What the tracking costs, over all points after the warm-up that are finite.

    Args:
        correction: (steps, 6, episodes), cm and crad.
        torque_share: (steps, episodes) of the joint nearest its torque limit, 1 = at it.

    Raises:
        UserError: there is no such point.
    """
    shift, turn = correction[WARM_UP_STEPS:, :3], correction[WARM_UP_STEPS:, 3:]
    share = torque_share[WARM_UP_STEPS:]
    changes = [np.linalg.norm(np.diff(x, axis=0), axis=1) for x in (shift, turn)]
    # A clipped number is finite or NaN.
    for name, x in (("correction", changes[0]), ("correction", changes[1]), ("torque", share)):
        if np.isnan(x).all():
            raise UserError(f"no {name} in any episode is a finite number: nothing to report")
    return {
        "correction": {
            "max_cm": float(np.nanmax(np.abs(shift))),
            "max_crad": float(np.nanmax(np.abs(turn))),
            "rate_cm_s": float(np.nanmean(changes[0]) / CONTROL_DT_S),
            "rate_crad_s": float(np.nanmean(changes[1]) / CONTROL_DT_S),
        },
        "torque_share": {
            "mean": float(np.nanmean(share)),
            "at_limit": float(np.mean(share[np.isfinite(share)] > 1.0 - 1e-6)),
        },
    }


def strain(found: np.ndarray) -> dict[str, Any]:
    """How many control steps after the warm-up asked the arm for what it cannot do.

    Args:
        found: (steps, 2, episodes) bool: goal out of reach, a joint too fast.
    """
    out_of_reach, too_fast = found[WARM_UP_STEPS:].sum(axis=(0, 2))
    return {
        "strain": {
            "steps": int(found[WARM_UP_STEPS:, 0].size),
            "out_of_reach": int(out_of_reach),
            "too_fast": int(too_fast),
        }
    }


def finite_episodes(pos_m: np.ndarray, ang_rad: np.ndarray) -> np.ndarray:
    """(episodes,) bool: which of (steps, episodes) have no number that is not finite."""
    return np.asarray(np.isfinite(pos_m).all(axis=0) & np.isfinite(ang_rad).all(axis=0))


def add_improvement(rows: list[dict[str, Any]], baseline: list[dict[str, Any]]) -> None:
    """Add to each row its improvement over the baseline's row of the same sea."""
    by_sea = {b["sea"]: b for b in baseline}
    for r in rows:
        base = by_sea[r["sea"]]
        r["improvement"] = {
            "pos": improvement(r["pos_mm"], base["pos_mm"]),
            "ang": improvement(r["ang_mrad"], base["ang_mrad"]),
        }


def paper_errors(who: str, delay: str, sea: str) -> tuple[float, float] | None:
    """The paper's mean (mm, mrad) for a cell: its agents, or the baseline it implies for `ik`."""
    cell = table3().get((delay, sea))
    if cell is None:
        return None
    if who == "ik":
        return cell["ik_pos_mm_implied"], cell["ik_ang_mrad_implied"]
    return cell["pos_mm_mean"], cell["ang_mrad_mean"]


def paper_means(who: str, delay: str, sea: str) -> tuple[float, float] | None:
    """`paper_errors`; for the sea `all` the mean over the paper's four."""
    seas = [s for d, s in table3() if d == delay and sea in ("all", s)]
    cells = [cell for s in seas if (cell := paper_errors(who, delay, s))]
    if not cells:
        return None
    return sum(mm for mm, _ in cells) / len(cells), sum(mrad for _, mrad in cells) / len(cells)
