"""How the figures look: one size, one set of colours, and helpers for labels beside the lines.

Every figure is one narrow panel: the page sets them side by side on a screen or on paper and one
below the other on a phone, where their letters stay readable.
"""

import functools
import io
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

WIDTH_IN = 4.8
DPI = 200

INK, MUTED, GRID = "#1f2328", "#5f6670", "#e3e6ea"
GOAL, GOAL_BAND = "#7d5f00", "#f2cc5c"
"""The goal's letters, and the broad line that the tool should stay on."""
NAMED = {"ik": "#5f6670", "extrapolate": "#a6611a", "preview": "#018571"}
RUNS = ("#0072b2", "#d1480b", "#882255", "#117733", "#332288", "#aa4499")
"""Of Okabe & Ito's and Tol's sets, those that are dark enough for letters on white."""
SEAS = ("#7fb2d9", "#3f8cc4", "#1a5f9c", "#0b2f5c")
"""Calm to rough: one hue that darkens, so that the order shows without colour as well."""

_RC: dict[Any, Any] = {
    "font.size": 9.5,
    "axes.labelsize": 9.5,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "text.color": INK,
    "lines.linewidth": 1.5,
    "savefig.facecolor": "white",
}


def styled(draw: Callable[..., Figure]) -> Callable[..., Figure]:
    """Run a drawing function under this style, and leave matplotlib's settings as they were."""

    @functools.wraps(draw)
    def inner(*args, **kwargs) -> Figure:
        with rc_context(_RC):
            return draw(*args, **kwargs)

    return inner


def panel(title: str, height_in: float = 3.1) -> tuple[Figure, Axes]:
    """A figure of one panel; call it inside a `styled` function."""
    figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
    axes = figure.subplots()
    axes.set_title(title)
    return figure, axes


def png(figure: Figure) -> bytes:
    """The figure as a PNG file."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    return buffer.getvalue()


def colours(labels: Sequence[str]) -> dict[str, str]:
    """A colour for each controller; the same for the named ones in every report."""
    runs = [label for label in labels if label not in NAMED]
    return {label: NAMED.get(label) or RUNS[runs.index(label) % len(RUNS)] for label in labels}


def label_right(
    figure: Figure, axes: Axes, labels: Sequence[tuple[str, str, float]], size: float = 9
) -> None:
    """Write (text, colour, y) at the right edge, moved apart where they would overlap.

    Call it last: it reads the limits of the axes.
    """
    height_pt = figure.get_size_inches()[1] * 72 * 0.75  # of the axes, roughly
    transform = axes.transScale + axes.transLimits
    labels = [label for label in labels if np.isfinite(label[2])]
    at = [float(transform.transform((axes.get_xlim()[0], y))[1]) for _, _, y in labels]
    places = spread(at, 1.15 * size / height_pt)
    for (text, colour, _), place in zip(labels, places, strict=True):
        axes.annotate(
            *(text, (1.0, place)),
            xycoords="axes fraction",
            xytext=(4, 0),
            textcoords="offset points",
            color=colour,
            fontsize=size,
            va="center",
            annotation_clip=False,
        )


def spread(places: Sequence[float], gap: float) -> list[float]:
    """Numbers in the same order at least `gap` apart, moved as little as their groups allow."""
    order = np.argsort(places, kind="stable")
    groups: list[list[float]] = []  # [sum of wanted places of the first member, count]
    for rank, index in enumerate(order):
        groups.append([places[index] - rank * gap, 1])
        # A group that reaches into the one below joins it at their common mean.
        while len(groups) > 1 and groups[-2][0] / groups[-2][1] > groups[-1][0] / groups[-1][1]:
            total, count = groups.pop()
            groups[-1][0] += total
            groups[-1][1] += count
    moved = [total / count for total, count in groups for _ in range(int(count))]
    result = [0.0] * len(places)
    for rank, index in enumerate(order):
        result[index] = moved[rank] + rank * gap
    return result
