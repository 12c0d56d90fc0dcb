"""`mjx.step` for serial hinge arms, computed by the chain engine: change one import.

    from mcx_jax.integrations.mjx_step import step
    m = mcx_jax.integrations.mjx_step.put_model(mj)  # or mjx.put_model

The model's numbers are read from `mjx.Model` while tracing. What is concrete (a model closed over,
the usual case) becomes Python floats, whose zeros and ones vanish from the program; what is traced
(a model that is an argument of `jit`, masses randomised by `vmap`) stays traced: right, but slower.
"""

import copy

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.core import Tracer

from mcx_jax.arm import dynamics
from mcx_jax.arm.fields import refuse_unsupported
from mcx_jax.arm.mjx_engine import on_device
from mcx_jax.arm.model import with_joints_carrying_servos
from mcx_jax.arm.quiet_mjx import mjx
from mcx_jax.integrations.mjx_model import Arm, compose, read
from mcx_jax.spatial import (
    EYE,
    ZERO,
    Scalar,
    add,
    cross,
    dot,
    matvec,
    mul,
    sub,
    total,
    transpose,
    vadd,
    vscale,
    vsub,
)


def put_model(mj: mujoco.MjModel) -> mjx.Model:
    """`mjx.put_model` of a serial arm, without loss: the armature and damping of actuators, which
    MJX drops, become their joints'.

    Raises:
        UserError: the model has something that the chain engine does not model (springs of joints
            it takes here), or MJX does not take it.
    """
    springless = copy.copy(mj)
    springless.jnt_stiffness[:] = 0.0
    refuse_unsupported(springless)
    whole = with_joints_carrying_servos(mj)
    mujoco.mj_setConst(whole, mujoco.MjData(whole))  # `read` compares dof_M0
    return on_device(whole)


def step(m: mjx.Model, d: mjx.Data) -> mjx.Data:
    """One physics step; arguments, result and units as `mjx.step`.

    Taken from `d`: qpos, qvel, ctrl, qfrc_applied, xfrc_applied, time. Works under `jit`, `vmap`
    and differentiation, with `m` closed over or as an argument.

    Filled in the result, as `mjx.step` does: qpos, qvel, time (after the step); qacc, qacc_smooth,
    qacc_warmstart, qfrc_bias, qfrc_passive, qfrc_actuator, qfrc_smooth, actuator_force,
    actuator_length (of the state before it). NOT filled, left as they came: everything Cartesian
    (xpos, xquat, site_xpos, geom_xpos, subtree_com, cvel, cdof, ...), sensordata and private
    fields. `mjx.kinematics(m, d)` or `mjx.forward(m, d)` fills them, once where they are read
    instead of in every step.

    Differs from `mjx.step` in one thing, where it follows C MuJoCo: under implicitfast the velocity
    derivative of an actuator at its force limit is left out.

    Raises:
        UserError: the model is not a serial arm of hinges, or has something else that the chain
            engine does not model (contacts, active limits, ...). Numbers that are traced cannot be
            looked at: polynomial stiffness and damping are then ignored, as `mjx.step` does. So is
            damping of actuators in a model that `mjx.put_model` has made: it is not in there.
    """
    arm = read(m)
    n = arm.model.nq
    q, qd = [d.qpos[i] for i in range(n)], [d.qvel[i] for i in range(n)]
    angles = dynamics.joint_sincos(arm.model, q)
    bias = dynamics.bias_forces(arm.model, angles, qd, (ZERO, ZERO, vscale(-1.0, arm.gravity)))
    lengths, forces, actuation, slopes = _actuate(arm, q, qd, d.ctrl)
    dampings = [link.damping for link in arm.model.links]
    passive = [
        sub(mul(-k, x - rest), mul(c, v))
        for (k, rest), c, x, v in zip(arm.springs, dampings, q, qd, strict=True)
    ]
    applied = [d.qfrc_applied[i] + x for i, x in enumerate(_cartesian(arm, angles, d.xfrc_applied))]
    smooth = [total([-b, *x]) for b, *x in zip(bias, passive, actuation, applied, strict=True)]
    matrix = dynamics.mass_matrix(arm.model, angles)
    qacc = dynamics.solve(dynamics.factor(matrix), smooth)
    if arm.model.integrator == "implicitfast":
        dampings = [add(x, y) for x, y in zip(dampings, slopes, strict=True)]
    h_s = arm.timestep_s
    for row, damping in zip(matrix, dampings, strict=True):
        row[-1] = add(row[-1], mul(h_s, damping))
    damped = any(not (isinstance(x, float) and x == 0.0) for x in dampings)
    advance = dynamics.solve(dynamics.factor(matrix), smooth) if damped else qacc
    qd = [v + h_s * a for v, a in zip(qd, advance, strict=True)]
    q = [x + h_s * v for x, v in zip(q, qd, strict=True)]

    def array(xs):
        return jnp.stack([jnp.asarray(x, d.qpos.dtype) for x in xs]) if xs else jnp.zeros(0)

    acceleration = array(qacc)
    return d.replace(
        qpos=array(q),
        qvel=array(qd),
        time=d.time + h_s,
        qacc=acceleration,
        qacc_smooth=acceleration,
        qacc_warmstart=acceleration,
        qfrc_bias=array(bias),
        qfrc_passive=array(passive),
        qfrc_actuator=array(actuation),
        qfrc_smooth=array(smooth),
        actuator_force=array(forces),
        actuator_length=array(lengths),
    )


