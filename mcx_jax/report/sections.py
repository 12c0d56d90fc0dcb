"""From arrays to the page's sections: which figures there are and what their captions say."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from mcx_jax import palette
from mcx_jax.evaluate import Errors
from mcx_jax.evaluation.statistics import WARM_UP_STEPS, finite_episodes, paper_errors
from mcx_jax.report import figures, style
from mcx_jax.report.entries import Curves
from mcx_jax.report.episode import Episode, lag_s
from mcx_jax.report.figures import Line
from mcx_jax.report.noise import Sweep
from mcx_jax.report.spectra import CHANNELS, UNITS, Spectrum
from mcx_jax.report.table import noise_table

ZOOM_S = 0.6
"""What the follow panels show: short enough for a delay of 40 ms to be seen."""


@dataclass(frozen=True)
class Panel:
    """One figure of the page."""

    name: str
    """Of its file, without .png."""
    alt: str
    figure: Figure


@dataclass(frozen=True)
class Section:
    """A heading, panels and what one sees on them."""

    title: str
    panels: list[Panel]
    caption: str
    table: str = ""
    """HTML that goes in front of the caption."""


def distributions(parts: Sequence[tuple[str, bool, Errors]], papers_world: bool) -> Section:
    """Figure 4 of the paper for any controllers.

    Args:
        parts: (label, learned, errors) each.
        papers_world: the paper's means belong beside them.
    """
    colours = palette.controllers([label for label, _, _ in parts])
    panels, diamonds = [], False
    for k, (name, unit) in enumerate((("dp", "mm"), ("da", "mrad"))):
        groups = []
        for i, sea in enumerate(parts[0][2].seas):
            group = []
            for label, learned, e in parts:
                inside = finite_episodes(e.pos_m[:, i], e.ang_rad[:, i])
                points = 1e3 * (e.ang_rad if k else e.pos_m)[WARM_UP_STEPS:, i][:, inside]
                compared = papers_world and (learned or e.who == "ik")
                paper = paper_errors(e.who, e.delay, sea) if compared else None
                diamonds |= paper is not None
                group.append(figures.box(label, colours[label], points, paper and paper[k]))
            groups.append((sea, group))
        title = "Position error" if k == 0 else "Orientation error"
        drawn = figures.boxes(title, groups, f"{name}, {unit} (logarithmic)")
        alt = f"Box plots of {name} in {unit} per sea state and controller"
        panels.append(Panel(f"errors_{name}", alt, drawn))
    episodes = parts[0][2].valid.shape[1]
    return Section(
        "Errors in every sea",
        panels,
        f"All points of {episodes} test episodes a sea after the first second, the same motion and "
        "goals for everyone. Box: the middle half of the points; line in it: median; whiskers: 5 % "
        "to 95 %; dot and number: mean"
        + (
            "; open diamond: the paper's mean (table 3; for ik the baseline that it implies)."
            if diamonds
            else "."
        ),
    )


def tracking(
    ik: Episode, others: Sequence[tuple[str, Episode]], colours: dict[str, str], where: str
) -> Section:
    """One episode: how late the tool is, and the errors over time."""
    warm = slice(min(WARM_UP_STEPS, len(ik.time_s) // 3), None)  # a lag needs half a second
    axis = int(np.argmax(ik.goal_m[warm].std(axis=0)))
    window = _steepest(ik.time_s, ik.goal_m[:, axis])
    panels, lags = [], []
    for label, e in [("ik", ik), *others]:
        lag = 1e3 * lag_s(e.goal_m[warm], e.tool_m[warm])
        late = f"{abs(lag):.0f} ms {'late' if lag >= 0 else 'early'}"
        lags.append(f"{label} {late if np.isfinite(lag) else 'diverged'}")
        title = f"{style.short(label)}: "
        title += f"tool {late} on average" if np.isfinite(lag) else "diverged"
        panels.append(
            Panel(
                f"follow_{len(panels)}",
                f"Goal, reference and tool along {'xyz'[axis]} over {ZOOM_S:g} s, {label}",
                _follow(title, e, axis, window, colours[label]),
            )
        )
    for name, unit, values in (
        ("dp", "mm", lambda e: 1e3 * e.pos_error_m),
        ("da", "mrad", lambda e: 1e3 * e.ang_error_rad),
    ):
        curves = [Line("ik", colours["ik"], ik.time_s, values(ik))]
        curves += [Line(label, colours[label], e.time_s, values(e)) for label, e in others]
        title = "Position error" if name == "dp" else "Orientation error"
        drawn = figures.lines(title, curves, "time, s", f"{name}, {unit} (logarithmic)", log=True)
        panels.append(Panel(f"episode_{name}", f"{name} over one episode", drawn))
    return Section(
        "One episode",
        panels,
        f"{where}. First: {ZOOM_S:g} s around the goal's fastest movement along {'xyz'[axis]} of "
        "the arm's base, the same instant for everyone. Broad: goal; dotted: where the late joint "
        "reference would put the tool; solid: tool; the arrow: the tool's delay there and then. "
        f"In the titles ({', '.join(lags)}): the shift that fits the whole episode best, all "
        "three axes. Then: the errors over the whole episode.",
    )


def noise(sweeps: Sequence[Sweep], colours: dict[str, str], sea: str) -> Section:
    """Mean errors against measurement noise, as a table and as curves."""
    panels = []
    for name, unit, field in (("dp", "mm", "pos_mm"), ("da", "mrad", "ang_mrad")):
        curves = [
            Line(s.label, colours[s.label], np.array(s.levels), getattr(s, field)) for s in sweeps
        ]
        drawn = figures.levels(
            f"{'Position' if name == 'dp' else 'Orientation'} error, noisy measurement",
            curves,
            "noise, mm and mrad (standard deviation of each axis)",
            f"mean {name}, {unit} (logarithmic)",
        )
        panels.append(Panel(f"noise_{name}", f"Mean {name} against measurement noise", drawn))
    invalid = [f"{int(s.invalid.sum())} of {s.label}" for s in sweeps if s.invalid.any()]
    return Section(
        "Measurement noise",
        panels,
        f"Mean errors over the first {sweeps[0].episodes} of the episodes above in sea {sea}, the "
        "goal's pose measured with white noise, new at every control step: so many mm along each "
        "axis and as many mrad about each (standard deviations). The errors are the true ones, "
        "tool to true goal. No controller is told of the noise, which replaces the task's."
        + (f" Invalid episodes, counted all the same: {', '.join(invalid)}." if invalid else ""),
        noise_table(sweeps),
    )


def _steepest(time_s: np.ndarray, track: np.ndarray) -> slice:
    """Steps around the fastest movement, away from the warm-up and the end."""
    half = round(0.5 * ZOOM_S / (time_s[1] - time_s[0]))
    speed = np.abs(np.gradient(track))
    low, high = min(WARM_UP_STEPS, len(track) // 3) + half, len(track) - half - 1
    middle = low + int(np.argmax(speed[low:high])) if high > low else len(track) // 2
    return slice(max(0, middle - half), middle + half + 1)


def _follow(title: str, e: Episode, axis: int, window: slice, colour: str) -> Figure:
    time_s = e.time_s[window]
    goal, reference, tool = (1e3 * x[window, axis] for x in (e.goal_m, e.reference_m, e.tool_m))
    level = float(goal[len(goal) // 2])
    late = tuple(_crossing(time_s, track, level) for track in (goal, tool))
    return figures.follow(
        title,
        time_s,
        [("goal", style.MUTED, goal), ("reference", colour, reference), ("tool", colour, tool)],
        f"{'xyz'[axis]} in the arm base's frame, mm",
        (late[0], late[1], level),
    )


def _crossing(time_s: np.ndarray, track: np.ndarray, level: float) -> float:
    """When a track that rises or falls passes a level."""
    rising = track if track[-1] > track[0] else -track
    return float(np.interp(level if track[-1] > track[0] else -level, rising, time_s))


def effort(
    ik: Episode,
    others: Sequence[tuple[str, Episode]],
    colours: dict[str, str],
    limits_nm: np.ndarray,
) -> Section:
    """How much a policy corrects and how hard the servos work."""
    panels = []
    for name, part, unit in (
        ("translation", slice(0, 3), "mm"),
        ("rotation", slice(3, 6), "mrad"),
    ):
        curves = [
            Line(k, colours[k], e.time_s, 10.0 * np.linalg.norm(e.correction[:, part], axis=1))
            for k, e in others
        ]
        if curves:
            drawn = figures.lines(f"Correction, {name}", curves, "time, s", f"size, {unit}")
            panels.append(Panel(f"correction_{name}", f"Size of the correction's {name}", drawn))
    groups = []
    for j in np.flatnonzero(np.isfinite(limits_nm)):
        share = lambda e, j=j: 100.0 * np.abs(e.torque_nm[WARM_UP_STEPS:, j]) / limits_nm[j]  # noqa: E731
        rows = [figures.box(k, colours[k], share(e)) for k, e in [("ik", ik), *others]]
        groups.append((f"joint {j + 1}, limit {limits_nm[j]:.0f} N m", rows))
    if groups:
        drawn = figures.boxes("Torque use", groups, "share of the force limits, %", log=False)
        panels.append(Panel("torque", "Share of the force limits that every joint uses", drawn))
    return Section(
        "Correction and torque",
        panels,
        "The same episode. Correction: how far the policy moves and turns the goal that the "
        "inverse kinematics gets (ik: nothing). Torque: magnitude of what a joint's servos give "
        "together, as a share of their force limits, at the end of every control step after the "
        "first second; boxes as above. With the Euler integrator the stiff servo chatters at "
        "500 Hz, which is part of what one sees; a joint's two servos can also pull against each "
        "other and give nothing together.",
    )


def learning(
    runs: Sequence[tuple[str, Curves]],
    colours: dict[str, str],
    final: dict[str, dict[str, float]],
) -> Section:
    """Learning curves of the runs that have metrics.

    Args:
        final: `ik` and every run -> its mean on the test motion over the seas evaluated, `pos_mm`
            and `ang_mrad`; {} if the runs were trained for another task.
    """
    panels = []
    for name, unit, field in (("dp", "mm", "pos_mm"), ("da", "mrad", "ang_mrad")):
        level = ("ik", colours["ik"], final["ik"][field]) if final else None
        ends = [(colours[label], final[label][field]) for label, _ in runs if final]
        for against in ("steps", "wall"):
            curves = [_learning_curve(label, c, field, against, colours) for label, c in runs]
            xlabel = "control steps, millions" if against == "steps" else "training time, minutes"
            title = "Position error" if name == "dp" else "Orientation error"
            drawn = figures.lines(
                f"{title} in training, exploring",
                curves,
                xlabel,
                f"mean {name}, {unit} (logarithmic)",
                log=True,
                level=level,
                ends=ends,
            )
            panels.append(Panel(f"learning_{name}_{against}", f"Mean {name} by {xlabel}", drawn))
    several = [f"{label} ({len(c.pos_mm)} seeds)" for label, c in runs if len(c.pos_mm) > 1]
    return Section(
        "Learning curves",
        panels,
        "Mean error of the experience of each iteration: on training motion and, where the "
        "algorithm explores, with the noise of exploration in every action. A curve may so end "
        "above ik while the policy that came of it, which acts without that noise, is far below. "
        + (
            "Diamonds at the right edge: the finished policies, on the test motion, mean over the "
            "seas; dashed: ik, the same. "
            if final
            else ""
        )
        + (
            f"Line and band: mean and range over the seeds of {', '.join(several)}."
            if several
            else "One seed a run: no interval can be given."
        ),
    )


def _learning_curve(label: str, c: Curves, field: str, against: str, colours: dict) -> Line:
    y = getattr(c, field)
    x = 1e-6 * c.steps if against == "steps" else c.wall_s / 60.0
    band = (y.min(axis=0), y.max(axis=0)) if len(y) > 1 else None
    return Line(label, colours[label], x, y.mean(axis=0), band)


def sea_spectra(spectra: Sequence[Spectrum]) -> Section:
    """Spectra of the six motions, measured and wanted."""
    shades = palette.SEAS if len(spectra) == len(palette.SEAS) else palette.SEAS[2:3] * len(spectra)
    panels = []
    for k, (channel, unit) in enumerate(zip(CHANNELS, UNITS, strict=True)):
        seas = [
            (s.sea, shade, s.frequency_hz, s.measured[k], s.target_hz, s.target[k])
            for s, shade in zip(spectra, shades, strict=True)
        ]
        drawn = figures.spectrum(channel.capitalize(), seas, f"spectral density, {unit}²/Hz")
        panels.append(Panel(f"spectrum_{channel.split()[0]}", f"Spectrum of {channel}", drawn))
    caption = (
        "Motion of the arm's base (vessel A) in the tables that the episodes above are cut from, "
        "at laboratory scale (frequencies times the root of the Froude scale, lengths divided by "
        "it), by Welch's method. "
    )
    if spectra[0].target_hz.size:
        caption += (
            "Dashed: the target, JONSWAP's wave spectrum times the square of the vessel's linear "
            f"response (RAO). {_agreement(spectra)}"
        )
    else:
        caption += "A recording has no target spectrum."
    return Section("Vessel motion", panels, caption)


def _agreement(spectra: Sequence[Spectrum]) -> str:
    ratio = np.array([s.measured_std / s.target_std for s in spectra])
    worst = 100.0 * float(np.abs(ratio - 1.0).max())
    return (
        f"The standard deviations of all motions and seas agree with it within {worst:.2g} %: only "
        "the phases of the generated waves are random, not their amplitudes."
    )


def lead(rows: dict[str, list[dict[str, Any]]], learned: Sequence[str]) -> list[str]:
    """One sentence about each learned controller."""
    sentences = []
    for label in learned:
        part = rows[label]
        dp, da = ([r[unit]["mean"] for r in part] for unit in ("pos_mm", "ang_mrad"))
        gain = [100 * r["improvement"]["pos"]["all"] for r in part]
        sentences.append(
            f"{label}: {_range(dp, '.2f')} mm and {_range(da, '.2f')} mrad on average, position "
            f"error {_range(gain, '.0f')} % below ik's."
        )
    return sentences


def _range(values: Sequence[float], form: str) -> str:
    low, high = (format(value, form) for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"
