"""MJX with the interface of `chain.substeps`: the reference engine in JAX.

The arm's base is fixed and gravity is zero; the deck's motion enters as the inertial force and
torque of the moving frame on every body (`xfrc_applied`), computed from MJX's own positions,
velocities and inertias, so the two engines check each other.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import lax

from mcx_jax.arm.dynamics import BaseState
from mcx_jax.arm.model import with_joints_carrying_servos
from mcx_jax.arm.quiet_mjx import mjx
from mcx_jax.errors import UserError, reason

INTEGRATORS = {
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "quiet": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}


def put_model(mj: mujoco.MjModel, integrator: str) -> mjx.Model:
    """The model on the device: zero gravity, wanted integrator, no contact or constraint work.

    Raises:
        UserError: as `on_device`.
    """
    mj = with_joints_carrying_servos(mj)
    mj.opt.gravity[:] = 0.0
    mj.opt.integrator = INTEGRATORS[integrator]
    mj.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    mj.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    # `servo` limits the commands: MJX gets them counted from the joint angle.
    if mj.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
        mj.actuator_ctrllimited[:] = False
    mj.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
    return on_device(mj)


def on_device(mj: mujoco.MjModel) -> mjx.Model:
    """`mjx.put_model`.

    Raises:
        UserError: MJX lacks something that C MuJoCo has.
    """
    try:
        return mjx.put_model(mj)
    except NotImplementedError as error:
        raise UserError(
            f"MJX cannot take this arm model: {reason(error)}; take that out of the MJCF file, or "
            "use --physics chain"
        ) from None


def servo(
    m: mjx.Model, q: jax.Array, qd: jax.Array, ctrl: jax.Array, integrator: str
) -> tuple[mjx.Model, jax.Array]:
    """The same actuators written so that MJX's own formula gives C's force and derivative.

    MJX forms gain * ctrl + bias . (1, length, velocity). Two things are corrected, by value:
    1. A position servo (bias[1] = -gain) of kp 1e5 subtracts two float32 products of 3e5 N m, 1e-4
       rad/s of noise a step. Its command is counted from the joint angle instead: ctrl - length
       with bias[1] = 0, so one product of the small difference.
    2. implicitfast in C leaves out the velocity derivative of a force at its limit, MJX keeps it,
       as is wanted for the integrator `quiet` alone. At the limit the actuator becomes a constant:
       bias = (limit, 0, 0), command 0.

    Args:
        q: (nq,) joint angles, rad.
        qd: (nq,) joint velocities, rad/s.
        ctrl: (nu,) commands.
        integrator: as `chain.joint_accelerations`.

    Returns:
        (model, commands) for `mjx.step`; control limits are applied here.
    """
    joint, gear = m.actuator_trnid[:, 0], m.actuator_gear[:, 0]
    length, velocity = gear * q[joint], gear * qd[joint]
    affine = m.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE
    gain, bias = m.actuator_gainprm[:, 0], jnp.where(affine[:, None], m.actuator_biasprm, 0.0)
    command = _clip(ctrl, m.actuator_ctrllimited, m.actuator_ctrlrange)
    from_length = affine & (bias[:, 1] == -gain)
    command = jnp.where(from_length, command - length, command)
    bias = bias.at[:, 1].set(jnp.where(from_length, 0.0, bias[:, 1]))
    force = gain * command + bias[:, 0] + bias[:, 1] * length + bias[:, 2] * velocity
    limit = _clip(force, m.actuator_forcelimited, m.actuator_forcerange)
    at_limit = affine & (force != limit)  # a motor has no bias to be rewritten and no derivative
    if integrator == "quiet":
        at_limit = jnp.zeros_like(at_limit)
    constant = jnp.zeros_like(bias).at[:, 0].set(limit)
    bias = jnp.where(at_limit[:, None], constant, bias)
    return m.replace(actuator_biasprm=bias), jnp.where(at_limit, 0.0, command)


def _clip(x: jax.Array, limited: np.ndarray, bounds: jax.Array) -> jax.Array:
    low, high = jnp.where(limited[:, None], bounds, jnp.array([-jnp.inf, jnp.inf])).T
    return jnp.clip(x, low, high)


def inertial_wrenches(m: mjx.Model, d: mjx.Data, base: BaseState) -> jax.Array:
    """(nbody, 6) force N and torque N m at each body's centre of mass, in B axes.

    A body of mass M at r with velocity u and angular velocity v relative to B feels
    -M (a + al x r + w x (w x r) + 2 w x u) and
    -(I (al + w x v) + (w + v) x I (w + v) - v x I v).
    """
    w, al, a = (jnp.stack([jnp.asarray(x, d.qpos.dtype) for x in vector]) for vector in base)
    cross = jnp.cross
    r = d.xipos
    spin = d.cvel[:, :3]
    # cvel is the velocity of the body-fixed point at the subtree's centre of mass.
    u = d.cvel[:, 3:] + cross(spin, r - d.subtree_com[m.body_rootid])
    acceleration = a + cross(al, r) + cross(w, cross(w, r)) + 2.0 * cross(w, u)
    inertia = jnp.einsum("bij,bj,bkj->bik", d.ximat, m.body_inertia, d.ximat)

    def apply(x):
        return jnp.einsum("bij,bj->bi", inertia, x)

    total = w + spin
    torque = apply(al + cross(w, spin)) + cross(total, apply(total)) - cross(spin, apply(spin))
    return -jnp.concatenate([m.body_mass[:, None] * acceleration, torque], axis=1)


def substeps(
    m: mjx.Model,
    q: jax.Array,
    qd: jax.Array,
    ctrl: jax.Array,
    base_at: Callable[[jax.Array], BaseState],
    count: int,
    *,
    integrator: str,
) -> tuple[jax.Array, jax.Array]:
    """`count` physics steps; arguments and result as `chain.substeps`.

    Args:
        integrator: the one that the model was put with.
    """
    blank = mjx.make_data(m)

    def body(i, state):
        q, qd = state
        actuated, commands = servo(m, q, qd, ctrl, integrator)
        d = blank.replace(qpos=q, qvel=qd, ctrl=commands)
        d = mjx.com_vel(m, mjx.com_pos(m, mjx.kinematics(m, d)))
        d = mjx.step(actuated, d.replace(xfrc_applied=inertial_wrenches(m, d, base_at(i))))
        return d.qpos, d.qvel

    return lax.fori_loop(0, count, body, (q, qd))
