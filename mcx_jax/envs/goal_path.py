"""Paths that the goal follows on vessel B's deck (the paper's future work), about its drawn place.

A path is a table of offsets, one a physics step of 2 ms, read with an integer index.
"""

import math
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from mcx_jax.config.delay import PHYSICS_DT_S
from mcx_jax.errors import UserError

PERIOD_S = 6.0
RADIUS_M = 0.05
"""52 mm/s along the circle, near the goal's own mean speed in Wa: 63 mm/s, since the IK's error
grows by 2.5 mm from E0 to E2, 40 ms."""
CLOSED_M = 1e-3
"""A recorded path that ends this near its beginning is gone round again; others stop there."""
MAX_FILE_S = 3600.0
MAX_OFFSET_M = 10.0
"""Ten times the arm's reach; beyond it a number is not in metres."""


@struct.dataclass
class GoalPath:
    """Offsets of the goal from its drawn place."""

    offsets_m: jax.Array
    """(P, 3) in vessel B's axes."""
    closed: bool = struct.field(pytree_node=False)
    """Gone round again after P steps; an open one ends at its last offset."""

    @property
    def period_steps(self) -> int:
        """Physics steps of a closed path, 0 of an open one."""
        return self.offsets_m.shape[0] if self.closed else 0

    def at(self, step: jax.Array) -> jax.Array:
        """(3,) offset at a physics step, m."""
        count = self.offsets_m.shape[0]
        index = step % count if self.closed else jnp.minimum(step, count - 1)
        return self.offsets_m[index]


def load_goal_path(name: str) -> GoalPath | None:
    """The path of `--goal`: static (None), circle, lissajous, or a .csv file with t,x,y,z (s, m).

    Raises:
        UserError: no such name or file, or a file that is not a path.
    """
    if name == "static":
        return None
    if name in ("circle", "lissajous"):
        phase = 2 * math.pi * np.arange(round(PERIOD_S / PHYSICS_DT_S)) * PHYSICS_DT_S / PERIOD_S
        offsets = RADIUS_M * np.stack(
            [np.cos(phase), np.sin(phase), np.zeros_like(phase)]
            if name == "circle"
            else [np.sin(phase), np.sin(2 * phase), np.zeros_like(phase)],
            axis=1,
        )
        return GoalPath(jnp.asarray(offsets, jnp.float32), closed=True)
    return _from_file(name)


def _from_file(name: str) -> GoalPath:
    path = Path(name)
    if not os.path.isfile(path):
        raise UserError(
            f"--goal {name}: not static, circle or lissajous, and no such file; give a .csv file "
            "with columns t,x,y,z (s, m)"
        )
    rows = _read(name, path)
    if len(rows) < 2 or not np.isfinite(rows).all():
        raise UserError(f"--goal {name}: needs at least two rows of four finite numbers t,x,y,z")
    if np.abs(rows[:, 1:]).max() > MAX_OFFSET_M:
        raise UserError(
            f"--goal {name}: x, y, z are metres from the drawn place; at most {MAX_OFFSET_M:g}"
        )
    with np.errstate(over="ignore"):
        time_s = rows[:, 0] - rows[0, 0]
    if np.any(time_s[1:] <= time_s[:-1]) or time_s[-1] > MAX_FILE_S:
        raise UserError(f"--goal {name}: t must increase, and by at most {MAX_FILE_S:g} s")
    closed = bool(np.linalg.norm(rows[-1, 1:] - rows[0, 1:]) < CLOSED_M)
    steps = max(round(time_s[-1] / PHYSICS_DT_S), 1)
    at = PHYSICS_DT_S * np.arange(steps if closed else steps + 1)
    offsets = np.stack([np.interp(at, time_s, rows[:, i]) for i in (1, 2, 3)], axis=1)
    return GoalPath(jnp.asarray(offsets, jnp.float32), closed)


def _read(name: str, path: Path) -> np.ndarray:
    """(rows, 4) numbers; a header and lines that begin with # are left out."""
    try:
        lines = [line.split(",") for line in path.read_text("utf-8").splitlines() if line.strip()]
        lines = [words for words in lines if not words[0].lstrip().startswith("#")]
        if lines and not _is_number(lines[0][0]):
            lines = lines[1:]
        rows = [[float(word) for word in words] for words in lines]
        if any(len(row) != 4 for row in rows):
            raise ValueError
        return np.array(rows).reshape(-1, 4)
    except (ValueError, OSError):
        raise UserError(f"--goal {name}: not a table of four numbers a row, t,x,y,z") from None


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
