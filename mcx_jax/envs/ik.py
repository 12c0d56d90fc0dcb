"""Forward and inverse kinematics of the arm in frame B (the arm's base).

Damped least squares (Wampler 1986) with the meaning of dm_control's `qpos_from_site_pose`: error =
position error plus rotation vector error (weight 1), damping 3e-2 only while the error norm is
above 0.1, steps of at most 2 rad. A fixed number of iterations replaces its tests for progress.

The step is taken in task space: (J^T J + d 1)^-1 J^T e = J^T (J J^T + d 1)^-1 e, a 6x6 solve for
any number of joints, and the least-norm step where there are more than six.
"""

import functools

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax

from mcx_jax.envs import chain
from mcx_jax.envs.model import ChainModel
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
    """() |position error| m + |rotation error| rad before the last step (a bound on what is left)."""
    ok: jax.Array
    """() bool: error below TOLERANCE and finite."""


def tool_pose(model: ChainModel, q: tuple[Scalar, ...]) -> tuple[Mat, Vec]:
    """(R_B_E, p_B_E) of the tool site at joint angles q (rad), metres."""
    r, p, _, _ = _kinematics(model, q)
    return r, p


def _kinematics(model: ChainModel, q) -> tuple[Mat, Vec, list[Vec], list[Vec]]:
    """Tool pose, and each hinge's axis and anchor, in B."""
    r, p = EYE, ZERO
    axes, anchors = [], []
    for link, rotation in zip(model.links, chain.link_rotations(model, q), strict=True):
        p = vadd(p, matvec(r, link.position))
        r = matmul(r, rotation)
        axes.append((r[0][2], r[1][2], r[2][2]))
        anchors.append(p)
    tool = vadd(p, matvec(r, model.site_position))
    return matmul(r, model.site_rotation), tool, axes, anchors


def _newton(model: ChainModel, q: tuple, target: tuple[Mat, Vec]) -> tuple[tuple, Scalar]:
    """One damped least-squares step and the error norm before it.

    Differentiable in `target` with the Jacobian as is (its own derivative multiplies the error,
    which is zero at the solution: the implicit function theorem).
    """
    frozen = tuple(lax.stop_gradient(x) for x in q)
    r, p, axes, anchors = _kinematics(model, frozen)
    e_p = vsub(target[1], p)
    e_r = log_rotation(matmul(target[0], transpose(r)))
    error = norm(e_p) + norm(e_r)
    columns = [(*cross(z, vsub(p, o)), *z) for z, o in zip(axes, anchors, strict=True)]
    damping = jnp.where(error > REGULARISATION_ABOVE, REGULARISATION, 0.0)
    step = _least_squares(columns, (*e_p, *e_r), lax.stop_gradient(damping))
    length = norm(step)
    shrink = jnp.where(length > MAX_STEP_RAD, MAX_STEP_RAD / jnp.maximum(length, 1e-9), 1.0)
    moved = tuple(x + shrink * dx for x, dx in zip(frozen, step, strict=True))
    return _within_limits(model, moved), error


def _least_squares(columns: list[tuple], e: tuple, damping: Scalar) -> list[Scalar]:
    """J^T (J J^T + damping 1)^-1 e for J given by its columns (one 6-vector a joint)."""
    gram = [
        [total([mul(col[i], col[j]) for col in columns]) for j in range(i + 1)] for i in range(6)
    ]
    # Ten roundings of the largest possible entry keep the pivots positive at a singular posture.
    floor = 10.0 * jnp.finfo(jnp.result_type(e[0])).eps
    for i in range(6):
        gram[i][i] = add(gram[i][i], damping + floor)
    multipliers = chain.solve(chain.factor(gram), e)
    return [dot(col, multipliers) for col in columns]  # type: ignore[arg-type]


def _within_limits(model: ChainModel, q: tuple) -> tuple:
    return tuple(
        x if link.q_range[0] == -float("inf") else jnp.clip(x, *link.q_range)
        for x, link in zip(q, model.links, strict=True)
    )


def solve(
    model: ChainModel, q_start: jax.Array, target: tuple[Mat, Vec], iterations: int
) -> IKResult:
    """Joint angles that bring the tool to a pose.

    Args:
        q_start: (nq,) where the search starts, rad; the branch next to it is found.
        target: (R_B_H, p_B_H), rotation and position (m) of the wanted tool pose in B.
        iterations: damped least-squares steps.

    Returns:
        IKResult. Its gradient by `target` is the implicit function theorem's, J^+ de; the gradient
        by `q_start` is zero. A non-finite solve returns q_start with ok = False.
    """
    start = tuple(lax.stop_gradient(q_start[i]) for i in range(model.nq))
    q, error = _iterate(model, iterations, start, target)
    error = lax.stop_gradient(error)
    finite = jnp.isfinite(error)
    q = tuple(jnp.where(finite, x, s) for x, s in zip(q, start, strict=True))
    return IKResult(q=jnp.stack(q), error=error, ok=finite & (error < TOLERANCE))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _iterate(model: ChainModel, iterations: int, start: tuple, target: tuple[Mat, Vec]):
    """(joint angles, error norm before the last step) after some damped least-squares steps."""

    def body(_, carry):
        return _newton(model, carry[0], target)

    unknown = jnp.full_like(start[0], jnp.inf)
    return lax.fori_loop(0, iterations, body, (start, unknown))


@_iterate.defjvp
def _iterate_jvp(model, iterations, primals, tangents):
    """One Newton step at the solution, differentiated by the target alone."""
    q, error = _iterate(model, iterations, *primals)
    _, dq = jax.jvp(lambda t: _newton(model, q, t)[0], (primals[1],), (tangents[1],))
    return (q, error), (dq, jnp.zeros_like(error))
