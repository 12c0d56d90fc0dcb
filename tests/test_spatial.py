"""Rotations against scipy, accuracy in float32 at the size of the errors here, finite gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mcx_jax import spatial
from mcx_jax.spatial import (
    EYE,
    angle,
    exp_rotation,
    log_rotation,
    norm,
    rotation_rpy,
    snap,
    unpack,
    unpack_matrix,
)

# Largest error of an entry or a radian. Ten roundings of numbers up to 1: float64 2e-15, float32
# 1e-6; angles up to pi.
F64 = 1e-14
F32 = 1.5e-6
RNG = np.random.default_rng(7)
DIRECTIONS = RNG.normal(size=(6, 3))
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
ANGLES = [0.0, 1e-9, 1e-6, 1e-4, 9.9e-3, 1.01e-2, 0.1, 1.0, 2.5, 3.03, 3.05, 3.14, np.pi - 1e-5]


def matrix(m):
    return np.array([[float(x) for x in row] for row in m])


def vector(v):
    return np.array([float(x) for x in v])


def mat(array):
    return unpack_matrix(jnp.asarray(array))


def vec(array):
    return unpack(jnp.asarray(array), 3)


def test_rpy_order_equals_scipy():
    with jax.enable_x64(True):
        for roll, pitch, yaw in RNG.uniform(-np.pi, np.pi, (20, 3)):
            want = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
            got = matrix(rotation_rpy(*vec([roll, pitch, yaw])))
            np.testing.assert_allclose(got, want, rtol=0, atol=F64)


def test_rpy_by_hand():
    # Yaw 90 deg after roll 90 deg: body y goes up with the roll (0, 0, 1) and stays there; body x
    # turns to world y; body z, rolled to (0, -1, 0), turns to (1, 0, 0).
    got = matrix(rotation_rpy(np.pi / 2, 0.0, np.pi / 2))
    np.testing.assert_allclose(got, [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-7)


@pytest.mark.parametrize("turn", ANGLES)
def test_exp_and_log_equal_scipy(turn):
    with jax.enable_x64(True):
        for axis in [*DIRECTIONS, *np.eye(3), *-np.eye(3)]:
            want = Rotation.from_rotvec(turn * axis).as_matrix()
            # Below t^2 = 1e-4 the series' next term is 1e-10 of the angle.
            got = matrix(exp_rotation(vec(turn * axis)))
            np.testing.assert_allclose(got, want, rtol=0, atol=F64 + 1e-12 * (turn < 1e-2))
            # Near half turns the axis comes from the square root of a difference; below 1e-6 rad
            # sin t is taken for t, and so it is for pi - t.
            back = vector(log_rotation(mat(want)))
            np.testing.assert_allclose(back, turn * axis, rtol=0, atol=1e-12)


@pytest.mark.parametrize("axis", [*np.eye(3), [0.6, -0.8, 0.0], [-0.48, 0.6, 0.64]])
def test_log_of_an_exact_half_turn(axis):
    with jax.enable_x64(True):
        r = 2.0 * np.outer(axis, axis) - np.eye(3)
        got = vector(log_rotation(mat(r)))
    assert np.linalg.norm(got) == pytest.approx(np.pi, abs=1e-12)
    assert abs(got @ np.asarray(axis)) == pytest.approx(np.pi, abs=1e-12)  # either sign is right


@pytest.mark.parametrize("turn", [1e-4, 1e-2, 1.0, 3.0, 3.1, 3.14])
def test_log_undoes_exp_in_float32(turn):
    for axis in DIRECTIONS:
        v = vec(np.float32(turn * axis))
        back = vector(log_rotation(exp_rotation(v)))
        # Near pi, theta = atan2(s, c) is good to F32 and the axis to F32 / s of the skew part or
        # F32 of the symmetric part (used within 0.1 rad of pi): at 3.0 rad 1 / sin = 7.
        np.testing.assert_allclose(back, turn * axis, rtol=0, atol=F32 * max(1.0, turn) * 3)


def test_random_rotations_round_trip():
    with jax.enable_x64(True):
        for r in Rotation.random(30, random_state=3):
            v = log_rotation(mat(r.as_matrix()))
            np.testing.assert_allclose(vector(v), r.as_rotvec(), rtol=0, atol=1e-12)
            np.testing.assert_allclose(matrix(exp_rotation(v)), r.as_matrix(), rtol=0, atol=F64)


@pytest.mark.parametrize("turn", [1e-5, 1e-4, 1e-3, 1e-2, 0.5, 3.0])
def test_angle_in_float32_at_the_size_of_the_errors(turn):
    for axis in DIRECTIONS:
        r = Rotation.from_rotvec(turn * axis).as_matrix().astype(np.float32)
        # Entries of 1e-4 beside ones of 1: the skew part keeps 1e-7 absolute. The paper's arccos
        # errs by up to 3e-4 rad here, which this tolerance would catch a thousand times over.
        assert float(angle(mat(r))) == pytest.approx(turn, abs=3e-7 * max(1.0, turn))


def test_arccos_would_not_do():
    """Why `angle` is an atan2: the textbook formula fails the tolerance above."""
    r = Rotation.from_rotvec([1e-4, 0, 0]).as_matrix().astype(np.float32)
    naive = np.arccos(np.float32(0.5) * (np.trace(r) - np.float32(1.0)))
    assert abs(naive - 1e-4) > 3e-7


def test_angle_is_the_papers_formula():
    with jax.enable_x64(True):
        for r in Rotation.random(20, random_state=5).as_matrix():
            want = np.arccos((np.trace(r) - 1) / 2)
            assert float(angle(mat(r))) == pytest.approx(want, abs=1e-12)


def test_gradients_are_finite_at_identity():
    def through_angle(v):
        return angle(exp_rotation(unpack(v, 3)))

    def through_log(v):
        return jnp.stack(log_rotation(exp_rotation(unpack(v, 3))))

    zero = jnp.zeros(3)
    np.testing.assert_array_equal(jax.grad(through_angle)(zero), np.zeros(3))
    # log undoes exp: the Jacobian is the identity, exactly at 0.
    np.testing.assert_allclose(jax.jacrev(through_log)(zero), np.eye(3), atol=1e-7)
    np.testing.assert_array_equal(jax.grad(lambda v: norm(unpack(v, 3)))(zero), np.zeros(3))
    assert float(norm(unpack(zero, 3))) == 0.0


@pytest.mark.parametrize("turn", [1e-5, 9e-3, 1.1e-2, 0.7, 2.9])
def test_gradients_away_from_identity(turn):
    """d|v| = v / |v|: the angle of exp(v) is |v| below pi."""
    with jax.enable_x64(True):
        v = turn * jnp.asarray(DIRECTIONS[0])
        slope = jax.grad(lambda x: angle(exp_rotation(unpack(x, 3))))(v)
        # 1e-6: the series' derivative at t = 0.01 has a next term of t^4 / 24 = 4e-10; at 1e-5 the
        # skew part's rounding is 1e-16 / 1e-5.
        np.testing.assert_allclose(slope, DIRECTIONS[0], rtol=0, atol=1e-6)


def test_constants_fold_away():
    x = jnp.float32(3.0)
    assert spatial.mul(0.0, x) == 0.0 and isinstance(spatial.mul(0.0, x), float)
    assert spatial.mul(x, 1.0) is x and spatial.mul(1.0, x) is x
    assert float(spatial.mul(-1.0, x)) == -3.0 and float(spatial.mul(x, -1.0)) == -3.0
    assert spatial.add(0.0, x) is x and spatial.add(x, 0.0) is x
    assert spatial.sub(x, 0.0) is x and float(spatial.sub(0.0, x)) == -3.0
    assert spatial.total([]) == 0.0

    # A permutation times a vector is no arithmetic at all; a traced matrix is 15 operations.
    turn = ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0))
    traced = jax.make_jaxpr(lambda v: jnp.stack(spatial.matvec(turn, unpack(v, 3))))(jnp.ones(3))
    used = {eqn.primitive.name for eqn in traced.eqns}
    assert not used & {"mul", "add", "sub", "dot_general"}, used
    v = (jnp.float32(1.0), jnp.float32(2.0), jnp.float32(3.0))
    assert spatial.matmul(EYE, turn) == turn
    assert [float(y) for y in spatial.matvec(turn, v)] == [2.0, 1.0, -3.0]


def test_products_equal_numpy():
    a, b = RNG.normal(size=(2, 3, 3))
    u, v = RNG.normal(size=(2, 3))
    with jax.enable_x64(True):
        pairs = [
            (matrix(spatial.matmul(mat(a), mat(b))), a @ b),
            (vector(spatial.matvec(mat(a), vec(u))), a @ u),
            (vector(spatial.tmatvec(mat(a), vec(u))), a.T @ u),
            (vector(spatial.cross(vec(u), vec(v))), np.cross(u, v)),
            (np.array(float(spatial.dot(vec(u), vec(v)))), u @ v),
            (vector(spatial.vadd(vec(u), vec(v))), u + v),
            (vector(spatial.vsub(vec(u), vec(v))), u - v),
            (vector(spatial.vscale(2.5, vec(v))), 2.5 * v),
            (
                matrix(spatial.rotate_z(mat(a), np.cos(0.3), np.sin(0.3))),
                a @ Rotation.from_euler("z", 0.3).as_matrix(),
            ),
        ]
        for got, want in pairs:
            np.testing.assert_allclose(got, want, rtol=0, atol=F64)


def test_snap_removes_rounding_noise_only():
    assert [snap(x) for x in (2.2e-16, -2.2e-16, 1 - 1e-15, -1 + 1e-15)] == [0.0, 0.0, 1.0, -1.0]
    assert np.copysign(1.0, snap(-2.2e-16)) == 1.0
    assert [snap(x) for x in (0.5, 1e-11, 2.0 + 1e-15, 1 + 1e-10)] == [
        *(0.5, 1e-11, 2.0 + 1e-15, 1 + 1e-10)
    ]


def test_sincos_in_float32():
    """The polynomial that replaces XLA's sine, over all joint angles and at its joints."""
    rng = np.random.default_rng(8)
    quarters = np.arange(-64, 65) * np.pi / 4
    near = quarters[:, None] + np.array([-1e-4, -1e-7, 0.0, 1e-7, 1e-4])
    x = np.float32(np.concatenate([rng.uniform(-100.0, 100.0, 20_000), near.ravel()]))
    s, c = spatial.sincos(jnp.asarray(x))
    # What its docstring promises: 1e-7, two roundings of 1.
    np.testing.assert_allclose(s, np.sin(x.astype(np.float64)), rtol=0, atol=1e-7)
    np.testing.assert_allclose(c, np.cos(x.astype(np.float64)), rtol=0, atol=1e-7)
    assert [float(v) for v in spatial.sincos(jnp.float32(0.0))] == [0.0, 1.0]


def test_sincos_gradients():
    x = jnp.asarray(np.float32(np.random.default_rng(9).uniform(-7.0, 7.0, 500)))
    ds = jax.vmap(jax.grad(lambda v: spatial.sincos(v)[0]))(x)
    dc = jax.vmap(jax.grad(lambda v: spatial.sincos(v)[1]))(x)
    # The derivative of a fit of degree 7 loses a digit: 8 * 7 * 1e-8.
    np.testing.assert_allclose(ds, np.cos(x), rtol=0, atol=6e-7)
    np.testing.assert_allclose(dc, -np.sin(x), rtol=0, atol=6e-7)
    with jax.enable_x64(True):
        np.testing.assert_array_equal(spatial.sincos(jnp.asarray(1.25))[0], np.sin(1.25))
