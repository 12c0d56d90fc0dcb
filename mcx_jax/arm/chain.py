"""The chain engine: a serial hinge arm, its servos and MuJoCo's integrators.

The dynamics are `envs.dynamics`, their reverse mode is `envs.adjoint`.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from mcx_jax.arm.adjoint import inverse_dynamics_gradient
from mcx_jax.arm.dynamics import BaseState, bias_forces, factor, joint_sincos, mass_matrix, solve
from mcx_jax.arm.model import Actuator, ChainModel
from mcx_jax.arm.plant import Plant, carried_by
from mcx_jax.compute.fusion import stage
from mcx_jax.spatial import Scalar, add, mul, sub, total

SMOOTH = "-smooth"
"""Ending of an integrator's name that changes its derivative, see `joint_accelerations`."""


def actuate(
    model: ChainModel,
    q: Sequence[Scalar],
    qd: Sequence[Scalar],
    ctrl: Sequence[Scalar],
    limited: bool = True,
) -> tuple[list[Scalar], list[Scalar]]:
    """Joint torques of actuators and dampers, and minus their derivative by joint velocity.

    Args:
        limited: False leaves out the limits of commands and forces.

    Returns:
        (torque N m, damping N m s/rad), one of each a joint. With limits, the damping of an
        actuator at its force limit is left out.
    """
    torque = [mul(-link.damping, rate) for link, rate in zip(model.links, qd, strict=True)]
    damping: list[Scalar] = [link.damping for link in model.links]
    for actuator, command in zip(model.actuators, ctrl, strict=True):
        j = actuator.joint
        force, slope = _actuator_force(actuator, q[j], qd[j], command, limited)
        torque[j] = add(torque[j], mul(actuator.gear, force))
        damping[j] = add(damping[j], mul(actuator.gear**2, slope))
    return torque, damping


def _actuator_force(
    act: Actuator, q: Scalar, qd: Scalar, ctrl: Scalar, limited: bool
) -> tuple[Scalar, Scalar]:
    if limited and act.ctrl_range is not None:
        ctrl = jnp.clip(ctrl, *act.ctrl_range)
    b0, b1, b2 = act.bias
    # kp (ref - q) as one product: two products of 1e5 would cost 2 more digits of float32.
    if b1 == -act.gain and act.gear == 1.0:
        force = add(mul(act.gain, ctrl - q), add(b0, mul(b2, qd)))
    elif b2 == -act.gain and act.gear == 1.0 and b1 == 0.0:
        force = add(mul(act.gain, ctrl - qd), b0)
    else:
        length, velocity = mul(act.gear, q), mul(act.gear, qd)
        force = total([mul(act.gain, ctrl), b0, mul(b1, length), mul(b2, velocity)])
    if not limited or act.force_range is None:
        return force, -b2
    low, high = act.force_range
    slope = 0.0 if b2 == 0.0 else jnp.where((force > low) & (force < high), -b2, 0.0)
    return jnp.clip(force, low, high), slope


Motors = tuple[tuple, tuple, tuple]
"""(q rad, qd rad/s, ctrl), one scalar a joint or actuator."""


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def joint_accelerations(
    model: ChainModel,
    integrator: str,
    motors: Motors,
    base: BaseState,
    wall: jax.Array | None,
    plant: Plant | None,
) -> tuple[Scalar, ...]:
    """The acceleration that MuJoCo's integrator multiplies by the time step, rad/s2.

    euler: M + h D with the joints' own damping D (without any, this is the forward dynamics).
    implicitfast: the actuators' velocity derivative as well, but for those at their force limit.
    quiet: for these, too, as MuJoCo's implicitfast was until 3.4.0; 3.5.0 left them out, and servos
    have chattered under it ever since: wrist 3 of the arm `paper` is at its limit of 56 N m when
    0.056 rad/s off its command, and 56 N m change the speed of its 1 kg m2 by 0.112 rad/s in one
    step of 2 ms, past the command and to the other limit.
    mixed: euler or quiet, as the plant says.

    With the ending -smooth: the same values with the derivative of a quiet step whose servos have
    no limits. The true derivative is useless here: a jump of 1
    mrad in a command already takes a servo of kp 1e5 to its torque limit, where the derivative by
    the command is 0 and that by the state the free arm's, which grows. What brings the arm to its
    reference within the control step is the switching, which no derivative sees. (Over 20 control
    steps the true gradient grew by 2 a step, to 1e3 times what central differences of 0.2 mm show.)

    The reverse mode is the implicit function theorem's: with (M + h D) qdd + bias = torque and a
    cotangent g of qdd, the cotangents are those of mu . (torque - (M + h D) qdd - bias) for
    mu = (M + h D)^-1 g: one more solve and one reverse sweep of the inverse dynamics, neither the
    mass matrix nor its factors are differentiated (compare Carpentier & Mansard, RSS 2018).
    """
    return _accelerations(model, integrator, motors, base, wall, plant)[0]


