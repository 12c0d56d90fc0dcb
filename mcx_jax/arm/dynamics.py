"""Rigid-body dynamics of a serial hinge arm on a moving base, as unrolled scalar expressions.

Recursive Newton-Euler for the bias forces, composite rigid bodies for the mass matrix, L^T D L for
the solve (Featherstone, Rigid Body Dynamics Algorithms, 2008, ch. 5-6), in link frames. The base's
motion is prescribed: the recursion starts from its angular velocity, angular acceleration and
acceleration, so an accelerating deck is exact and costs nothing.
"""

from collections.abc import Sequence

from mcx_jax.arm.model import ChainModel, Link
from mcx_jax.spatial import (
    Mat,
    Scalar,
    Vec,
    add,
    cross,
    matmul,
    matvec,
    mul,
    rotate_z,
    sincos,
    sub,
    tmatvec,
    total,
    transpose,
    vadd,
    vscale,
)

BaseState = tuple[Vec, Vec, Vec]
"""(w, al, a) of the base in base axes B: angular velocity rad/s, angular acceleration rad/s2, and
acceleration of the base origin minus gravity, m/s2 (at rest and level: 0, 0, +9.81)."""


def joint_sincos(model: ChainModel, q: Sequence[Scalar]) -> list[tuple[Scalar, Scalar]]:
    """(sin, cos) of every joint angle (rad) counted from the model's reference."""
    return [sincos(angle - link.q_ref) for link, angle in zip(model.links, q, strict=True)]


def link_rotations(model: ChainModel, angles: Sequence[tuple[Scalar, Scalar]]) -> list[Mat]:
    """Orientation of every link in its parent, from `joint_sincos`."""
    return [rotate_z(link.rotation, c, s) for link, (s, c) in zip(model.links, angles, strict=True)]


def bias_forces(
    model: ChainModel, angles: Sequence[tuple], qd: Sequence[Scalar], base: BaseState
) -> list[Scalar]:
    """Joint torques that hold all joint accelerations at zero, N m (recursive Newton-Euler)."""
    rotations = link_rotations(model, angles)
    motion = base
    wrenches = []
    for link, r, rate in zip(model.links, rotations, qd, strict=True):
        motion = link_motion(link, r, rate, 0.0, motion)
        wrenches.append(inertial_wrench(link, *motion))
    return _project(model, rotations, wrenches)


def link_motion(link: Link, r: Mat, rate: Scalar, accel: Scalar, parent: BaseState) -> BaseState:
    """(w, al, a) of a link in its own axes from its parent's, joint rate and acceleration.

    Args:
        r: orientation of the link in its parent.
        rate, accel: of the joint, rad/s and rad/s2.
    """
    w, al, a = parent
    a = tmatvec(r, vadd(a, _offset_acceleration(w, al, link.position)))
    w_parent = tmatvec(r, w)
    # The hinge is the link's z axis: w x (z qd) = (w_y qd, -w_x qd, 0).
    al = vadd(tmatvec(r, al), (mul(w_parent[1], rate), -mul(w_parent[0], rate), accel))
    return vadd(w_parent, (0.0, 0.0, rate)), al, a


def _offset_acceleration(w: Vec, al: Vec, p: Vec) -> Vec:
    """al x p + w x (w x p): acceleration of a point p fixed in a rotating frame."""
    return vadd(cross(al, p), cross(w, cross(w, p)))


def inertial_wrench(link: Link, w: Vec, al: Vec, a: Vec) -> tuple[Vec, Vec]:
    """Force and moment about the link origin that the link's motion needs."""
    force = vadd(vscale(link.mass, a), _offset_acceleration(w, al, link.moment))
    moment = vadd(
        vadd(_apply_inertia(link.inertia, al), cross(w, _apply_inertia(link.inertia, w))),
        cross(link.moment, a),
    )
    return force, moment


def _apply_inertia(inertia: Sequence[Scalar], v: Vec) -> Vec:
    xx, yy, zz, xy, xz, yz = inertia
    return matvec(((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)), v)


