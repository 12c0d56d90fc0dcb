"""C MuJoCo in float64 as the reference for an arm on a base whose motion is prescribed."""

import functools

import mujoco
import numpy as np

from mcx_jax.arm.model import load_mujoco


def free_base_model(arm: str | mujoco.MjModel) -> mujoco.MjModel:
    """The arm on a free body (6 dof): its base can be given any pose, velocity, acceleration."""
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="deck")
    body.add_freejoint(name="deck_joint")
    body.mass, body.inertia = 1.0, [1.0, 1.0, 1.0]
    body.explicitinertial = True
    child = mujoco.MjSpec.from_file(arm) if isinstance(arm, str) else arm
    spec.option.integrator = child.option.integrator  # not used: attaching warns if they differ
    body.add_frame().attach_body(child.worldbody.first_body(), "", "")
    spec.option.disableflags = int(
        mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    )
    spec.option.timestep = child.option.timestep
    return spec.compile()


@functools.cache
def scratch(m: mujoco.MjModel) -> mujoco.MjData:
    """One scratch for every model: allocation takes ten times as long as a step."""
    return mujoco.MjData(m)


def arm_path(name: str) -> str:
    """File of a named arm."""
    from mcx_jax.arm.model import ARMS
    from mcx_jax.assets import asset_path

    return str(asset_path(ARMS[name]))


def acceleration(
    m: mujoco.MjModel,
    q: np.ndarray,
    qd: np.ndarray,
    ctrl: np.ndarray,
    rotation: np.ndarray,
    w: np.ndarray,
    al: np.ndarray,
    acc: np.ndarray,
    implicit: np.ndarray | float = 0.0,
) -> np.ndarray:
    """Joint accelerations with the base's acceleration prescribed.

    Args:
        rotation: (3, 3) R_I_B; w, al: angular velocity and acceleration in B axes.
        acc: (3,) linear acceleration of the base origin in world axes (without gravity).
        implicit: (nq,) added to the mass matrix's diagonal.

    Solves the arm's rows of M qacc + bias = tau for the arm, with the base's qacc given.
    """
    d = scratch(m)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(rotation).ravel())
    d.qpos[3:7], d.qpos[7:] = quat, q
    d.qvel[3:6], d.qvel[6:] = w, qd  # a free joint's angular velocity is in body axes
    d.ctrl[:] = ctrl
    mujoco.mj_forward(m, d)
    full = np.zeros((m.nv, m.nv))
    mujoco.mj_fullM(m, d, full)
    base = np.concatenate([acc, al])
    rhs = d.qfrc_actuator[6:] + d.qfrc_passive[6:] - d.qfrc_bias[6:] - full[6:, :6] @ base
    return np.linalg.solve(full[6:, 6:] + np.diag(np.broadcast_to(implicit, len(q))), rhs)


def implicit_damping(fixed: mujoco.MjModel, q, qd, ctrl, at_limits: bool = False) -> np.ndarray:
    """(nq,) what implicitfast adds to the mass matrix: step times the servos' velocity derivative,
    none at a force limit (unless `at_limits`). `fixed` is the arm on a fixed base."""
    d = scratch(fixed)
    d.qpos[:], d.qvel[:], d.ctrl[:] = q, qd, ctrl
    mujoco.mj_fwdPosition(fixed, d)
    mujoco.mj_fwdVelocity(fixed, d)
    mujoco.mj_fwdActuation(fixed, d)
    limit = np.where(fixed.actuator_forcelimited, fixed.actuator_forcerange[:, 1], np.inf)
    inside = at_limits | (np.abs(d.actuator_force) < limit)
    slope = -fixed.actuator_biasprm[:, 2] * inside
    implicit = np.zeros(fixed.nv)
    np.add.at(implicit, fixed.actuator_trnid[:, 0], fixed.opt.timestep * slope)
    return implicit


__all__ = [
    "acceleration",
    "arm_path",
    "free_base_model",
    "implicit_damping",
    "load_mujoco",
    "scratch",
]
