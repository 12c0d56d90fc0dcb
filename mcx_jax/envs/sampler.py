"""Vessel motion at an instant, in JAX, for ONE environment (vmapped elsewhere, batch axis last).

Time is an int32 count of 2 ms physics steps, never float32 seconds: those resolve 0.2 ms after an
hour, which alone would put 0.06 m/s of noise on a finite-difference velocity. Small vectors are
written as scalar expressions, so that under `vmap` each scalar is one contiguous row.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from mcx_jax.compute.fusion import stage
from mcx_jax.config.delay import PHYSICS_DT_S
from mcx_jax.sea.tables import KNOT_DT_S, KNOT_STEPS
from mcx_jax.spatial import Scalar, Vec

__all__ = ["KNOT_STEPS", "PHYSICS_DT_S", "body_rates", "hermite", "segment_rows"]


def segment_rows(
    knots: jax.Array, table: jax.Array, step: jax.Array, wall: jax.Array | None = None
) -> tuple[jax.Array, jax.Array]:
    """The two knots around an instant.

    Args:
        knots: (tables, rows, 12), see `mcx_jax.sea.tables.MotionTables`.
        table: () int32.
        step: () int32, physics steps of 2 ms since the table's start, 0 <= step < 50 (rows - 1).
        wall: see `mcx_jax.compute.fusion`; without it the division is repeated for all 24 numbers.

    Returns:
        row0, row1: (12,) each; the instant lies `step % KNOT_STEPS` physics steps after row0.
    """
    index = stage(wall, lambda step: step // KNOT_STEPS, step)
    return knots[table, index], knots[table, index + 1]


def hermite(
    row0: jax.Array, row1: jax.Array, step_in_segment: jax.Array | int
) -> tuple[tuple[Scalar, ...], tuple[Scalar, ...], tuple[Scalar, ...]]:
    """Cubic Hermite interpolation between two knots 0.1 s apart.

    Position and velocity are continuous over knots, the acceleration jumps there by up to
    0.01 m/s2 (0.5 % rms).

    Args:
        row0, row1: (12,) values, then time derivatives.
        step_in_segment: () integer physics steps after row0, 0..50, may be traced.

    Returns:
        x, xdot, xddot: six scalars each; x, y, z m, roll, pitch, yaw rad, per s, per s2.
    """
    u = jnp.asarray(step_in_segment).astype(row0.dtype) / KNOT_STEPS
    x, xd, xdd = [], [], []
    for i in range(6):
        x0, slope0, slope1 = row0[i], KNOT_DT_S * row0[i + 6], KNOT_DT_S * row1[i + 6]
        rise = row1[i] - x0
        # x = x0 + slope0 u + c2 u^2 + c3 u^3. Differences first: float32 keeps 2e-5 m/s2.
        c2 = 3.0 * rise - 2.0 * slope0 - slope1
        c3 = slope0 + slope1 - 2.0 * rise
        x.append(x0 + u * (slope0 + u * (c2 + u * c3)))
        xd.append((slope0 + u * (2.0 * c2 + u * (3.0 * c3))) / KNOT_DT_S)
        xdd.append((2.0 * c2 + u * (6.0 * c3)) / KNOT_DT_S**2)
    return tuple(x), tuple(xd), tuple(xdd)


def body_rates(
    turns: Sequence[tuple[Scalar, Scalar]], rpy_dot: Sequence[Scalar], rpy_ddot: Sequence[Scalar]
) -> tuple[Vec, Vec]:
    """Angular velocity and acceleration in body axes, for R = Rz(yaw) Ry(pitch) Rx(roll).

    Args:
        turns: (sin, cos) of roll, pitch and, if given, yaw (it does not matter).
        rpy_dot, rpy_ddot: of roll, pitch, yaw, rad/s and rad/s2.

    Returns:
        w_body rad/s, al_body rad/s2: the time derivative of w_body, which is also the angular
        acceleration in the parent frame seen in body axes, since w x w = 0.
    """
    (sr, cr), (sp, cp) = turns[0], turns[1]
    dr, dp, dy = rpy_dot
    ddr, ddp, ddy = rpy_ddot
    w = (dr - dy * sp, dp * cr + dy * cp * sr, dy * cp * cr - dp * sr)
    al = (
        ddr - ddy * sp - dy * dp * cp,
        ddp * cr + ddy * cp * sr + dr * w[2] - dy * dp * sp * sr,
        ddy * cp * cr - ddp * sr - dr * w[1] - dy * dp * sp * cr,
    )
    return w, al
