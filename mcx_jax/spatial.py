"""Small vectors, rotations and poses written as scalar expressions.

A vector is a tuple of three scalars, a rotation a tuple of three rows. A scalar is a Python float
(a constant of the model) or a traced JAX scalar; products with the constants 0, 1 and -1 vanish
while tracing. Under `vmap` with the batch axis last every traced scalar is one contiguous row over
the environments, so XLA sees elementwise work only: no batched 3x3 matmul, no transposes.

Rotations are active: `R_A_B` maps coordinates in frame B to coordinates in frame A.
"""

import math
from collections.abc import Sequence
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

Scalar = Any
"""Python float or JAX scalar."""
Vec = tuple[Scalar, Scalar, Scalar]
Mat = tuple[Vec, Vec, Vec]

ZERO: Vec = (0.0, 0.0, 0.0)
EYE: Mat = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def _is(x: Scalar, value: float) -> bool:
    return isinstance(x, float) and x == value


def _alike(a: Scalar, b: Scalar) -> bool:
    """Whether `lax` accepts them without promotion. jax.numpy's operators cost a third more
    tracing: 7.5 s instead of 5.9 s of CPU time for a training run's three programs."""
    return (
        isinstance(a, jax.Array)
        and isinstance(b, jax.Array)
        and a.dtype == b.dtype
        and a.shape == b.shape
    )


def mul(a: Scalar, b: Scalar) -> Scalar:
    """a * b, folded when either is the constant 0, 1 or -1."""
    if _is(a, 0.0) or _is(b, 0.0):
        return 0.0
    if _is(a, 1.0):
        return b
    if _is(b, 1.0):
        return a
    if _is(a, -1.0):
        return -b
    if _is(b, -1.0):
        return -a
    return lax.mul(a, b) if _alike(a, b) else a * b


def add(a: Scalar, b: Scalar) -> Scalar:
    """a + b, folded when either is the constant 0."""
    if _is(a, 0.0):
        return b
    if _is(b, 0.0):
        return a
    return lax.add(a, b) if _alike(a, b) else a + b


def sub(a: Scalar, b: Scalar) -> Scalar:
    """a - b, folded when either is the constant 0."""
    if _is(b, 0.0):
        return a
    if _is(a, 0.0):
        return -b
    return lax.sub(a, b) if _alike(a, b) else a - b


def total(terms: Sequence[Scalar]) -> Scalar:
    """Sum of scalars with constants folded."""
    return reduce(add, terms, 0.0)


def vadd(a: Vec, b: Vec) -> Vec:
    """a + b."""
    return (add(a[0], b[0]), add(a[1], b[1]), add(a[2], b[2]))


def vsub(a: Vec, b: Vec) -> Vec:
    """a - b."""
    return (sub(a[0], b[0]), sub(a[1], b[1]), sub(a[2], b[2]))


def vscale(s: Scalar, a: Vec) -> Vec:
    """s a."""
    return (mul(s, a[0]), mul(s, a[1]), mul(s, a[2]))


def dot(a: Vec, b: Vec) -> Scalar:
    """Inner product."""
    return total([mul(x, y) for x, y in zip(a, b, strict=True)])


def cross(a: Vec, b: Vec) -> Vec:
    """a x b."""
    return (
        sub(mul(a[1], b[2]), mul(a[2], b[1])),
        sub(mul(a[2], b[0]), mul(a[0], b[2])),
        sub(mul(a[0], b[1]), mul(a[1], b[0])),
    )


def transpose(m: Mat) -> Mat:
    """Transposed matrix = inverse of a rotation."""
    return tuple(zip(*m, strict=True))  # type: ignore[return-value]


def matvec(m: Mat, v: Vec) -> Vec:
    """m v."""
    return (dot(m[0], v), dot(m[1], v), dot(m[2], v))


def tmatvec(m: Mat, v: Vec) -> Vec:
    """m^T v."""
    return matvec(transpose(m), v)


def matmul(a: Mat, b: Mat) -> Mat:
    """a b."""
    columns = transpose(b)
    return tuple(tuple(dot(row, col) for col in columns) for row in a)  # type: ignore[return-value]


def rotate_z(m: Mat, c: Scalar, s: Scalar) -> Mat:
    """m Rz(angle), with c = cos(angle), s = sin(angle)."""
    return tuple(  # type: ignore[return-value]
        (
            add(mul(row[0], c), mul(row[1], s)),
            sub(mul(row[1], c), mul(row[0], s)),
            row[2],
        )
        for row in m
    )


@jax.custom_jvp
def sincos(x: Scalar) -> tuple[Scalar, Scalar]:
    """(sin x, cos x) of an angle in radians, |x| < 1e4.

    In float32 a polynomial after reduction by multiples of pi/2 in three parts: XLA's own sine is
    not vectorised on CPU and took 85 % of a physics step (0.7 M against 4.6 M steps/s). Error
    below 1e-7 for |x| < 100. Coefficients: Chebyshev fit on [-pi/4, pi/4], 1e-8 and 8e-10. In
    float64, where only tests run, XLA's own.
    """
    x = jnp.asarray(x)
    if x.dtype != jnp.float32:
        return jnp.sin(x), jnp.cos(x)
    turns = jnp.round(x * (2.0 / math.pi))
    # 1.5703125 has 8 bits: exact for 2^15 quarter turns; the rest of pi/2 in two more parts.
    r = ((x - turns * 1.5703125) - turns * 4.837512969970703e-4) - turns * 7.549789948768648e-8
    z = r * r
    s = r * (1.0 + z * (-0.16666664665 + z * (0.008332748634 - z * 0.000195879498)))
    c = 1.0 - 0.5 * z + z * z * (0.041666664662 + z * (-0.001388830334 + z * 2.454799126e-5))
    quarter = turns.astype(jnp.int32)
    odd = (quarter & 1) == 1
    sin, cos = jnp.where(odd, c, s), jnp.where(odd, s, c)
    return (
        jnp.where((quarter & 2) == 2, -sin, sin),
        jnp.where(((quarter + 1) & 2) == 2, -cos, cos),
    )


