"""Steps per second against the number of environments, all engines, log-log."""

from pathlib import Path
from typing import Any

from mcx_jax.palette import ENGINES, LIGHT

STYLES = {
    "chain": ("mcx_jax chain engine", "o", 0),
    "c-batch": ("C MuJoCo, mujoco.batch", "s", 4),
    "c-rollout": ("C MuJoCo, mujoco.rollout", "^", -6),
    "mjx": ("MuJoCo MJX", "D", 0),
}
"""Label, marker, and how far up the label is moved (points; the C engines lie close)."""


def draw(figures: dict[str, Any], path: Path) -> None:
    """Draw the physics rows of a bench result (matplotlib: extra `viz`)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4.6), layout="constrained")
    axes = figure.subplots()
    for engine, (label, marker, lift) in STYLES.items():
        colour = LIGHT[ENGINES[engine]]
        rows = [row for row in figures["physics"] if row["engine"] == engine]
        envs, speed = [r["envs"] for r in rows], [r["steps_per_s"] for r in rows]
        axes.loglog(envs, speed, color=colour, marker=marker, ms=5, lw=1.8)
        axes.annotate(
            label,
            (envs[-1], speed[-1]),
            xytext=(8, lift),
            textcoords="offset points",
            color=colour,
            va="center",
            fontsize=9,
        )
    axes.set_xlabel("environments at once")
    axes.set_ylabel("physics steps of 2 ms, per second")
    axes.set_title("UR10e physics: " + figures["device"], fontsize=10, loc="left")
    axes.grid(True, which="major", color="0.88")
    axes.spines[["top", "right"]].set_visible(False)
    largest = max(row["envs"] for row in figures["physics"])
    axes.set_xlim(0.7, 40 * largest)  # room for the labels
    axes.set_xticks([10**k for k in range(6) if 10**k <= largest])
    axes.minorticks_off()
    figure.savefig(path, dpi=150)
