"""Forward and inverse kinematics of the arm in frame B (the arm's base).

Damped least squares (Wampler 1986) with the meaning of dm_control's `qpos_from_site_pose`: error =
position error plus rotation vector error (weight 1), damping 3e-2 only while the error norm is
above 0.1, steps of at most 2 rad. A fixed number of iterations replaces its tests for progress.

The step is taken in task space: (J^T J + d 1)^-1 J^T e = J^T (J J^T + d 1)^-1 e, a 6x6 solve for
any number of joints, and the least-norm step where there are more than six.
"""

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax

from mcx_jax.arm import dynamics
from mcx_jax.arm.model import ChainModel
from mcx_jax.compute.fusion import stage
from mcx_jax.spatial import (
    EYE,
    ZERO,
    Mat,
    Scalar,
    Vec,
    add,
    cross,
    dot,
    log_rotation,
    matmul,
    matvec,
    mul,
    norm,
    total,
    transpose,
    vadd,
    vsub,
)

REGULARISATION = 3e-2
"""Damping of the normal equations far from the target (dm_control's default)."""
REGULARISATION_ABOVE = 0.1
"""Error norm above which the damping applies (dm_control's default)."""
MAX_STEP_RAD = 2.0
"""Norm of the longest joint step (dm_control's default)."""
WARM_ITERATIONS = 4
"""Newton steps from the previous joint angles. They converge quadratically: a lag of 30 mm leaves
1e-3, 1e-6, then float32's 1e-7; the fourth is for the worst postures."""
COLD_ITERATIONS = 12
"""Steps from the start pose at reset; 6 were enough for each of 4,000 goals in the roughest sea."""
TOLERANCE = 1e-4
"""Success below this error norm (m + rad), ten times the float32 noise near a singular posture."""


@struct.dataclass
class IKResult:
    """Result of an inverse kinematics solve; failure is data, not an exception."""

    q: jax.Array
    """(nq,) joint angles, rad."""
    error: jax.Array
    """() |position error| m + |rotation error| rad before the last step: a bound on the rest."""
    ok: jax.Array
    """() bool: error below TOLERANCE and finite."""


def tool_pose(
    model: ChainModel, q: Sequence[Scalar], wall: jax.Array | None = None
) -> tuple[Mat, Vec]:
    """(R_B_E, p_B_E) of the tool site at joint angles q (rad), metres."""
    angles = stage(wall, partial(dynamics.joint_sincos, model), list(q))
    r, p, _, _ = stage(wall, partial(_kinematics, model), angles)
    return r, p


def _kinematics(model: ChainModel, angles) -> tuple[Mat, Vec, list[Vec], list[Vec]]:
    """Tool pose, and each hinge's axis and anchor, in B."""
    r, p = EYE, ZERO
    axes, anchors = [], []
    for link, rotation in zip(model.links, dynamics.link_rotations(model, angles), strict=True):
        p = vadd(p, matvec(r, link.position))
        r = matmul(r, rotation)
        axes.append((r[0][2], r[1][2], r[2][2]))
        anchors.append(p)
    tool = vadd(p, matvec(r, model.site_position))
    return matmul(r, model.site_rotation), tool, axes, anchors


def _newton(
    model: ChainModel, wall: jax.Array | None, q: tuple, target: tuple[Mat, Vec]
) -> tuple[tuple, Scalar]:
    """One damped least-squares step and the error norm before it.

    Differentiable in `target` with the Jacobian as is (its own derivative multiplies the error,
    which is zero at the solution: the implicit function theorem).
    """
    frozen = tuple(lax.stop_gradient(x) for x in q)
    angles = stage(wall, partial(dynamics.joint_sincos, model), frozen)
    r, p, axes, anchors = stage(wall, partial(_kinematics, model), angles)
    e = stage(wall, _pose_error, (r, p), target)
    error = stage(wall, _error_norm, e)
    columns = stage(wall, _jacobian, p, axes, anchors)
    gram = stage(wall, _normal_matrix, columns, lax.stop_gradient(error))
    step = _least_squares(wall, columns, gram, e)
    shrink = stage(wall, _shrink, step)
    moved = tuple(x + shrink * dx for x, dx in zip(frozen, step, strict=True))
    return _within_limits(model, moved), error


