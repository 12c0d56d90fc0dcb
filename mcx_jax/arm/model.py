"""A serial chain of hinges read from MuJoCo: constants for `chain` and `ik`, as Python floats.

Each link gets a frame with its origin on the joint's anchor and its z axis along the hinge, so a
link's orientation in its parent is a constant rotation times Rz(q). For arms whose axes are
parallel or perpendicular (nearly all) that constant is a signed permutation, whose zeros and ones
vanish from the traced program.
"""

import copy
import os
import sys
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from mcx_jax.arm.fields import integrator, moving_ancestor, refuse_unsupported
from mcx_jax.assets import asset_path
from mcx_jax.errors import UserError
from mcx_jax.spatial import ZERO, Mat, Scalar, Vec, snap

ARMS = {"paper": "ur10e_paper.xml", "ur10e": "ur10e.xml"}


SEVERAL = -2
"""`jnt_actuatorid` of a joint with several actuators that have armature or damping."""


@dataclass(frozen=True)
class Link:
    """One moving link; all vectors in the link frame (origin on the hinge, z along it)."""

    rotation: Mat
    """Orientation in the parent link's frame at q = 0."""
    position: Vec
    """Origin in the parent link's frame, m."""
    mass: Scalar
    """kg, welded bodies included."""
    moment: Vec
    """First moment of mass: mass times centre of mass, kg m."""
    inertia: tuple[Scalar, Scalar, Scalar, Scalar, Scalar, Scalar]
    """About the link frame's origin: xx, yy, zz, xy, xz, yz, kg m2."""
    armature: float
    """Reflected rotor inertia, of actuators as well, kg m2."""
    damping: float
    """Of the joint and of what actuators have besides their bias, N m s/rad."""
    q_ref: float
    """Joint angle of the model's reference pose (MJCF `ref`), rad."""
    q_range: tuple[float, float]
    """Joint limits, rad; used by the IK, not a force."""


@dataclass(frozen=True)
class Actuator:
    """force = clip(gain * clip(ctrl) + bias[0] + bias[1] * length + bias[2] * velocity)."""

    joint: int
    gear: float
    gain: float
    bias: tuple[float, float, float]
    ctrl_range: tuple[float, float] | None
    force_range: tuple[float, float] | None
    """N m."""


@dataclass(frozen=True)
class ChainModel:
    """A fixed-base serial arm. Hashable; frame B is the MJCF's world frame."""

    links: tuple[Link, ...]
    actuators: tuple[Actuator, ...]
    site_rotation: Mat
    """Orientation of the tool site E in the last link's frame."""
    site_position: Vec
    """Position of the tool site E in the last link's frame, m."""
    timestep_s: float
    integrator: str
    """euler or implicitfast."""
    gravity: Vec
    """m/s2, in B when B is at rest and level."""

    @property
    def nq(self) -> int:
        """Number of joints."""
        return len(self.links)


def load_mujoco(arm: str) -> mujoco.MjModel:
    """The MuJoCo model of a named arm (`paper`, `ur10e`) or of an MJCF file.

    Raises:
        UserError: unknown name, missing file, or a file that MuJoCo refuses.
    """
    path = asset_path(ARMS[arm]) if arm in ARMS else Path(arm)
    if not os.path.isfile(path):
        raise UserError(
            f"--arm {arm}: not one of {', '.join(ARMS)} and no such file; "
            "give a name or an MJCF file"
        )
    warned: list[str] = []
    mujoco.set_mju_user_warning(warned.append)  # not into a log file in the working directory
    try:
        mj = mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split())[:300]
        raise UserError(f"--arm {arm}: MuJoCo cannot read this model: {reason}") from None
    finally:
        mujoco.set_mju_user_warning(None)
    for text in warned:
        if "singular" in text:
            raise UserError(
                f"--arm {arm}: its masses or inertias cannot be simulated (MuJoCo: "
                f"{text.split('.')[0]}); give every link some"
            )
        print(f"--arm {arm}: MuJoCo: {text}", file=sys.stderr)
    return mj


