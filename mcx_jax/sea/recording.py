"""Recorded vessel motion (a motion reference unit's log, or another simulator) as motion tables.

File: .npy or .csv, columns t, x, y, z, roll, pitch, yaw; a .csv may name them in its first line and
then have them in any order (`NAMES`). t in seconds. Axes x forward, y to port, z up;
R = Rz(yaw) Ry(pitch) Rx(roll). The authors' format: .npy, mm, degrees, 100 Hz, already scaled.

What is done to it: units, Froude scale, yaw unwrapped, the mean of x, y, z and yaw taken off, x and
y turned into the axes of the mean heading, cubic spline to knots every 0.1 s. The means go because
the rest poses of the vessels are the task's, not the log's: the x and y of a GPS, the heave datum
of a sensor and a compass heading say where the ship was, and added to the rest pose they would put
it out of the arm's reach. The mean of roll and pitch stays: list and trim are real. Motion above
5 Hz (laboratory time) is not carried by the knots; filter a noisy log before.

Whether x and y are along the earth's axes or the ship's cannot be seen in the numbers. Where the
mean yaw is within `_LIKE_AXES_RAD` both are nearly the same and nothing is turned; beyond it the
user has to say (`axes`).
"""

import math
import os
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from mcx_jax.console.notice import notice
from mcx_jax.errors import UserError
from mcx_jax.sea.tables import KNOT_DT_S, SPLIT_GAP_S, MotionTables

COLUMNS = ("t", "x", "y", "z", "roll", "pitch", "yaw")
NAMES = {name: name for name in COLUMNS} | {
    "time": "t",
    "surge": "x",
    "sway": "y",
    "heave": "z",
    "heading": "yaw",
}
"""Names that a header may give the columns."""
Axes = Literal["auto", "earth", "ship"]
MIN_RATE_HZ = 10.0
# A third of it, less the gap at the border, must still hold an episode of 20.5 s and the 2 s that
# controllers may look ahead.
MIN_DURATION_S = 128.0
# Limits beyond which a number cannot be the unit named: ten times the arm's reach, the roll of a
# ship about to capsize, half a turn off the mean heading.
_MAX_DISPLACEMENT_M = 10.0
_MAX_TILT_RAD = math.radians(45.0)
_MAX_YAW_RAD = math.pi
# Below it the two readings of x and y differ by a part of sin(5 deg) = 9 %.
_LIKE_AXES_RAD = math.radians(5.0)
# Wd, the paper's roughest sea, moves its vessel up to 0.4 m; a UR10e reaches 1.1 m.
_LIKELY_DISPLACEMENT_M = 0.6
# Means over blocks of this length hold nearly nothing of waves, whose periods are below 6 s in the
# laboratory (a swell of 6.3 s keeps 19 %), and nearly all of drift and station keeping.
_SLOW_S = 10.0
_SLOW_M_OR_RAD = 0.02
# Time stamps may be off by this part of a step: float32 seconds after an hour are, by 2 %.
_MAX_UNEVENNESS = 0.05


def load_recording(
    path: str | Path,
    length_unit: Literal["m", "mm"] = "m",
    angle_unit: Literal["rad", "deg"] = "rad",
    scale: float = 1.0,
    axes: Axes = "auto",
    min_duration_s: float = MIN_DURATION_S,
) -> MotionTables:
    """One recording as a single motion table, not periodic.

    Args:
        path: .npy (n, 7) or .csv with 7 columns and an optional header line that names them.
        length_unit: of x, y, z.
        angle_unit: of roll, pitch, yaw.
        scale: Froude scale lambda; lengths are divided by it, time by its root. 1 = already scaled.
        axes: of x and y. earth: those that yaw is counted from; they are turned by the mean yaw.
            ship: those of the mean heading. auto: as they are, where the mean yaw is within 5 deg.
        min_duration_s: shortest recording accepted, after scaling.

    Returns:
        `MotionTables` with knots (1, rows, 12).

    Raises:
        UserError: one line that says what is wrong with the file.
    """
    path = Path(path)
    if not (math.isfinite(scale) and scale > 0):
        raise UserError(f"{path}: the Froude scale is {scale:g}; it must be positive, e.g. 10")
    with np.errstate(over="ignore", invalid="ignore"):  # refused below, in words
        return _load(path, length_unit, angle_unit, scale, axes, min_duration_s)


