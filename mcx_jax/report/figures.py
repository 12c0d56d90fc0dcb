"""The drawing functions: plain arrays in, one panel out."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter, NullLocator

from mcx_jax.report import style

ROW_IN = 0.19
"""Height of a box's row, inches."""


@dataclass(frozen=True)
class Box:
    """A distribution as one row of a box plot."""

    label: str
    colour: str
    quantiles: np.ndarray
    """(5,) 5 %, 25 %, 50 %, 75 %, 95 %."""
    mean: float
    reference: float | None = None
    """Somebody else's mean."""


@dataclass(frozen=True)
class Line:
    """One curve."""

    label: str
    colour: str
    x: np.ndarray
    y: np.ndarray
    band: tuple[np.ndarray, np.ndarray] | None = None
    """Lowest and highest of several."""


def box(label: str, colour: str, points: np.ndarray, reference: float | None = None) -> Box:
    """The `Box` of all points."""
    quantiles = np.percentile(points, (5, 25, 50, 75, 95))
    return Box(label, colour, quantiles, float(np.mean(points)), reference)


@style.styled
def boxes(
    title: str, groups: Sequence[tuple[str, Sequence[Box]]], xlabel: str, log: bool = True
) -> Figure:
    """Horizontal boxes under a heading each, their means written at the right."""
    count = sum(1 + len(group) for _, group in groups)
    figure, axes = style.panel(title, 0.95 + ROW_IN * count)
    if log:
        axes.set_xscale("log")
    ticks: list[tuple[float, Box]] = []
    y = 0.0
    edge = axes.get_yaxis_transform()
    axes.text(1.015, y, "mean", transform=edge, va="center", color=style.MUTED, fontsize=7.5)
    for heading, group in groups:
        _heading(axes, y, heading)
        for entry in group:
            y += 1.0
            _draw_box(axes, y, entry)
            ticks.append((y, entry))
        y += 1.0
    axes.set_yticks([y for y, _ in ticks], [style.short(b.label) for _, b in ticks], fontsize=8.5)
    for text, (_, b) in zip(axes.get_yticklabels(), ticks, strict=True):
        text.set_color(b.colour)
    axes.set_ylim(y - 0.4, -0.7)
    axes.grid(False, axis="y")
    axes.tick_params(axis="y", length=0)
    axes.set_xlabel(xlabel)
    if log:
        _plain_log(axes.xaxis)
    else:
        axes.set_xlim(left=0.0)
    return figure


def _heading(axes: Axes, y: float, text: str) -> None:
    place = axes.get_yaxis_transform()
    box = {"facecolor": style.PAPER, "edgecolor": "none", "pad": 1.5}  # over the grid
    axes.text(*(0.012, y, text), transform=place, va="center", weight="bold", fontsize=9, bbox=box)


def _draw_box(axes: Axes, y: float, b: Box) -> None:
    q = b.quantiles
    axes.hlines(y, q[0], q[4], color=b.colour, lw=1.1)
    axes.barh(
        y, q[3] - q[1], left=q[1], height=0.62, color=(b.colour, 0.3), edgecolor=b.colour, lw=1.1
    )
    axes.vlines(q[2], y - 0.31, y + 0.31, color=b.colour, lw=1.8)
    axes.plot(b.mean, y, "o", ms=3.6, color=b.colour)
    if b.reference is not None:
        axes.plot(b.reference, y, "D", ms=5.2, mfc="none", mec=style.INK, mew=1.1)
    place = axes.get_yaxis_transform()
    axes.text(1.015, y, _short(b.mean), transform=place, va="center", color=b.colour, fontsize=8.5)


def _short(value: float) -> str:
    """Two digits after the point below 10, then fewer."""
    return f"{value:.2f}" if value < 10 else f"{value:.1f}" if value < 100 else f"{value:.0f}"


def _plain_log(axis) -> None:
    """0.1, 1, 10 instead of powers, and steps between them where there are few."""
    low, high = axis.get_view_interval()
    ratio = high / low
    subs = (1.0,) if ratio > 300 else (1.0, 2.0, 5.0) if ratio > 8 else (1.0, 1.5, 2, 3, 4, 6, 8)
    axis.get_major_locator().set_params(subs=subs)
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _power(value: float, _: int) -> str:
    """10⁻³, without the markup that matplotlib would write it in."""
    exponent = round(np.log10(value))
    return "10" + str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


