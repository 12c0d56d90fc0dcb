"""The numbers of a serial hinge arm in an `mjx.Model`, as the chain engine takes them.

Concrete numbers become Python floats, traced ones stay traced (`mcx_jax.integrations.mjx_step`).
"""

from dataclasses import dataclass, fields
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from mcx_jax.arm import dynamics
from mcx_jax.arm.fields import integrator, refuse_unsupported
from mcx_jax.arm.model import ChainModel, Link
from mcx_jax.arm.quiet_mjx import mjx
from mcx_jax.errors import require
from mcx_jax.spatial import (
    EYE,
    ZERO,
    Mat,
    Scalar,
    Vec,
    add,
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


@dataclass(frozen=True)
class Arm:
    """What a step needs of `mjx.Model`; every number a Python float, or traced if it was."""

    model: ChainModel
    gravity: Vec
    timestep_s: Scalar
    springs: list[tuple[Scalar, Scalar]]
    """(stiffness N m/rad, rest angle rad) of every joint."""
    actuators: list[SimpleNamespace]
    masses: list[tuple[int, int, Vec]]
    """(body, link, centre of mass in the link's frame) of every moving body."""


def read(m: mjx.Model) -> Arm:
    """An arm of a model.

    Raises:
        UserError: as `refuse_unsupported`; traced numbers cannot be looked at.
    """
    # NumPy at once: inside a trace every operation on a concrete JAX array would be traced.
    m = jax.tree.map(lambda x: x if isinstance(x, Tracer) else np.asarray(x), m)
    _refuse(m)
    bodies = [int(b) for b in m.jnt_bodyid]
    owners, poses = _poses(m, bodies)
    hinges = [
        (_hinge_frame(_numbers(m.jnt_axis[j])), _numbers(m.jnt_pos[j])) for j in range(m.njnt)
    ]
    masses = [
        (b, owners[b], _relative(hinges[owners[b]], compose(poses[b], _inertial_pose(m, b))))
        for b in range(1, m.nbody)
        if owners[b] >= 0
    ]
    links = []
    for j, body in enumerate(bodies):
        parent = hinges[j - 1] if j else (EYE, ZERO)
        frame = _relative(parent, compose(_parent_pose(m, body, owners, poses), hinges[j]))
        own = [(b, pose) for b, link, pose in masses if link == j]
        links.append(_link(m, j, frame, own))
    flags = m.opt.disableflags
    stiffness = _numbers(m.jnt_stiffness if not flags & mjx.DisableBit.SPRING else np.zeros(m.njnt))
    gravity = ZERO if flags & mjx.DisableBit.GRAVITY else _numbers(m.opt.gravity)
    (timestep_s,) = _numbers(m.opt.timestep[None])
    model = ChainModel(tuple(links), (), EYE, ZERO, timestep_s, integrator(m), gravity)
    _refuse_hidden_armature(m, model)
    return Arm(
        model=model,
        gravity=gravity,
        timestep_s=timestep_s,
        springs=list(zip(stiffness, _numbers(m.qpos_spring), strict=True)),
        actuators=[_actuator(m, i) for i in range(m.nu)],
        masses=[(b, link, pose[1]) for b, link, pose in masses],
    )


def _refuse(m: mjx.Model) -> None:
    """`refuse_unsupported`, where traced numbers count as zero and MJX's static flags for them."""
    require(
        m.nhistory == 0,
        "mjx_step: the model has delayed actuators or sensors; take the delay out of the MJCF file",
    )
    names = (f.name for f in fields(m))  # type: ignore[arg-type]
    view: dict[str, Any] = {name: getattr(m, name) for name in names}
    for name, value in view.items():
        if isinstance(value, Tracer):
            view[name] = np.zeros(value.shape)
    private: Any = m.opt._impl
    options = {
        "disableflags": m.opt.disableflags,
        "integrator": m.opt.integrator,
        "enableflags": m.opt.enableflags,
        "disableactuator": private.disableactuator,
        "density": float(private.has_fluid_params),
        "viscosity": 0.0,
    }
    view |= {
        "opt": SimpleNamespace(**options),
        "dof_frictionloss": m._impl.dof_hasfrictionloss,  # type: ignore[union-attr]
        "body_gravcomp": np.array(m.ngravcomp),
        "jnt_stiffness": np.zeros(m.njnt),  # taken
        "actuator_delay": np.zeros(m.nu),  # `mjx.put_model` drops it, but for the buffer's size
        "actuator_dampingpoly": np.zeros(m.nu),  # dropped
        "nplugin": m.npluginstate,
    }
    refuse_unsupported(SimpleNamespace(**view))  # type: ignore[arg-type]


def _refuse_hidden_armature(m: mjx.Model, model: ChainModel) -> None:
    """Refuse actuators' armature, which `mjx.put_model` drops: it is in `dof_M0`, the diagonal of
    the mass matrix at the reference pose, which the compiler has stored.

    Traced numbers cannot be compared, nor those of which `body_subtreemass` shows that the masses
    are others than the compiled ones.
    """
    reference = [(0.0, 1.0)] * model.nq  # sine and cosine
    diagonal = [row[-1] for row in dynamics.mass_matrix(model, reference)]
    stored = m.body_mass, m.body_subtreemass, m.dof_M0
    if any(isinstance(x, Tracer) for x in (*diagonal, *stored)):
        return
    if not np.allclose(m.body_subtreemass[0], np.sum(m.body_mass), rtol=1e-5):
        return
    require(
        np.allclose(diagonal, m.dof_M0, rtol=1e-4),  # sums of float32 numbers, rounded at 6e-8 each
        "mjx_step: dof_M0 is not that of the masses: actuators have armature, which mjx.put_model "
        "drops, or numbers were changed after compilation; put the model with "
        "mcx_jax.integrations.mjx_step.put_model",
    )


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
    return compose(poses[m.body_parentid[body]], here)  # type: ignore[arg-type]


def _inertial_pose(m: mjx.Model, body: int) -> Pose:
    return _rotation(_numbers(m.body_iquat[body])), _numbers(m.body_ipos[body])  # type: ignore[return-value]


def compose(a: Pose, b: Pose) -> Pose:
    """T_A^C = T_A^B T_B^C."""
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
