"""The two vessels: poses and rates at an instant, and the goal as seen from the arm's base.

Vessel A carries the arm: its deck origin is the arm's base B. Vessel B carries the goal G. A
vessel's position is its rest position plus the sampled (x, y, z) in world axes, not turned with the
rest pose; its orientation is the rest rotation times Rz(yaw) Ry(pitch) Rx(roll) (authors' code).
"""

import math

import jax
import jax.numpy as jnp
from flax import struct

from mcx_jax.compute.fusion import stage
from mcx_jax.config.delay import SUBSTEPS
from mcx_jax.envs.motion import Motion, Track
from mcx_jax.envs.sampler import KNOT_STEPS, body_rates, hermite, segment_rows
from mcx_jax.sea.spectrum import GRAVITY_M_S2
from mcx_jax.sea.tables import SEPARATION_X_M
from mcx_jax.spatial import (
    Mat,
    Scalar,
    Vec,
    matmul,
    matvec,
    rotation_of_turns,
    rotation_rpy,
    sincos,
    tmatvec,
    transpose,
    unpack,
    vadd,
    vsub,
)

REST_B_M: Vec = (SEPARATION_X_M, 0.0, 0.0)
"""Vessel B's rest position (authors' code); vessel A rests at the origin."""
REST_B: Mat = ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))
"""Vessel B is turned 180 deg about z: the vessels face each other."""
GOAL_ROTATION: Mat = ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0))
"""R_Vb_G: half a turn about (cos 45 deg, sin 45 deg, 0): the goal's z points down."""
GOAL_LOW_M: Vec = (-0.1, -0.1, 0.1)
GOAL_HIGH_M: Vec = (0.1, 0.1, 0.3)
"""Box on vessel B in which the goal's position is drawn (paper; authors' code)."""


@struct.dataclass
class Segment:
    """Two neighbouring knots and the place between them where a control step begins.

    KNOT_STEPS is a multiple of SUBSTEPS, so a control step never straddles a knot.
    """

    row0: jax.Array
    row1: jax.Array
    first: jax.Array
    """() int32: physics steps from row0 to the beginning of the control step."""

    def at(self, i: jax.Array | int) -> tuple[tuple[Scalar, ...], ...]:
        """Position (x y z m, roll pitch yaw rad), rate and acceleration at physics step i."""
        return hermite(self.row0, self.row1, self.first + i)


def segment(
    knots: jax.Array, table: jax.Array, step: jax.Array, wall: jax.Array | None = None
) -> Segment:
    """The segment that holds a physics step (int32, never float seconds) of a table."""
    row0, row1 = segment_rows(knots, table, step, wall)
    return Segment(row0=row0, row1=row1, first=step % KNOT_STEPS)


def still(seg: Segment) -> Segment:
    """A vessel held at the segment's first pose."""
    x, _, _ = seg.at(0)
    row = jnp.stack([*x, *[jnp.zeros_like(x[0])] * 6])
    return Segment(row0=row, row1=row, first=seg.first)


def base_state(
    seg: Segment, i: jax.Array | int, wall: jax.Array | None = None
) -> tuple[Vec, Vec, Vec]:
    """Vessel A's (w, al, a) in its own axes at physics step i, as `chain.BaseState`.

    Three stages, so that the interpolation and the sines are computed once.
    """
    x, xd, xdd = stage(wall, seg.at, i)
    turns = stage(wall, lambda rpy: [sincos(angle) for angle in rpy], x[3:])

    def seen_from_deck(turns, rate, accel):
        w, al = body_rates(turns, rate, accel[3:])
        upward = accel[2] + GRAVITY_M_S2
        return w, al, tmatvec(rotation_of_turns(turns), (accel[0], accel[1], upward))

    return stage(wall, seen_from_deck, turns, xd[3:], xdd)


def poses(
    seg_a: Segment, seg_b: Segment, i: int | jax.Array
) -> tuple[tuple[Mat, Vec], tuple[Mat, Vec]]:
    """((R, p) of A, (R, p) of B): the decks' poses in the world I at physics step i, m."""
    xa, _, _ = seg_a.at(i)
    xb, _, _ = seg_b.at(i)
    r_a = rotation_rpy(xa[3], xa[4], xa[5])
    r_b = matmul(REST_B, rotation_rpy(xb[3], xb[4], xb[5]))
    return (r_a, (xa[0], xa[1], xa[2])), (r_b, vadd(REST_B_M, (xb[0], xb[1], xb[2])))


def goal_in_base(
    seg_a: Segment, seg_b: Segment, goal_m: jax.Array, i: int | jax.Array
) -> tuple[Mat, Vec]:
    """T_G^B = (R_B_G, p_B_G): the goal as seen from the arm's base at physics step i.

    Args:
        goal_m: (3,) position of the goal on vessel B, m.
    """
    (r_a, p_a), (r_b, p_b) = poses(seg_a, seg_b, i)
    goal = vadd(p_b, matvec(r_b, unpack(goal_m, 3)))
    to_base = transpose(r_a)
    return matmul(matmul(to_base, r_b), GOAL_ROTATION), matvec(to_base, vsub(goal, p_a))


def goal_pose(
    motion: Motion,
    track: Track,
    goal_m: jax.Array,
    step: jax.Array,
    wall: jax.Array | None = None,
) -> tuple[Mat, Vec]:
    """T_G^B at a physics step counted from the episode's beginning.

    Args:
        goal_m: (3,) position of the goal on vessel B at that step, m.
        wall: see `mcx_jax.compute.fusion`.
    """
    seg_a = segment(motion.knots_a, track.table, track.start_a + step, wall)
    seg_b = segment(motion.knots_b, track.table, track.start_b + step, wall)
    return stage(wall, goal_in_base, seg_a, seg_b, goal_m, 0)


def draw_goal(uniform: jax.Array) -> jax.Array:
    """(3,) goal position on vessel B, m, from three uniform numbers in [0, 1)."""
    low, high = jnp.asarray(GOAL_LOW_M), jnp.asarray(GOAL_HIGH_M)
    return low + (high - low) * uniform


assert KNOT_STEPS % SUBSTEPS == 0 and math.isclose(KNOT_STEPS * 0.002, 0.1)