def _project(model: ChainModel, rotations: list[Mat], wrenches: list) -> list[Scalar]:
    """Sum the wrenches from tip to base; the torque of a joint is the moment about its z axis."""
    torques: list[Scalar] = [0.0] * model.nq
    force, moment = wrenches[-1]
    for i in reversed(range(model.nq)):
        torques[i] = moment[2]
        if i:
            force_up = matvec(rotations[i], force)
            moment_up = vadd(matvec(rotations[i], moment), cross(model.links[i].position, force_up))
            force = vadd(wrenches[i - 1][0], force_up)
            moment = vadd(wrenches[i - 1][1], moment_up)
    return torques


def mass_matrix(model: ChainModel, angles: Sequence[tuple]) -> list[list[Scalar]]:
    """Lower triangle of the joint-space mass matrix, kg m2 (composite rigid bodies)."""
    n = model.nq
    rotations = link_rotations(model, angles)
    mass_rows: list[list[Scalar]] = [[0.0] * (i + 1) for i in range(n)]
    composite = None
    for i in reversed(range(n)):
        link = model.links[i]
        composite = _merge(link, composite)
        _, (hx, hy, _), (_, _, izz, _, ixz, iyz) = composite
        mass_rows[i][i] = add(izz, link.armature)
        force: Vec = (-hy, hx, 0.0)  # of a unit acceleration about z: z x h
        moment: Vec = (ixz, iyz, izz)
        for j in range(i, 0, -1):
            force = matvec(rotations[j], force)
            moment = vadd(matvec(rotations[j], moment), cross(model.links[j].position, force))
            mass_rows[i][j - 1] = moment[2]
        if i:
            composite = _to_parent(composite, rotations[i], link.position)
    return mass_rows


def _merge(link: Link, outer):
    """Mass properties of a link plus those of everything beyond it, in the link's frame."""
    if outer is None:
        return link.mass, link.moment, link.inertia
    mass, moment, inertia = outer
    summed = tuple(add(x, y) for x, y in zip(link.inertia, inertia, strict=True))
    return add(link.mass, mass), vadd(link.moment, moment), summed


def _to_parent(body, r: Mat, p: Vec):
    """Mass properties expressed in the parent frame, about the parent's origin."""
    mass, moment, (xx, yy, zz, xy, xz, yz) = body
    half = matmul(r, ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))
    rotated = matmul(half, transpose(r))
    h = matvec(r, moment)
    # Parallel axes: 2 (p.h) 1 - (p h^T + h p^T) + m (p.p 1 - p p^T), with g = h + m p / 2.
    g = vadd(h, vscale(0.5, vscale(mass, p)))
    pg = [[mul(p[i], g[j]) for j in range(3)] for i in range(3)]
    trace2 = mul(2.0, total([pg[0][0], pg[1][1], pg[2][2]]))

    def shifted(i: int, j: int) -> Scalar:
        diagonal = trace2 if i == j else 0.0
        return add(rotated[i][j], sub(diagonal, add(pg[i][j], pg[j][i])))

    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    return mass, vadd(h, vscale(mass, p)), tuple(shifted(i, j) for i, j in pairs)


def factor(rows: list[list[Scalar]]) -> tuple[list[list[Scalar]], list[Scalar]]:
    """L^T D L factors of a symmetric positive matrix given by its lower triangle.

    Returns:
        (L, 1/D): unit lower rows without the diagonal, and the inverse diagonal.
    """
    n = len(rows)
    a = [list(row) for row in rows]
    inverse: list[Scalar] = [0.0] * n
    for k in reversed(range(n)):
        inverse[k] = 1.0 / a[k][k]
        for i in reversed(range(k)):
            scaled = mul(a[k][i], inverse[k])
            for j in range(i + 1):
                a[i][j] = sub(a[i][j], mul(scaled, a[k][j]))
            a[k][i] = scaled
    return [row[:-1] for row in a], inverse


def solve(factors: tuple[list[list[Scalar]], list[Scalar]], b: Sequence[Scalar]) -> list[Scalar]:
    """x of L^T D L x = b."""
    lower, inverse = factors
    n = len(b)
    x = list(b)
    for k in reversed(range(n)):
        for i in range(k):
            x[i] = sub(x[i], mul(lower[k][i], x[k]))
    x = [mul(v, d) for v, d in zip(x, inverse, strict=True)]
    for k in range(n):
        for i in range(k):
            x[k] = sub(x[k], mul(lower[k][i], x[i]))
    return x
