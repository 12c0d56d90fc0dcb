"""MuJoCo's own JAX engine behind the same function as `chain`: the reference inside JAX.

The arm's base is fixed and gravity is zero; the deck's motion enters as the inertial force and
torque of the moving frame on every body (`xfrc_applied`), computed from MJX's own positions,
velocities and inertias, so the two engines check each other.
"""

import copy
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
from jax import lax
from mujoco import mjx

from mcx_jax.envs.dynamics import BaseState

INTEGRATORS = {
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}


def put_model(mj: mujoco.MjModel, integrator: str) -> mjx.Model:
    """The model on the device: zero gravity, wanted integrator, no contact or constraint work."""
    mj = copy.copy(mj)
    mj.opt.gravity[:] = 0.0
    mj.opt.integrator = INTEGRATORS[integrator]
    mj.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    mj.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    return mjx.put_model(mj)


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
) -> tuple[jax.Array, jax.Array]:
    """`count` physics steps; arguments and result as `chain.substeps`."""
    blank = mjx.make_data(m)

    def body(i, state):
        d = blank.replace(qpos=state[0], qvel=state[1], ctrl=ctrl)
        d = mjx.com_vel(m, mjx.com_pos(m, mjx.kinematics(m, d)))
        d = mjx.step(m, d.replace(xfrc_applied=inertial_wrenches(m, d, base_at(i))))
        return d.qpos, d.qvel

    return lax.fori_loop(0, count, body, (q, qd))