def _load(
    path: Path, length_unit: str, angle_unit: str, scale: float, axes: Axes, min_duration_s: float
) -> MotionTables:
    data = _checked_numbers(path, _read(path))
    time_s = _checked_time(path, data[:, 0] / math.sqrt(scale), scale, min_duration_s)
    motion = data[:, 1:].copy()
    motion[:, :3] *= {"m": 1.0, "mm": 1e-3}[length_unit] / scale
    motion[:, 3:] *= {"rad": 1.0, "deg": math.pi / 180.0}[angle_unit]
    motion[:, 5] = np.unwrap(motion[:, 5])
    mean_yaw = motion[:, 5].mean()
    for column in (0, 1, 2, 5):
        motion[:, column] -= motion[:, column].mean()
    _check_units(path, motion, length_unit, angle_unit, scale)
    _turn_to_heading(path, motion, math.remainder(mean_yaw, 2.0 * math.pi), axes)
    _advise(path, time_s, motion, scale)
    return MotionTables(
        knots=_resample(time_s, motion)[None],
        companion=None,
        sea_index=np.zeros(1, np.int32),
        sea_names=(path.name,),
    )


def _turn_to_heading(path: Path, motion: np.ndarray, mean_yaw: float, axes: Axes) -> None:
    """Turn x and y, in place, into the axes of the mean heading.

    Args:
        motion: (n, 6) m, rad, means removed.
        mean_yaw: rad, within half a turn. It is the circular mean as well: yaw was unwrapped.
    """
    degrees = math.degrees(mean_yaw)
    if axes == "auto" and abs(mean_yaw) > _LIKE_AXES_RAD:
        raise UserError(
            f"{path}: the mean yaw is {degrees:.0f} deg; are x and y along the earth's axes, from "
            "which yaw is counted (give --motion-axes earth), or along the ship's (ship)?"
        )
    if axes != "earth":
        return
    x, y = motion[:, 0].copy(), motion[:, 1].copy()
    motion[:, 0] = math.cos(mean_yaw) * x + math.sin(mean_yaw) * y
    motion[:, 1] = math.cos(mean_yaw) * y - math.sin(mean_yaw) * x
    notice(f"{path}: x and y turned by {degrees:.1f} deg, from the earth's axes to the heading's")


def _advise(path: Path, time_s: np.ndarray, motion: np.ndarray, scale: float) -> None:
    """Say what can be read but is likely not meant. motion: (n, 6) m, rad, means removed."""
    block = max(1, round(_SLOW_S * (len(time_s) - 1) / (time_s[-1] - time_s[0])))
    whole = len(motion) // block * block
    slow = motion[:whole].reshape(-1, block, 6).mean(axis=1).std(axis=0)
    drifts = (slow > _SLOW_M_OR_RAD) & (slow > 0.5 * motion.std(axis=0))
    names = [name for name, drift in zip(COLUMNS[1:], drifts, strict=True) if drift]
    if names:
        notice(
            f"{path}: {', '.join(names)}: most of this motion is slower than {_SLOW_S:g} s of "
            "laboratory time, no waves; drift carries the goal out of the arm's reach: take it off "
            "with a high-pass filter (docs/own-data.md)"
        )
    peak = np.abs(motion[:, :3]).max()
    if peak > _LIKELY_DISPLACEMENT_M:
        ask = "is it at full scale (--motion-scale 10)?" if scale == 1 else "is the scale right?"
        notice(
            f"{path}: moves up to {peak:.2f} m from its mean, the roughest sea of the paper 0.4 m, "
            f"and an arm like the UR10e reaches 1.1 m: {ask}"
        )


def split_recording(tables: MotionTables) -> tuple[MotionTables, MotionTables]:
    """First 2/3 to train, last 1/3 to test (the paper's split), 20 s left out between them."""
    last = tables.knots.shape[1] - 1
    border, gap = last * 2 // 3, round(SPLIT_GAP_S / KNOT_DT_S)
    if last - border <= gap:
        raise UserError(
            f"{tables.sea_names[0]}: lasts {tables.duration_s:.0f} s; a train and a test part need "
            f"more than {3 * SPLIT_GAP_S:.0f} s: record longer"
        )
    train = replace(tables, knots=tables.knots[:, : border + 1])
    return train, replace(tables, knots=tables.knots[:, border + gap :])


