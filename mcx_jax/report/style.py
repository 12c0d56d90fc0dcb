"""How the figures look: one size, one set of colours, and helpers for labels beside the lines.

Every figure is one narrow panel: the page sets them side by side on a screen or on paper and one
below the other on a phone, where their letters stay readable.
"""

import functools
import io
import re
import warnings
from collections.abc import Callable, Sequence
from typing import Any
from xml.etree import ElementTree

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mcx_jax.palette import COLOURS, LIGHT

WIDTH_IN = 4.8
DPI = 200
LONGEST_NAME = 26
"""Characters, at the right of a figure: more leave too little room for the curves."""

INK, MUTED, GRID, PAPER, GOAL = (LIGHT[n] for n in ("ink", "muted", "grid", "paper", "goal"))

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
    "savefig.facecolor": PAPER,
    "text.parse_math": False,  # names are shown as they are, dollar signs and all
    "svg.fonttype": "none",
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
    """The figure as a PNG file, on light paper."""
    return _saved(figure, format="png", dpi=DPI)


def svg(figure: Figure, name: str, alt: str) -> str:
    """The figure as an SVG element of the page: its text is text, in the page's letters, and its
    colours are the page's variables (`css_colours`).

    Args:
        name: unique on the page.
        alt: what it shows, for who cannot see it.
    """
    nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    with rc_context({"svg.hashsalt": name}):
        root = ElementTree.fromstring(
            _saved(figure, format="svg", transparent=True, metadata=nothing)
        )
    for element in root.iter():
        element.tag = _bare(element.tag)
        element.attrib = {_bare(k): _restyled(k, v) for k, v in element.attrib.items()}
        for child in [c for c in element if _bare(c.tag) == "defs" and _bare(c[0].tag) == "style"]:
            element.remove(child)  # it would hold for the whole page, which says the same
        if element.tag == "g":
            element.attrib.pop("id", None)  # the same in every figure
    root.attrib = {"viewBox": root.attrib["viewBox"], "role": "img", "aria-label": alt}
    return ElementTree.tostring(root, encoding="unicode")


def _bare(name: str) -> str:
    """Without the namespace, which HTML does not have."""
    return name.rpartition("}")[2]


def _restyled(attribute: str, value: str) -> str:
    if attribute != "style":
        return value
    inherited = re.sub(r"font-family: [^;]*(; |$)", "", value)
    return re.sub(r"#[0-9a-f]{6}\b", lambda match: f"var(--{_NAMES[match[0]]})", inherited)


_NAMES = {colour: name for name, colour in LIGHT.items()}


def css_colours() -> str:
    """The palette as variables of the page, for light and for dark paper."""
    light, dark = (
        "".join(f"--{name}:{pair[k]};" for name, pair in COLOURS.items()) for k in (0, 1)
    )
    return (
        f":root{{color-scheme:light dark;{light}}}\n"
        f"@media screen and (prefers-color-scheme:dark){{:root{{{dark}}}}}\n"
    )


def _saved(figure: Figure, **options: Any) -> bytes:
    buffer = io.BytesIO()
    with rc_context(_RC), warnings.catch_warnings():
        # In a name of letters that matplotlib's font lacks: a box in the PNG, nothing to do about.
        warnings.filterwarnings("ignore", "Glyph .* missing from font", UserWarning)
        figure.savefig(buffer, **options)
    return buffer.getvalue()


def short(name: str) -> str:
    """A name as figures have room for it: of a long one the middle goes."""
    return name if len(name) <= LONGEST_NAME else f"{name[:14]}…{name[14 + 1 - LONGEST_NAME :]}"


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
            *(short(text), (1.0, place)),
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
