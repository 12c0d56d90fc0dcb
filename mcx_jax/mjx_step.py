"""`mjx.step` for serial hinge arms, computed by the chain engine: change one import.

    from mcx_jax.mjx_step import step

The model's numbers are read from `mjx.Model` while tracing. What is concrete (a model closed over,
the usual case) becomes Python floats, whose zeros and ones vanish from the program; what is traced
(a model that is an argument of `jit`, masses randomised by `vmap`) stays traced: right, but slower.
"""

from dataclasses import dataclass, fields
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from mujoco import mjx

from mcx_jax.envs import dynamics
from mcx_jax.envs.model import ChainModel, Link, refuse_unsupported
from mcx_jax.spatial import (
    EYE,
    ZERO,
    Mat,
    Scalar,
    Vec,
    add,
    cross,
    dot,
    matmul,
    matvec,
    mul,
    snap,
    sub,
    tmatvec,
    total,
    transpose,
    vadd,
    vscale,
    vsub,
)

Pose = tuple[Mat, Vec]


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
            looked at: polynomial stiffness and damping are then ignored, as `mjx.step` does.
    """
    arm = _read(m)
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


@dataclass(frozen=True)
class _Arm:
    """What a step needs of `mjx.Model`; every number a Python float, or traced if it was."""

    model: ChainModel
    gravity: Vec
    timestep_s: Scalar
    springs: list[tuple[Scalar, Scalar]]
    """(stiffness N m/rad, rest angle rad) of every joint."""
    actuators: list[SimpleNamespace]
    masses: list[tuple[int, int, Vec]]
    """(body, link, centre of mass in the link's frame) of every moving body."""


def _read(m: mjx.Model) -> _Arm:
    # NumPy at once: inside a trace every operation on a concrete JAX array would be traced.
    m = jax.tree.map(lambda x: x if isinstance(x, Tracer) else np.asarray(x), m)
    _refuse(m)
    bodies = [int(b) for b in m.jnt_bodyid]
    owners, poses = _poses(m, bodies)
    hinges = [
        (_hinge_frame(_numbers(m.jnt_axis[j])), _numbers(m.jnt_pos[j])) for j in range(m.njnt)
    ]
    masses = [
        (b, owners[b], _relative(hinges[owners[b]], _compose(poses[b], _inertial_pose(m, b))))
        for b in range(1, m.nbody)
        if owners[b] >= 0
    ]
    links = []
    for j, body in enumerate(bodies):
        parent = hinges[j - 1] if j else (EYE, ZERO)
        frame = _relative(parent, _compose(_parent_pose(m, body, owners, poses), hinges[j]))
        own = [(b, pose) for b, link, pose in masses if link == j]
        links.append(_link(m, j, frame, own))
    flags = m.opt.disableflags
    stiffness = _numbers(m.jnt_stiffness if not flags & mjx.DisableBit.SPRING else np.zeros(m.njnt))
    gravity = ZERO if flags & mjx.DisableBit.GRAVITY else _numbers(m.opt.gravity)
    integrator = {0: "euler", 3: "implicitfast"}[int(m.opt.integrator)]
    (timestep_s,) = _numbers(m.opt.timestep[None])
    return _Arm(
        model=ChainModel(tuple(links), (), EYE, ZERO, timestep_s, integrator, gravity),
        gravity=gravity,
        timestep_s=timestep_s,
        springs=list(zip(stiffness, _numbers(m.qpos_spring), strict=True)),
        actuators=[_actuator(m, i) for i in range(m.nu)],
        masses=[(b, link, pose[1]) for b, link, pose in masses],
    )


def _refuse(m: mjx.Model) -> None:
    """`refuse_unsupported`, where traced numbers count as zero and MJX's static flags for them."""
    view: dict[str, Any] = {f.name: getattr(m, f.name) for f in fields(m)}
    for name, value in view.items():
        if isinstance(value, Tracer):
            view[name] = np.zeros(value.shape)
    private: Any = m.opt._impl
    options = {
        "disableflags": m.opt.disableflags,
        "integrator": m.opt.integrator,
        "density": float(private.has_fluid_params),
        "viscosity": 0.0,
    }
    view |= {
        "opt": SimpleNamespace(**options),
        "dof_frictionloss": m._impl.dof_hasfrictionloss,  # type: ignore[union-attr]
        "body_gravcomp": np.array(m.ngravcomp),
        "jnt_stiffness": np.zeros(m.njnt),  # taken
        "actuator_damping": np.zeros(m.nu),  # `mjx.put_model` does not read them
        "actuator_dampingpoly": np.zeros(m.nu),
    }
    refuse_unsupported(SimpleNamespace(**view))  # type: ignore[arg-type]


def _numbers(leaf: Any) -> tuple[Scalar, ...]:
    """The scalars of a vector: Python floats, or traced if the vector is."""
    if isinstance(leaf, Tracer):
        return tuple(leaf[i] for i in range(leaf.shape[0]))
    return tuple(float(x) for x in np.asarray(leaf, np.float64))


def _poses(m: mjx.Model, bodies: list[int]) -> tuple[list[int], list[Pose]]:
    """For every body: the link that carries it (-1: the world), its pose in that link's body."""
    owners, poses = [-1], [(EYE, ZERO)]
    for body in range(1, m.nbody):
        if body in bodies:
            owners.append(bodies.index(body))
            poses.append((EYE, ZERO))
        else:
            owners.append(owners[m.body_parentid[body]])
            poses.append(_parent_pose(m, body, owners, poses))
    return owners, poses


def _parent_pose(m: mjx.Model, body: int, owners: list[int], poses: list[Pose]) -> Pose:
    """Pose of a body, its own joint at rest, in the body of the link that carries its parent."""
    here = _rotation(_numbers(m.body_quat[body])), _numbers(m.body_pos[body])
    return _compose(poses[m.body_parentid[body]], here)  # type: ignore[arg-type]


def _inertial_pose(m: mjx.Model, body: int) -> Pose:
    return _rotation(_numbers(m.body_iquat[body])), _numbers(m.body_ipos[body])  # type: ignore[return-value]


def _compose(a: Pose, b: Pose) -> Pose:
    return matmul(a[0], b[0]), vadd(a[1], matvec(a[0], b[1]))


def _relative(a: Pose, b: Pose) -> Pose:
    """Pose b expressed in pose a, both given in one frame."""
    return matmul(transpose(a[0]), b[0]), tmatvec(a[0], vsub(b[1], a[1]))


def _rotation(quat_wxyz: tuple[Scalar, ...]) -> Mat:
    """Of a quaternion of any length: float32 ones are off by 1e-8, which would hide zeros."""
    w, x, y, z = quat_wxyz
    s = 2.0 / (w * w + x * x + y * y + z * z)
    rows = (
        (1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)),
        (s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)),
        (s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)),
    )
    return tuple(_snapped(row) for row in rows)  # type: ignore[return-value]