def _resample(time_s: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """(n,) even times and (n, 6) motion -> (rows, 12) float32 knots, values and derivatives."""
    from scipy.interpolate import CubicSpline  # heavy; only recordings need it

    spline = CubicSpline(time_s, motion)
    # 1e-9: a duration of 119.99999999 s still has its last knot.
    rows = math.floor((time_s[-1] - time_s[0]) / KNOT_DT_S + 1e-9) + 1
    knots_s = np.minimum(time_s[0] + KNOT_DT_S * np.arange(rows), time_s[-1])
    return np.concatenate([spline(knots_s), spline(knots_s, 1)], axis=1).astype(np.float32)


def _read(path: Path) -> np.ndarray:
    """The file's numbers, whatever their shape."""
    if not os.path.isfile(path):
        raise UserError(f"{path}: no such file; give a .npy or .csv recording")
    if path.suffix not in (".npy", ".csv"):
        raise UserError(f"{path}: unknown kind of file; a recording is .npy or .csv")
    if path.stat().st_size == 0:
        raise UserError(f"{path}: the file is empty; it needs columns {','.join(COLUMNS)}")
    return _read_npy(path) if path.suffix == ".npy" else _read_csv(path)


def _read_npy(path: Path) -> np.ndarray:
    try:
        data = np.load(path, allow_pickle=False)
    except Exception:  # numpy parses the header as Python: nearly anything may be raised
        data = None
    if not isinstance(data, np.ndarray) or data.dtype.kind not in "fiu":
        raise UserError(
            f"{path}: not readable as .npy array of numbers (pickled objects are refused); "
            f"save it with numpy.save(file, array) from an array (n, 7)"
        )
    return data.astype(float)


def _read_csv(path: Path) -> np.ndarray:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
        rows = [line.split(",") for line in lines if line.strip()]
    except (UnicodeDecodeError, OSError):
        raise UserError(
            f"{path}: not readable as .csv text; it needs lines of 7 numbers separated by commas"
        ) from None
    order = list(range(len(rows[0]))) if rows else []
    if _is_header(rows[:1]):
        order = _column_order(path, rows.pop(0))
    if not rows:
        raise UserError(f"{path}: holds no numbers; it needs columns {','.join(COLUMNS)}")
    for number, row in enumerate(rows, 1):
        if len(row) != len(rows[0]):
            raise UserError(
                f"{path}: data line {number} has {len(row)} columns, the first has {len(rows[0])}; "
                f"every line needs {','.join(COLUMNS)}"
            )
    if len(order) != len(rows[0]):
        raise UserError(f"{path}: the header names {len(order)} columns, a line has {len(rows[0])}")
    try:
        return np.array(rows, dtype=float)[:, order]
    except ValueError as error:
        raise UserError(
            f"{path}: not all entries are numbers ({error}); it needs 7 numbers a line separated "
            f"by commas, and only the first line may be a header"
        ) from None


def _is_header(rows: list[list[str]]) -> bool:
    """Whether the first line is text: it holds an entry that is no number and no gap."""
    try:
        [float(entry) for row in rows for entry in row if entry.strip()]
    except ValueError:
        return True
    return False


def _column_order(path: Path, header: list[str]) -> list[int]:
    """Where the header has each of COLUMNS."""
    places: dict[str, int] = {}
    for place, entry in enumerate(header):
        word = entry.strip().strip("\"'").lower()
        name = NAMES.get(word)
        if name is None or name in places:
            problem = "is not known" if name is None else f"is a second {name}"
            raise UserError(
                f"{path}: column {entry.strip()!r} {problem}; name the columns, with commas "
                "between them and in any order, t (or time), x (surge), y (sway), z (heave), roll, "
                "pitch, yaw (heading)"
            )
        if word == "heading":
            notice(f"{path}: heading is read as yaw, which grows to PORT; turn a compass's sign")
        places[name] = place
    missing = [name for name in COLUMNS if name not in places]
    if missing:
        raise UserError(
            f"{path}: the header names no column {missing[0]}; needed are {','.join(COLUMNS)}"
        )
    return [places[name] for name in COLUMNS]


def _checked_numbers(path: Path, data: np.ndarray) -> np.ndarray:
    if data.ndim != 2 or data.shape[1] != len(COLUMNS):
        shape = f"{data.shape[1]} columns" if data.ndim == 2 else f"shape {data.shape}"
        raise UserError(f"{path}: has {shape}; it needs the 7 columns {','.join(COLUMNS)}")
    bad = ~np.isfinite(data)
    if bad.any():
        row, column = (int(i) for i in np.argwhere(bad)[0])
        raise UserError(
            f"{path}: {COLUMNS[column]} is {data[row, column]} in row {row + 1}; all entries must "
            f"be finite numbers: cut out or fill the gap"
        )
    return data


def _checked_time(path: Path, time_s: np.ndarray, scale: float, min_s: float) -> np.ndarray:
    """Even laboratory times in place of the stamps, which must be even but for their rounding."""
    if len(time_s) < 2:
        raise UserError(f"{path}: too short: fewer than two rows; it needs at least {min_s:g} s")
    steps_s = np.diff(time_s)
    if (steps_s <= 0).any():
        row = int(np.argmax(steps_s <= 0)) + 2
        raise UserError(
            f"{path}: time does not increase at row {row}; sort the rows and drop repeated ones"
        )
    mean_s = (time_s[-1] - time_s[0]) / len(steps_s)
    even = np.linspace(time_s[0], time_s[-1], len(time_s))
    off = np.abs(steps_s - mean_s)
    # Each step AND each stamp: a slow drift of the rate passes the first and fails the second.
    if not off.max() <= _MAX_UNEVENNESS * mean_s or np.abs(time_s - even).max() > mean_s:
        row = int(np.argmax(off)) + 2
        raise UserError(
            f"{path}: time is uneven: a step of {steps_s[row - 2] * math.sqrt(scale):g} s at row "
            f"{row}, {mean_s * math.sqrt(scale):g} s on average; resample it to an even rate"
        )
    if 1.0 / mean_s < MIN_RATE_HZ * (1 - 1e-3):
        raise UserError(
            f"{path}: sample rate {1.0 / mean_s:.3g} Hz (after Froude scaling); at least "
            f"{MIN_RATE_HZ:g} Hz are needed: record faster, t is in seconds"
        )
    if time_s[-1] - time_s[0] < min_s * (1 - 1e-6):
        raise UserError(
            f"{path}: too short: {time_s[-1] - time_s[0]:.1f} s (after Froude scaling); "
            f"it needs at least {min_s:g} s"
        )
    return even


def _check_units(
    path: Path, motion: np.ndarray, length_unit: str, angle_unit: str, scale: float
) -> None:
    """Refuse numbers that cannot be what their unit says. motion: (n, 6) m, rad, means removed."""
    peaks = np.abs(motion).max(axis=0)
    for name, peak in zip(COLUMNS[1:4], peaks[:3], strict=True):
        if not peak <= _MAX_DISPLACEMENT_M:  # also catches the NaN of an overflow
            unit = "mm" if length_unit == "m" else "micrometres"
            full = " at full scale (give --motion-scale, e.g. 10)," if scale == 1 else ""
            raise UserError(
                f"{path}: {name} moves {peak:.4g} m from its mean; at laboratory scale at most "
                f"{_MAX_DISPLACEMENT_M:g} m can be: is it in {unit},{full} or under way (take "
                "speed and drift off with a high-pass filter)?"
            )
    limits = (_MAX_TILT_RAD, _MAX_TILT_RAD, _MAX_YAW_RAD)
    for name, peak, limit in zip(COLUMNS[4:], peaks[3:], limits, strict=True):
        if not peak <= limit:
            hint = "is it in degrees?" if angle_unit == "rad" else "is the column order right?"
            raise UserError(
                f"{path}: {name} reaches {peak:.4g} rad; at most {limit:.3g} rad can be: {hint}"
            )