@sincos.defjvp
def _sincos_jvp(primals, tangents):
    sin, cos = sincos(primals[0])
    return (sin, cos), (cos * tangents[0], -sin * tangents[0])


def rotation_rpy(roll: Scalar, pitch: Scalar, yaw: Scalar) -> Mat:
    """Rz(yaw) Ry(pitch) Rx(roll), angles in radians (aerospace order, extrinsic xyz)."""
    return rotation_of_turns([sincos(roll), sincos(pitch), sincos(yaw)])


def rotation_of_turns(turns: Sequence[tuple[Scalar, Scalar]]) -> Mat:
    """`rotation_rpy` from (sin, cos) of roll, pitch and yaw."""
    (sr, cr), (sp, cp), (sy, cy) = turns
    return (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )


def exp_rotation(v: Vec) -> Mat:
    """Rotation matrix of the rotation vector v (axis times angle, radians), Rodrigues' formula.

    sin(t)/t and (1 - cos t)/t^2 switch to their series below t^2 = 1e-4 (next term: 1e-10), so
    that value and gradient are finite at 0.
    """
    t2 = dot(v, v)
    small = t2 < 1e-4
    t = jnp.sqrt(jnp.where(small, 1.0, t2))
    sin, cos = sincos(t)
    a = jnp.where(small, 1.0 - t2 / 6.0, sin / t)
    b = jnp.where(small, 0.5 - t2 / 24.0, (1.0 - cos) / (t * t))
    x, y, z = v
    return (
        (1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y),
        (b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x),
        (b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)),
    )


def norm(v: Sequence[Scalar]) -> Scalar:
    """Euclidean norm with gradient 0 (not NaN) at the zero vector."""
    n2 = total([mul(x, x) for x in v])
    zero = n2 == 0.0
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, n2)))


def _skew_part(r: Mat) -> Vec:
    """sin(angle) times the axis of the rotation r."""
    return (
        0.5 * (r[2][1] - r[1][2]),
        0.5 * (r[0][2] - r[2][0]),
        0.5 * (r[1][0] - r[0][1]),
    )


def angle(r: Mat) -> Scalar:
    """Rotation angle in [0, pi], radians (paper eq. 1: arccos((tr R - 1)/2)).

    Taken as atan2(sin, cos): float32 arccos near 1 is good to 3e-4 rad only, the errors here are
    of that size.
    """
    return jnp.arctan2(norm(_skew_part(r)), 0.5 * (r[0][0] + r[1][1] + r[2][2] - 1.0))


def log_rotation(r: Mat) -> Vec:
    """Rotation vector (axis times angle in [0, pi]) of r: the inverse of `exp_rotation`.

    Within 0.1 rad of a half turn the axis comes from the largest column of R + 1, where the
    skew part vanishes.
    """
    s = _skew_part(r)
    c = 0.5 * (r[0][0] + r[1][1] + r[2][2] - 1.0)
    sin2 = dot(s, s)
    tiny = sin2 < 1e-12
    sin_t = jnp.sqrt(jnp.where(tiny, 1.0, sin2))
    theta = jnp.arctan2(jnp.where(tiny, 0.0, sin_t), c)
    factor = jnp.where(tiny, 1.0, theta / sin_t)
    near_half_turn = c < -0.995
    half = _half_turn_axis(r, s)
    return tuple(  # type: ignore[return-value]
        jnp.where(near_half_turn, theta * h, factor * x) for h, x in zip(half, s, strict=True)
    )


def _half_turn_axis(r: Mat, s: Vec) -> Vec:
    """Unit axis of a rotation near a half turn, its sign agreeing with the skew part s."""
    c = 0.5 * (r[0][0] + r[1][1] + r[2][2] - 1.0)
    sym = [[0.5 * (r[i][j] + r[j][i]) - (c if i == j else 0.0) for j in range(3)] for i in range(3)]
    use0 = (sym[0][0] >= sym[1][1]) & (sym[0][0] >= sym[2][2])
    use1 = sym[1][1] >= sym[2][2]
    col = [jnp.where(use0, sym[i][0], jnp.where(use1, sym[i][1], sym[i][2])) for i in range(3)]
    n2 = col[0] * col[0] + col[1] * col[1] + col[2] * col[2]
    sign = jnp.where(col[0] * s[0] + col[1] * s[1] + col[2] * s[2] < 0.0, -1.0, 1.0)
    scale = sign / jnp.sqrt(jnp.maximum(n2, 1e-12))
    return (scale * col[0], scale * col[1], scale * col[2])


def snap(x: float) -> float:
    """A model constant with rounding noise removed: within 1e-12 of -1, 0 or 1 it is that number.

    Quaternions like (0.5^0.5, 0, 0.5^0.5, 0) otherwise give 2e-16 instead of the 0 that folds.
    """
    nearest = float(round(x))
    if abs(nearest) <= 1.0 and abs(x - nearest) <= 1e-12:
        return nearest + 0.0
    return float(x)


def unpack(array, n: int) -> tuple[Scalar, ...]:
    """The n scalars of an array of shape (n,)."""
    return tuple(array[i] for i in range(n))


def unpack_matrix(array) -> Mat:
    """The rows of scalars of an array of shape (3, 3)."""
    return tuple(tuple(array[i, j] for j in range(3)) for i in range(3))  # type: ignore[return-value]