def _accelerations(
    model: ChainModel, integrator: str, motors: Motors, base: BaseState, wall, plant
):
    """(value, (accelerations, factors, angles)): the latter are what the gradient needs."""
    model = carried_by(model, plant)
    q, qd, ctrl = motors
    angles = stage(wall, partial(joint_sincos, model), q)
    bias = stage(wall, partial(bias_forces, model), angles, qd, base)
    matrix = stage(wall, partial(mass_matrix, model), angles)
    torque, slopes = actuate(model, q, qd, ctrl)
    rhs = [sub(t, b) for t, b in zip(torque, bias, strict=True)]

    def factored(damping):
        return stage(wall, factor, _stiffened(matrix, damping, model.timestep_s))

    name = integrator.removesuffix(SMOOTH)
    slopes = slopes if name == "implicitfast" else _full_damping(model)
    factors = factored(_damping(model, name, slopes, plant))
    value = tuple(stage(wall, solve, factors, rhs))
    if name != integrator and name != "quiet":  # quiet's own factors are these already
        factors = factored(_full_damping(model))
    return value, (value, factors, angles)


def _full_damping(model: ChainModel) -> list[Scalar]:
    """Dampers' and actuators' damping of each joint with no actuator at its limit, N m s/rad."""
    damping: list[Scalar] = [link.damping for link in model.links]
    for act in model.actuators:
        damping[act.joint] = add(damping[act.joint], -act.bias[2] * act.gear**2)
    return damping


def _damping(model: ChainModel, integrator: str, slopes: list[Scalar], plant: Plant | None):
    """D of M + h D: the part of the damping that an integrator treats implicitly."""
    passive = [link.damping for link in model.links]
    if integrator == "mixed":
        assert plant is not None
        share = plant.quiet
        return [add(p, mul(share, sub(s, p))) for p, s in zip(passive, slopes, strict=True)]
    return {"euler": passive, "implicitfast": slopes, "quiet": slopes}[integrator]


def _accelerations_forward(model, integrator, motors, base, wall, plant):
    value, kept = _accelerations(model, integrator, motors, base, wall, plant)
    return value, (motors, base, wall, plant, kept)


def _accelerations_backward(model, integrator, saved, cotangent):
    motors, base, wall, plant, (accelerations, factors, angles) = saved
    model = carried_by(model, plant)
    q, qd, ctrl = motors
    mu = stage(wall, solve, factors, cotangent)
    d_q, d_qd, d_base = inverse_dynamics_gradient(model, wall, angles, qd, accelerations, base, mu)
    limited = not integrator.endswith(SMOOTH)
    _, pull = jax.vjp(lambda q, qd, ctrl: actuate(model, q, qd, ctrl, limited)[0], q, qd, ctrl)
    by_torque: Any = pull(list(mu))
    d_motors = (_minus(by_torque[0], d_q), _minus(by_torque[1], d_qd), by_torque[2])
    return d_motors, jax.tree.map(lambda x: -x, d_base), None, None


def _minus(a: Sequence[Scalar], b: Sequence[Scalar]) -> tuple[Scalar, ...]:
    return tuple(sub(x, y) for x, y in zip(a, b, strict=True))


joint_accelerations.defvjp(_accelerations_forward, _accelerations_backward)


def _stiffened(matrix: list[list[Scalar]], slopes: Sequence[Scalar], h_s: float):
    """M + h D."""
    return [
        [*row[:-1], add(row[-1], mul(h_s, slope))]
        for row, slope in zip(matrix, slopes, strict=True)
    ]


def substep(
    model: ChainModel,
    integrator: str,
    q: Sequence[Scalar],
    qd: Sequence[Scalar],
    ctrl: Sequence[Scalar],
    base: BaseState,
    wall: jax.Array | None = None,
    plant: Plant | None = None,
) -> tuple[list[Scalar], list[Scalar]]:
    """One physics step, semi-implicit as MuJoCo: new velocities, then positions with them."""
    h = model.timestep_s
    motors = (tuple(q), tuple(qd), tuple(ctrl))
    qdd: Any = joint_accelerations(model, integrator, motors, base, wall, plant)
    qd = [v + h * a for v, a in zip(qd, qdd, strict=True)]
    return [x + h * v for x, v in zip(q, qd, strict=True)], qd


def substeps(
    model: ChainModel,
    integrator: str,
    q: jax.Array,
    qd: jax.Array,
    ctrl: jax.Array,
    base_at: Callable[[jax.Array], BaseState],
    count: int,
    wall: jax.Array | None = None,
    plant: Plant | None = None,
) -> tuple[jax.Array, jax.Array]:
    """`count` physics steps with the actuator commands held.

    Args:
        q: (nq,) joint angles, rad.
        qd: (nq,) joint velocities, rad/s.
        ctrl: (nu,) actuator commands in the model's order.
        base_at: base motion at physics step i of this control step.
        wall: see `stage`.
        plant: what differs from the model in this episode.

    Returns:
        (q, qd) after the steps.
    """
    commands = [ctrl[i] for i in range(len(model.actuators))]

    def body(i, state):
        angles, rates = state
        base = base_at(i)
        angles, rates = substep(model, integrator, angles, rates, commands, base, wall, plant)
        return tuple(angles), tuple(rates)

    n = model.nq
    start = (tuple(q[i] for i in range(n)), tuple(qd[i] for i in range(n)))
    angles, rates = lax.fori_loop(0, count, body, start)
    return jnp.stack(angles), jnp.stack(rates)