def _actuate(arm: Arm, q: list, qd: list, ctrl: jax.Array):
    """(lengths, forces) of the actuators, (torque N m, damping N m s/rad) of the joints."""
    lengths, forces = [], []
    torques: list[Scalar] = [0.0] * len(q)
    slopes: list[Scalar] = [0.0] * len(q)
    for i, act in enumerate(arm.actuators):
        command = ctrl[i] if act.ctrl_range is None else jnp.clip(ctrl[i], *act.ctrl_range)
        length, velocity = mul(act.gear, q[act.joint]), mul(act.gear, qd[act.joint])
        b0, b1, b2 = act.bias
        # A servo (b1 = -gain) of 1e5 N m/rad loses 2 digits of float32 if its force is the
        # difference of two products. This form needs no branch on a traced gain.
        servo = mul(act.gain, command - length), mul(act.gain + b1, length)
        motor = (mul(act.gain, command),)
        shape = motor if isinstance(b1, float) and b1 == 0.0 else servo
        force = total([*shape, b0, mul(b2, velocity)])
        slope = -b2
        if act.force_range is not None:
            low, high = act.force_range
            inside = (force > low) & (force < high)
            slope = 0.0 if isinstance(b2, float) and b2 == 0.0 else jnp.where(inside, slope, 0.0)
            force = jnp.clip(force, low, high)
        lengths.append(length)
        forces.append(force)
        torques[act.joint] = add(torques[act.joint], mul(act.gear, force))
        slopes[act.joint] = add(slopes[act.joint], mul(mul(act.gear, act.gear), slope))
    return lengths, forces, torques, slopes


def _cartesian(arm: Arm, angles: list, xfrc: jax.Array) -> list[Scalar]:
    """Joint torques of (nbody, 6) force N and torque N m at the centres of mass, in world axes."""
    n = arm.model.nq
    if not isinstance(xfrc, Tracer) and not np.any(np.asarray(xfrc)):
        return [0.0] * n
    rotation, origin = EYE, ZERO
    frames = []
    for link, turn in zip(arm.model.links, dynamics.link_rotations(arm.model, angles), strict=True):
        rotation, origin = compose((rotation, origin), (turn, link.position))
        frames.append((rotation, origin))
    torques: list[Scalar] = [0.0] * n
    force, moment = ZERO, ZERO  # about the world's origin, of everything from link i outwards
    for i in reversed(range(n)):
        rotation, origin = frames[i]
        for body, link, centre in arm.masses:
            if link == i:
                f, t = tuple(xfrc[body, k] for k in range(3)), tuple(xfrc[body, 3:])
                at = vadd(origin, matvec(rotation, centre))
                force, moment = vadd(force, f), vadd(moment, vadd(t, cross(at, f)))  # type: ignore[arg-type]
        z = transpose(rotation)[2]
        torques[i] = dot(z, vsub(moment, cross(origin, force)))
    return torques
