"""Reverse mode of the inverse dynamics, link by link.

XLA's reverse mode of the whole recursion has no walls: each of its ~25 results recomputes what it
shares with the others (`mcx_jax.compute.fusion`). Here every link is a stage of its own, forward
and back.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from mcx_jax.arm.dynamics import BaseState, inertial_wrench, link_motion
from mcx_jax.arm.model import ChainModel, Link
from mcx_jax.compute.fusion import split_floats, stage
from mcx_jax.spatial import ZERO, Scalar, Vec, add, cross, dot, mul, rotate_z, sub, tmatvec, vadd

Carry = tuple[BaseState, tuple[Vec, Vec]]
"""Motion (w, al, a) of a link, and its virtual twist (angular, linear at its origin)."""
Joint = tuple[Scalar, Scalar, Scalar, Scalar, Scalar]
"""(sin, cos, rate rad/s, acceleration rad/s2, virtual velocity) of a joint."""


def inverse_dynamics_gradient(
    model: ChainModel,
    wall: jax.Array | None,
    angles: Sequence[tuple[Scalar, Scalar]],
    qd: Sequence[Scalar],
    qdd: Sequence[Scalar],
    base: BaseState,
    mu: Sequence[Scalar],
) -> tuple[list[Scalar], list[Scalar], BaseState]:
    """Gradient of mu . tau(q, qd, qdd, base), tau the torques of the inverse dynamics.

    mu . tau is the power of the links' inertial wrenches on the virtual motion in which the joints
    move with velocities mu: one recursion from base to tip, without the one back.

    Args:
        angles: (sin, cos) of every joint.
        mu: one weight a joint, constant.

    Returns:
        Derivatives by q, by qd and by base. (That by the damping terms h D qdd is not in here.)
    """
    joints = [(*a, r, x, m) for a, r, x, m in zip(angles, qd, qdd, mu, strict=True)]
    carries: list[Carry] = [(base, (ZERO, ZERO))]
    for link, joint in zip(model.links[:-1], joints[:-1], strict=True):
        carries.append(stage(wall, partial(_advance, link), carries[-1], joint))
    d_q: list[Scalar] = [0.0] * model.nq
    d_qd: list[Scalar] = [0.0] * model.nq
    d_carry: Any = None
    for i in reversed(range(model.nq)):
        pull = partial(_pull_back, model.links[i])
        d_carry, d_q[i], d_qd[i] = stage(wall, pull, carries[i], joints[i], d_carry)
    return d_q, d_qd, d_carry[0]


def _advance(link: Link, carry: Carry, joint: Joint) -> Carry:
    """A link's motion and virtual twist from its parent's."""
    motion, (turn, shift) = carry
    sin, cos, rate, accel, mu = joint
    r = rotate_z(link.rotation, cos, sin)
    shift = tmatvec(r, vadd(shift, cross(turn, link.position)))
    turn = vadd(tmatvec(r, turn), (0.0, 0.0, mu))
    return link_motion(link, r, rate, accel, motion), (turn, shift)


def _power(link: Link, carry: Carry, joint: Joint) -> tuple[Carry, Scalar]:
    """`_advance`, and the power of the link's inertial wrench on its virtual twist."""
    after = _advance(link, carry, joint)
    force, moment = inertial_wrench(link, *after[0])
    turn, shift = after[1]
    return after, add(dot(shift, force), dot(turn, moment))


def _pull_back(link: Link, carry: Carry, joint: Joint, d_after: Any) -> tuple[Any, Scalar, Scalar]:
    """Derivatives of all power from this link to the tip by the parent's carry, and by the joint's
    angle and rate. d_after: the same by this link's carry from the links beyond; None at the tip.
    """
    moving = (joint[0], joint[1], joint[2])
    traced, join = split_floats((carry, moving))

    def power(traced):
        carry, moving = join(traced)
        after, own = _power(link, carry, (*moving, *joint[3:]))
        if d_after is None:
            return own
        return add(own, _inner(after, d_after))

    # Not jax.grad: in a whole batch (`compute.batch_last`) the power is one number per environment.
    value, pull = jax.vjp(power, traced)
    (gradient,) = pull(jnp.ones_like(value))
    d_carry, (d_sin, d_cos, d_rate) = join(gradient)
    sin, cos = joint[0], joint[1]
    return d_carry, sub(mul(cos, d_sin), mul(sin, d_cos)), d_rate


def _inner(a: Any, b: Any) -> Scalar:
    """Sum of products of corresponding leaves."""
    products = [mul(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)]
    return sum(products[1:], products[0])
