"""The JAX sampler: interpolation between knots, rotation, body rates."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mcx_jax.config.delay import SUBSTEPS
from mcx_jax.config.task import MotionConfig
from mcx_jax.envs.motion import LOOK_AHEAD_STEPS, load_motion
from mcx_jax.envs.sampler import (
    KNOT_STEPS,
    PHYSICS_DT_S,
    body_rates,
    hermite,
    segment_rows,
)
from mcx_jax.sea.spectrum import SEAS
from mcx_jax.sea.statistics import body_rate, rotation
from mcx_jax.sea.tables import build_tables
from mcx_jax.spatial import rotation_rpy, sincos


def _rows(values0, rates0, values1, rates1, dtype=None):
    row = partial(jnp.asarray, dtype=dtype)
    return row([values0] * 6 + [rates0] * 6), row([values1] * 6 + [rates1] * 6)


def rates(rpy, rpy_dot, rpy_ddot):
    """`body_rates` from the angles, as two arrays (3,)."""
    w, al = body_rates([sincos(angle) for angle in rpy], rpy_dot, rpy_ddot)
    return jnp.stack(w), jnp.stack(al)


def test_steps_per_knot():
    assert KNOT_STEPS == 50
    assert KNOT_STEPS * PHYSICS_DT_S == pytest.approx(0.1)


def test_hermite_by_hand():
    # x0 = 1, x0' = 10, x1 = 3, x1' = -20, h = 0.1: slopes h x' = 1 and -2, rise 2,
    # c2 = 3*2 - 2*1 + 2 = 6, c3 = 1 - 2 - 2*2 = -5. At u = 1/2 (step 25):
    # x   = 1 + .5 (1 + .5 (6 - 2.5)) = 2.375
    # x'  = (1 + .5 (12 + .5 * -15)) / .1 = 3.25 / .1 = 32.5
    # x'' = (12 + .5 * -30) / .01 = -300
    row0, row1 = _rows(1.0, 10.0, 3.0, -20.0)
    x, xd, xdd = hermite(row0, row1, 25)
    np.testing.assert_allclose(x, np.full(6, 2.375), rtol=1e-6)  # float32
    np.testing.assert_allclose(xd, np.full(6, 32.5), rtol=1e-6)
    np.testing.assert_allclose(xdd, np.full(6, -300.0), rtol=1e-6)


def test_hermite_is_exact_at_the_knots():
    row0, row1 = jnp.asarray(np.random.default_rng(0).normal(size=(2, 12)), jnp.float32)
    x, xd, _ = hermite(row0, row1, 0)
    np.testing.assert_array_equal(x, row0[:6])
    np.testing.assert_allclose(xd, row0[6:], rtol=3e-7)  # one rounding: times and by 0.1
    x, xd, _ = hermite(row0, row1, KNOT_STEPS)
    np.testing.assert_allclose(x, row1[:6], atol=5e-7)  # float32, values of size 1
    np.testing.assert_allclose(xd, row1[6:], atol=2e-5)  # the same rounding over 0.1 s


@pytest.mark.parametrize("step", [0, 1, 17, 49, 50])
def test_hermite_is_exact_for_a_cubic(step):
    # p(t) = 2 - t + 3 t^2 - 40 t^3
    def p(t):
        return 2 - t + 3 * t**2 - 40 * t**3, -1 + 6 * t - 120 * t**2, 6 - 240 * t

    with jax.enable_x64(True):
        row0, row1 = _rows(*p(0.0)[:2], *p(0.1)[:2], dtype=jnp.float64)
        got = hermite(row0, row1, jnp.int32(step))
        for have, want in zip(got, p(step * 0.002), strict=True):
            assert have[0].dtype == jnp.float64
            np.testing.assert_allclose(have, np.full(6, want), atol=1e-11)  # 1e-16 / h^2


def test_second_derivative_is_the_derivative_of_the_first():
    with jax.enable_x64(True):
        rows = jnp.asarray(np.random.default_rng(1).normal(size=(2, 12)))

        def at(step):
            return [np.asarray(v) for v in hermite(rows[0], rows[1], step)]

        # Cubic: its central difference is off by x''' dt^2 / 6, the derivative's is exact.
        (x0, v0, _), (_, v1, a1), (x2, v2, _) = at(20), at(21), at(22)
        third = (at(22)[2] - at(20)[2]) / 0.004
        np.testing.assert_allclose((v2 - v0) / 0.004, a1, atol=1e-8)  # 1e-13 / dt
        np.testing.assert_allclose((x2 - x0) / 0.004, v1 + third * 0.002**2 / 6, atol=1e-10)


def test_rows_around_a_step():
    knots = jnp.arange(3 * 4 * 12, dtype=jnp.float32).reshape(3, 4, 12)
    rows = jax.jit(segment_rows)
    for step, index in ((0, 0), (49, 0), (50, 1), (149, 2)):
        row0, row1 = rows(knots, jnp.int32(2), jnp.int32(step))
        np.testing.assert_array_equal(row0, knots[2, index])
        np.testing.assert_array_equal(row1, knots[2, index + 1])


def test_batch_last_equals_one_by_one():
    tables = build_tables([SEAS["Wd"]], "test")
    knots = jnp.asarray(tables.knots)
    steps = jnp.asarray(np.random.default_rng(2).integers(1_799_999, size=64), jnp.int32)

    def one(step):
        return jnp.asarray(hermite(*segment_rows(knots, jnp.int32(0), step), step % KNOT_STEPS))

    batch = jax.jit(jax.vmap(one, in_axes=-1, out_axes=-1))(steps)
    assert batch.shape == (3, 6, 64)
    alone = np.stack([one(step) for step in steps], axis=-1)
    # fused multiply-adds only: 1e-7 of 0.4 m, and over h^2 = 0.01 for the acceleration
    np.testing.assert_allclose(batch[0], alone[0], atol=2e-7)
    np.testing.assert_allclose(batch[2], alone[2], atol=1e-4)


def test_interpolation_error_against_every_second_knot():
    # Interpolating over twice the spacing must still hit the knot left out: for a cubic the error
    # grows 16-fold, so 3e-6 m at 0.1 s (measured against the sum of waves) means below 5e-5 here.
    knots = build_tables([SEAS["Wd"]], "test").knots[0, :2001].astype(float)
    x0, x2 = knots[:-2:2], knots[2::2]
    middle = (x0[:, :6] + x2[:, :6]) / 2 + 0.2 * (x0[:, 6:] - x2[:, 6:]) / 8
    error = abs(middle - knots[1:-1:2, :6]).max(axis=0)
    assert error[:3].max() < 5e-5 and error[3:].max() < 8e-5


def test_last_start_window_stays_inside_its_table():
    motion = load_motion(MotionConfig(sea="Wa", split="paper"), 1000, "test")
    last = SUBSTEPS * (motion.last_start + 1000 + LOOK_AHEAD_STEPS)
    assert last // KNOT_STEPS + 1 == motion.knots_a.shape[1] - 1


def matrix(rpy):
    return jnp.array(rotation_rpy(*rpy))


def test_rotation_is_yaw_after_pitch_after_roll():
    def about(axis, angle):
        c, s = np.cos(angle), np.sin(angle)
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        r = np.eye(3)
        r[i, i] = r[j, j] = c
        r[i, j], r[j, i] = -s, s
        return r

    rpy = np.array([0.3, -0.5, 1.1])
    want = about(2, rpy[2]) @ about(1, rpy[1]) @ about(0, rpy[0])
    np.testing.assert_allclose(matrix(jnp.asarray(rpy)), want, atol=1e-6)  # float32
    np.testing.assert_allclose(rotation(rpy[None])[0], want, atol=1e-15)


def test_body_rates_against_numerical_differentiation():
    with jax.enable_x64(True):
        rng = np.random.default_rng(3)
        for _ in range(5):
            c = jnp.asarray(rng.normal(size=(4, 3)) * [[0.4], [1.0], [2.0], [3.0]])

            def angles(t, c=c):
                return c[0] + c[1] * t + c[2] * t**2 / 2 + c[3] * t**3 / 6

            def spin(t, angles=angles):
                # R^T dR/dt = skew(w_body), dR/dt by central difference: error h^2, 1e-10 / h
                r, h = matrix(angles(t)), 1e-5
                skew = r.T @ (matrix(angles(t + h)) - matrix(angles(t - h))) / (2 * h)
                return np.array([skew[2, 1] - skew[1, 2], skew[0, 2] - skew[2, 0],
                                 skew[1, 0] - skew[0, 1]]) / 2  # fmt: skip

            w, al = rates(c[0], c[1], c[2])
            np.testing.assert_allclose(w, spin(0.0), atol=1e-7)
            np.testing.assert_allclose(al, (spin(1e-3) - spin(-1e-3)) / 2e-3, atol=1e-3)
            np.testing.assert_allclose(
                body_rate(np.asarray(c[:1]), np.asarray(c[1:2]))[0], w, atol=1e-14
            )


def test_angular_acceleration_is_the_derivative_of_the_rate():
    with jax.enable_x64(True):
        rpy, rate, accel = jnp.asarray(np.random.default_rng(4).normal(size=(3, 3)))
        _, derivative = jax.jvp(lambda a, b: rates(a, b, accel)[0], (rpy, rate), (rate, accel))
        np.testing.assert_allclose(rates(rpy, rate, accel)[1], derivative, atol=1e-13)


def test_derivatives_are_finite_at_rest():
    def total(row):
        x, xd, xdd = hermite(row, row, 25)
        w, al = rates(x[3:], xd[3:], xdd[3:])
        return jnp.sum(matrix(jnp.stack(x[3:]))) + jnp.sum(w) + jnp.sum(al)

    assert np.isfinite(jax.grad(total)(jnp.zeros(12))).all()