def chain_model(mj: mujoco.MjModel, tool_site: str | None = None) -> ChainModel:
    """Read a serial chain of hinges from a MuJoCo model.

    Args:
        mj: compiled model.
        tool_site: name of the tool centre point; None takes the last link's frame.

    Raises:
        UserError: the model has something that the chain engine does not model; says what.
    """
    refuse_unsupported(mj)
    mj = with_joints_carrying_servos(mj)
    bodies = [int(b) for b in mj.jnt_bodyid]
    frames = [_link_frame(mj, j) for j in range(mj.njnt)]
    world = _reference_poses(mj)
    links = tuple(_link(mj, j, bodies, frames, world) for j in range(mj.njnt))
    rotation, position = _site(mj, tool_site, bodies[-1], frames[-1], world)
    return ChainModel(
        links=links,
        actuators=tuple(_actuator(mj, i) for i in range(mj.nu)),
        site_rotation=_mat(rotation),
        site_position=_vec(position),
        timestep_s=float(mj.opt.timestep),
        integrator=integrator(mj),
        gravity=ZERO
        if mj.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
        else _vec(mj.opt.gravity),
    )


def with_joints_carrying_servos(mj: mujoco.MjModel) -> mujoco.MjModel:
    """A copy in which the rotors' inertia and damping that actuators add to their joints, gear
    squared times their own, are the joints'. MuJoCo adds them in each step; MJX drops them."""
    mj = copy.copy(mj)
    for i in range(mj.nu):
        joint = mj.actuator_trnid[i, 0]
        if mj.jnt_actuatorid[joint] not in (i, SEVERAL):
            continue  # the compiler saw none: C MuJoCo does not look either
        dof, gear_squared = mj.jnt_dofadr[joint], mj.actuator_gear[i, 0] ** 2
        mj.dof_armature[dof] += gear_squared * mj.actuator_armature[i]
        mj.dof_damping[dof] += gear_squared * mj.actuator_damping[i]
    mj.actuator_armature[:] = mj.actuator_damping[:] = 0.0
    mj.jnt_actuatorid[:] = -1
    return mj


def _reference_poses(mj: mujoco.MjModel) -> list[tuple[np.ndarray, np.ndarray]]:
    """(R, p) of every body in the world at the reference pose, float64."""
    poses = [(np.eye(3), np.zeros(3))]
    for body in range(1, mj.nbody):
        r_parent, p_parent = poses[mj.body_parentid[body]]
        poses.append(
            (r_parent @ _matrix(mj.body_quat[body]), p_parent + r_parent @ mj.body_pos[body])
        )
    return poses


def _matrix(quat_wxyz: np.ndarray) -> np.ndarray:
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.asarray(quat_wxyz, dtype=np.float64))
    return out.reshape(3, 3)


def _link_frame(mj: mujoco.MjModel, joint: int) -> tuple[np.ndarray, np.ndarray]:
    """(R, p) of the link frame in its body's frame: z along the hinge, x the body axis most
    perpendicular to it (so that axis-aligned arms get signed permutations)."""
    z = mj.jnt_axis[joint] / np.linalg.norm(mj.jnt_axis[joint])
    x = np.eye(3)[int(np.argmin(np.abs(z)))]
    x = x - z * (x @ z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1), mj.jnt_pos[joint].copy()


def _compose(a, b):
    return a[0] @ b[0], a[1] + a[0] @ b[1]


def _relative(a, b):
    """Pose b expressed in pose a, both given in one frame."""
    return a[0].T @ b[0], a[0].T @ (b[1] - a[1])