def _snapped(xs: Any) -> Any:
    return tuple(snap(x) if isinstance(x, float) else x for x in xs)


def _hinge_frame(axis: tuple[Scalar, ...]) -> Mat:
    """Orientation with z along the axis, in the axis' frame."""
    if all(isinstance(x, float) for x in axis):
        z = np.array(axis) / np.linalg.norm(axis)
        # x is the body axis most perpendicular to z: axis-aligned arms get signed permutations.
        x = np.eye(3)[int(np.argmin(np.abs(z)))]
        x = x - z * (x @ z)
        x /= np.linalg.norm(x)
        rows = np.stack([x, np.cross(z, x), z], axis=1).tolist()
        return tuple(_snapped(row) for row in rows)  # type: ignore[return-value]
    # Duff et al. 2017, "Building an orthonormal basis, revisited": no branch, no singular axis.
    x, y, z = axis
    sign = jnp.where(z >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    return ((1.0 + sign * x * x * a, b, x), (sign * b, sign + y * y * a, y), (-sign * x, -y, z))


def _link(m: mjx.Model, joint: int, frame: Pose, own: list[tuple[int, Pose]]) -> Link:
    """A link at `frame` in its parent, made of bodies with inertial poses in the link's frame."""
    mass, moment = 0.0, ZERO
    inertia: list[Scalar] = [0.0] * 6
    for body, (r, c) in own:
        (m_body,) = _numbers(m.body_mass[body][None])
        principal = _numbers(m.body_inertia[body])
        mass, moment = add(mass, m_body), vadd(moment, vscale(m_body, c))
        for k, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))):
            rotated = total([mul(mul(r[i][a], principal[a]), r[j][a]) for a in range(3)])
            away = sub(dot(c, c) if i == j else 0.0, mul(c[i], c[j]))
            inertia[k] = total([inertia[k], rotated, mul(m_body, away)])
    dof = int(m.jnt_dofadr[joint])
    armature, damping = _numbers(m.dof_armature[dof][None]) + _numbers(m.dof_damping[dof][None])
    (q_ref,) = _numbers(m.qpos0[dof][None])
    return Link(
        rotation=tuple(_snapped(row) for row in frame[0]),  # type: ignore[arg-type]
        position=_snapped(frame[1]),
        mass=mass,
        moment=_snapped(moment),
        inertia=_snapped(inertia),
        armature=armature,
        damping=damping,
        q_ref=q_ref,
        q_range=(-np.inf, np.inf),
    )


def _actuator(m: mjx.Model, i: int) -> SimpleNamespace:
    """One actuator: force = clip(gain clip(ctrl) + bias . (1, length, velocity))."""
    affine = int(m.actuator_biastype[i]) == mjx.BiasType.AFFINE
    clamp = not m.opt.disableflags & mjx.DisableBit.CLAMPCTRL
    return SimpleNamespace(
        joint=int(m.actuator_trnid[i, 0]),
        gear=_numbers(m.actuator_gear[i])[0],
        gain=_numbers(m.actuator_gainprm[i])[0],
        bias=_numbers(m.actuator_biasprm[i])[:3] if affine else ZERO,
        ctrl_range=_numbers(m.actuator_ctrlrange[i])
        if clamp and m.actuator_ctrllimited[i]
        else None,
        force_range=_numbers(m.actuator_forcerange[i]) if m.actuator_forcelimited[i] else None,
    )


def _actuate(arm: _Arm, q: list, qd: list, ctrl: jax.Array):
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


def _cartesian(arm: _Arm, angles: list, xfrc: jax.Array) -> list[Scalar]:
    """Joint torques of (nbody, 6) force N and torque N m at the centres of mass, in world axes."""
    n = arm.model.nq
    if not isinstance(xfrc, Tracer) and not np.any(np.asarray(xfrc)):
        return [0.0] * n
    rotation, origin = EYE, ZERO
    frames = []
    for link, turn in zip(arm.model.links, dynamics.link_rotations(arm.model, angles), strict=True):
        rotation, origin = _compose((rotation, origin), (turn, link.position))
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