@style.styled
def lines(
    title: str,
    curves: Sequence[Line],
    xlabel: str,
    ylabel: str,
    *,
    log: bool = False,
    level: tuple[str, str, float] | None = None,
    ends: Sequence[tuple[str, float]] = (),
) -> Figure:
    """Curves against x, each named at its right end.

    Args:
        level: (text, colour, y) of a dashed horizontal line.
        ends: (colour, y) of open diamonds at the right edge.
    """
    figure, axes = style.panel(title)
    axes.set_xlabel(xlabel)
    axes.set_ylabel(ylabel)
    if log:
        axes.set_yscale("log")
    labels = []
    for curve in curves:
        if curve.band is not None:
            axes.fill_between(curve.x, *curve.band, color=curve.colour, alpha=0.2, lw=0)
        axes.plot(curve.x, curve.y, color=curve.colour, lw=1.1)
        tail = curve.y[-max(1, len(curve.y) // 10) :]
        labels.append((curve.label, curve.colour, float(np.median(tail))))
    if level is not None:
        axes.axhline(level[2], color=level[1], lw=1.2, ls=(0, (5, 3)))
        labels.append(level)
    end = max(c.x[-1] for c in curves)
    for colour, y in ends:
        axes.plot(end, y, "D", ms=6, mfc="none", mec=colour, mew=1.4, clip_on=False)
    axes.set_xlim(0.0, end)
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
    if log:
        # An error passes through zero now and then: such spikes say nothing.
        axes.set_ylim(bottom=0.7 * min(np.nanquantile(c.y, 0.02) for c in curves))
        _plain_log(axes.yaxis)
    else:
        axes.set_ylim(bottom=0.0)
    style.label_right(figure, axes, labels, 8.5)
    return figure


@style.styled
def levels(title: str, curves: Sequence[Line], xlabel: str, ylabel: str) -> Figure:
    """Curves over a few levels from 0 up, a dot each; logarithmic but for the step from 0."""
    figure, axes = style.panel(title)
    at = curves[0].x
    axes.set_yscale("log")
    # From 0 to the first level as far as a factor of three.
    axes.set_xscale("symlog", linthresh=at[1], linscale=0.5)
    axes.set_xticks(at, [f"{x:g}" for x in at])
    axes.xaxis.set_minor_locator(NullLocator())
    for curve in curves:
        axes.plot(curve.x, curve.y, "o-", color=curve.colour, ms=4, clip_on=False)
    axes.set_xlim(at[0], 1.08 * at[-1])  # room between the last dot and its label
    axes.set_xlabel(xlabel)
    axes.set_ylabel(ylabel)
    _plain_log(axes.yaxis)
    style.label_right(figure, axes, [(c.label, c.colour, float(c.y[-1])) for c in curves], 8.5)
    return figure


@style.styled
def follow(
    title: str,
    time_s: np.ndarray,
    tracks: Sequence[tuple[str, str, np.ndarray]],
    ylabel: str,
    late: tuple[float, float, float],
) -> Figure:
    """Goal, reference and tool of one axis over a short time, the tool's delay as an arrow.

    Args:
        tracks: (label, colour, values) of goal, reference and tool.
        late: (time the goal passes a level, time the tool does, the level): an arrow.
    """
    figure, axes = style.panel(title)
    goal, reference, tool = tracks
    axes.plot(time_s, goal[2], color=style.GOAL, lw=5)
    axes.plot(time_s, reference[2], color=reference[1], lw=1.2, ls=(0, (2, 1.5)))
    axes.plot(time_s, tool[2], color=tool[1], lw=1.9)
    axes.set_xlabel("time, s")
    axes.set_ylabel(ylabel)
    axes.set_xlim(time_s[0], time_s[-1])
    start, end, level = late
    if abs(end - start) > 0.02 * (time_s[-1] - time_s[0]):  # else the arrow is its head
        axes.annotate(
            f"{1e3 * (end - start):.0f} ms",
            (max(start, end), level),
            xytext=(9, -3),
            textcoords="offset points",
            va="top" if goal[2][-1] > goal[2][0] else "bottom",
            fontsize=9,
        )
        axes.annotate(
            "",
            (end, level),
            (start, level),
            arrowprops={"arrowstyle": "->", "color": style.INK, "lw": 1.3, "shrinkA": 0},
        )
    style.label_right(figure, axes, [(n, c, float(v[-1])) for n, c, v in tracks])
    return figure


@style.styled
def spectrum(
    title: str,
    seas: Sequence[tuple[str, str, np.ndarray, np.ndarray, np.ndarray, np.ndarray]],
    ylabel: str,
) -> Figure:
    """One motion's spectra, log-log.

    Args:
        seas: (name, colour, frequency Hz, density, target frequency Hz, target density).
    """
    figure, axes = style.panel(title)
    axes.set_xscale("log")
    axes.set_yscale("log")
    peak = max(float(density.max()) for _, _, _, density, _, _ in seas)
    for name, colour, hz, density, target_hz, target in seas:
        axes.plot(hz[1:], density[1:], color=colour, lw=2.4, alpha=0.75)
        axes.plot(target_hz, target, color=style.INK, lw=0.9, ls=(0, (4, 2)))
        # On the low-frequency flank, where the seas lie apart, along the steep line.
        top = int(np.argmax(density))
        flank = int(np.searchsorted(density[1 : top + 1], 3e-4 * peak)) + 1
        axes.annotate(
            *(name, (hz[flank], density[flank])),
            xytext=(3, 0),
            textcoords="offset points",
            color=colour,
            rotation=90,
            va="center",
            fontsize=8.5,
            weight="bold",
        )
    axes.set_xlim(0.14, 1.6)
    axes.set_ylim(1e-5 * peak, 6 * peak)
    axes.set_xlabel("frequency, Hz (laboratory)")
    axes.set_ylabel(ylabel)
    _plain_log(axes.xaxis)
    axes.yaxis.set_major_formatter(FuncFormatter(_power))
    if seas[0][4].size:
        axes.text(0.98, 0.96, "dashed: target", transform=axes.transAxes, ha="right", va="top")
    return figure