def _error_norm(e: Sequence[Scalar]) -> Scalar:
    return norm(e[:3]) + norm(e[3:])


def _jacobian(tool: Vec, axes: list[Vec], anchors: list[Vec]) -> list[tuple]:
    """Columns of the tool's Jacobian in B: what a unit joint rate moves (m) and turns (rad)."""
    return [(*cross(z, vsub(tool, o)), *z) for z, o in zip(axes, anchors, strict=True)]


def _shrink(step: Sequence[Scalar]) -> Scalar:
    """Factor that keeps a step within MAX_STEP_RAD."""
    length = norm(step)
    return jnp.where(length > MAX_STEP_RAD, MAX_STEP_RAD / jnp.maximum(length, 1e-9), 1.0)


def _pose_error(tool: tuple[Mat, Vec], target: tuple[Mat, Vec]) -> tuple[Scalar, ...]:
    """Position error (m) and rotation vector error (rad), both in B."""
    turn = log_rotation(matmul(target[0], transpose(tool[0])))
    return (*vsub(target[1], tool[1]), *turn)


def _normal_matrix(columns: list[tuple], error: Scalar) -> list[list[Scalar]]:
    """Lower triangle of J J^T + damping 1, for J given by its columns (one 6-vector a joint);
    damping where the error norm is large."""
    damping = jnp.where(error > REGULARISATION_ABOVE, REGULARISATION, 0.0)
    gram = [
        [total([mul(col[i], col[j]) for col in columns]) for j in range(i + 1)] for i in range(6)
    ]
    # Ten roundings of the largest possible entry keep the pivots positive at a singular posture.
    floor = 10.0 * jnp.finfo(jnp.result_type(damping)).eps
    for i in range(6):
        gram[i][i] = add(gram[i][i], damping + floor)
    return gram


def _least_squares(wall, columns: list[tuple], gram, e: tuple) -> list[Scalar]:
    """J^T (J J^T + damping 1)^-1 e."""
    factors = stage(wall, dynamics.factor, gram)
    multipliers = stage(wall, dynamics.solve, factors, list(e))

    def combine(columns, multipliers):
        return [dot(col, multipliers) for col in columns]

    return stage(wall, combine, columns, multipliers)


def _within_limits(model: ChainModel, q: tuple) -> tuple:
    return tuple(
        x if link.q_range[0] == -float("inf") else jnp.clip(x, *link.q_range)
        for x, link in zip(q, model.links, strict=True)
    )


def solve(
    model: ChainModel,
    q_start: jax.Array,
    target: tuple[Mat, Vec],
    iterations: int,
    wall: jax.Array | None = None,
) -> IKResult:
    """Joint angles that bring the tool to a pose.

    Args:
        q_start: (nq,) where the search starts, rad; the branch next to it is found.
        target: (R_B_H, p_B_H), rotation and position (m) of the wanted tool pose in B.
        iterations: damped least-squares steps.
        wall: see `stage`.

    Returns:
        IKResult. Its gradient by `target` is the implicit function theorem's, J^+ de; the gradient
        by `q_start` is zero. A non-finite solve returns q_start with ok = False.
    """
    start = tuple(lax.stop_gradient(q_start[i]) for i in range(model.nq))
    q, error = _iterate(model, iterations, wall, start, target)
    error = lax.stop_gradient(error)
    finite = jnp.isfinite(error + total(q))
    q = tuple(jnp.where(finite, x, s) for x, s in zip(q, start, strict=True))
    return IKResult(q=jnp.stack(q), error=error, ok=finite & (error < TOLERANCE))


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _iterate(model: ChainModel, iterations: int, wall, start: tuple, target: tuple[Mat, Vec]):
    """(joint angles, error norm before the last step) after some damped least-squares steps."""

    def body(_, carry):
        return _newton(model, wall, carry[0], target)

    unknown = jnp.full_like(start[0], jnp.inf)
    return lax.fori_loop(0, iterations, body, (start, unknown))


@_iterate.defjvp
def _iterate_jvp(model, iterations, primals, tangents):
    """One Newton step at the solution, differentiated by the target alone."""
    wall, _, target = primals
    q, error = _iterate(model, iterations, *primals)
    _, dq = jax.jvp(lambda t: _newton(model, wall, q, t)[0], (target,), (tangents[2],))
    return (q, error), (dq, jnp.zeros_like(error))