def _link(mj, joint: int, bodies: list[int], frames: list, world: list) -> Link:
    here = _compose(world[bodies[joint]], frames[joint])
    parent = (
        _compose(world[bodies[joint - 1]], frames[joint - 1]) if joint else (np.eye(3), np.zeros(3))
    )
    rotation, position = _relative(parent, here)
    mass, moment, inertia = _mass_properties(mj, bodies[joint], here, world)
    dof = int(mj.jnt_dofadr[joint])
    limited = bool(mj.jnt_limited[joint])
    q_range = mj.jnt_range[joint] if limited else (-np.inf, np.inf)
    return Link(
        rotation=_mat(rotation),
        position=_vec(position),
        mass=mass,
        moment=_vec(moment),
        inertia=tuple(
            snap(inertia[i, j]) for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
        ),  # type: ignore[arg-type]
        armature=float(mj.dof_armature[dof]),
        damping=float(np.ravel(mj.dof_damping[dof])[0]),
        q_ref=float(mj.qpos0[mj.jnt_qposadr[joint]]),
        q_range=(float(q_range[0]), float(q_range[1])),
    )


def _mass_properties(mj, body: int, frame, world) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, first moment and inertia about `frame`'s origin of a body and all welded to it."""
    mass, moment, inertia = 0.0, np.zeros(3), np.zeros((3, 3))
    for b in range(1, mj.nbody):
        if not (b == body or (mj.body_jntnum[b] == 0 and moving_ancestor(mj, b) == body)):
            continue
        m = float(mj.body_mass[b])
        com = _compose(world[b], (_matrix(mj.body_iquat[b]), mj.body_ipos[b]))
        r, c = _relative(frame, com)
        mass += m
        moment += m * c
        inertia += r @ np.diag(mj.body_inertia[b]) @ r.T + m * (c @ c * np.eye(3) - np.outer(c, c))
    return mass, moment, inertia


def _site(mj, name: str | None, last_body: int, frame, world):
    if name is None:
        return np.eye(3), np.zeros(3)
    site = mujoco.mj_name2id(mj, mujoco.mjtObj.mjOBJ_SITE, name)
    if site < 0:
        names = [mj.site(i).name for i in range(mj.nsite)]
        raise UserError(
            f"--tool-site {name}: the arm model's sites are: {', '.join(names) or 'none'}"
        )
    body = int(mj.site_bodyid[site])
    if body != last_body and moving_ancestor(mj, body) != last_body:
        raise UserError(f"--tool-site {name}: it must be on the last link of the chain")
    pose = _compose(world[body], (_matrix(mj.site_quat[site]), mj.site_pos[site]))
    return _relative(_compose(world[last_body], frame), pose)


def _actuator(mj: mujoco.MjModel, i: int) -> Actuator:
    affine = mj.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE
    bias = mj.actuator_biasprm[i, :3] if affine else np.zeros(3)
    clamp = not int(mj.opt.disableflags) & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    return Actuator(
        joint=int(mj.actuator_trnid[i, 0]),
        gear=float(mj.actuator_gear[i, 0]),
        gain=float(mj.actuator_gainprm[i, 0]),
        bias=(float(bias[0]), float(bias[1]), float(bias[2])),
        ctrl_range=_range(clamp and mj.actuator_ctrllimited[i], mj.actuator_ctrlrange[i]),
        force_range=_range(mj.actuator_forcelimited[i], mj.actuator_forcerange[i]),
    )


def _range(limited, values) -> tuple[float, float] | None:
    return (float(values[0]), float(values[1])) if limited else None


def _vec(v: np.ndarray) -> Vec:
    return (snap(v[0]), snap(v[1]), snap(v[2]))


def _mat(m: np.ndarray) -> Mat:
    return (_vec(m[0]), _vec(m[1]), _vec(m[2]))


def torque_limits_nm(model: ChainModel) -> np.ndarray:
    """(nq,) most that a joint's actuators give together; infinite where one has no limit."""
    limits = np.zeros(model.nq)
    for act in model.actuators:
        most = max(map(abs, act.force_range)) if act.force_range else np.inf
        limits[act.joint] += abs(act.gear) * most
    return limits
