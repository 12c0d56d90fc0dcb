"""Delays: the queue by hand, the filter against scipy for any order and cutoff, a settled start."""

import functools
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from scipy.signal import butter, sosfilt, sosfilt_zi

from mcx_jax.arm import lag
from mcx_jax.config.delay import CONTROL_DT_S, NYQUIST_HZ, Delay, parse_delay

JOINTS = 6
# Every shrinking step would compile another filter: minutes before a failure is shown.
NO_SHRINKING = (Phase.explicit, Phase.generate)


def run(delay: Delay, first, inputs):
    """Outputs (n, nq) of a lag settled on `first`, fed with inputs (n, nq)."""

    def body(state, x):
        return lag.apply(delay, state, x)

    return jax.lax.scan(body, lag.init(delay, first), inputs)[1]


def filtered(delay: Delay, first: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """scipy's answer in float64, one start state a joint."""
    sos = butter(delay.order, delay.cutoff_hz / NYQUIST_HZ, output="sos")
    zi = sosfilt_zi(sos)[:, :, None] * first
    return sosfilt(sos, inputs, axis=0, zi=zi)[0]


def gain_sensitivity(delay: Delay) -> float:
    """Worst relative change of a section's DC gain by one rounding (float32, 6e-8) of each of its
    coefficients: sum |a| / |1 + a1 + a2|, small at the paper's cutoffs, 1e3 at 0.5 Hz."""
    sos = butter(delay.order, delay.cutoff_hz / NYQUIST_HZ, output="sos")
    return float((np.abs(sos[:, 3:]).sum(1) / np.abs(sos[:, 3:].sum(1))).sum())


def noise(seed: int, steps: int = 80) -> tuple[np.ndarray, np.ndarray]:
    """A start and a reference (steps, nq) that wander by some tenths of a rad, joint by joint."""
    rng = np.random.default_rng(seed)
    first = rng.uniform(-np.pi, np.pi, JOINTS)
    return first, first + np.cumsum(0.03 * rng.normal(size=(steps, JOINTS)), axis=0)


def test_queue_by_hand():
    x = jnp.arange(10.0, 15.0)[:, None] * jnp.array([1.0, -1.0])  # x0 = (10, -10), x1 = (11, -11)
    first = jnp.array([7.0, -5.0])
    got = run(parse_delay("E2"), first, x)
    # k = 2: the first reference twice, then x0, x1, x2; x3 and x4 are still on their way.
    np.testing.assert_array_equal(got, [[7, -5], [7, -5], [10, -10], [11, -11], [12, -12]])
    np.testing.assert_array_equal(run(parse_delay("E0"), first, x), x)
    np.testing.assert_array_equal(run(parse_delay("E1"), first, x)[:, 0], [7, 10, 11, 12, 13])


@pytest.mark.parametrize("steps", [1, 3, 5, 8])
def test_queue_is_a_shift(steps):
    first, x = noise(1)
    got = run(
        parse_delay(f"E{steps}"), jnp.asarray(first, jnp.float32), jnp.asarray(x, jnp.float32)
    )
    np.testing.assert_array_equal(got[steps:], np.float32(x)[:-steps])
    np.testing.assert_array_equal(got[:steps], np.float32(first)[None].repeat(steps, 0))


def test_second_order_step_by_hand():
    """Order 2 at 12.5 Hz: tan(pi fc T) = 1, so with s = sqrt 2 the bilinear transform gives
    b0 = 1 / (2 + s) = 0.29289, b = b0 (1, 2, 1), a1 = 0, a2 = (2 - s) / (2 + s) = 0.171573.

    A step from 0 to 1: y0 = b0 = 0.292893; y1 = b0 + 2 b0 = 0.878680;
    y2 = 4 b0 - a2 y0 = 1.171573 - 0.050253 = 1.121320;
    y3 = 1.171573 - a2 y1 = 1.171573 - 0.150758 = 1.020815.
    """
    step = jnp.ones((4, 1))
    got = run(parse_delay("butter:2:12.5Hz"), jnp.zeros(1), step)
    np.testing.assert_allclose(got[:, 0], [0.292893, 0.878680, 1.121320, 1.020815], atol=1e-6)


@pytest.mark.parametrize("order", [1, 2, 3, 4, 7])
def test_sections_are_those_of_docs_equations(order, repo_root):
    """The page's formulas, evaluated as they stand there."""
    text = (repo_root / "docs" / "equations.md").read_text()
    block = re.search(r"^pair i(.*?)^start +(.*?)  +v:", text, re.MULTILINE | re.DOTALL)
    assert block
    names = {"f": 10.4, "T": CONTROL_DT_S, "pi": math.pi, "sin": math.sin, "tan": math.tan}
    pair, odd = block[1].split("odd order   one more section:")

    def section(formulas: str, i: int) -> list[float]:
        """b0, b1, b2, a1, a2 of formulas in which a space is a product; in the order needed."""
        found = dict(names, n=order, i=i)
        parts = [part.strip() for part in re.split(r",  |\n", formulas) if "=" in part]
        for part in sorted(parts, key=lambda part: "kdcba".index(part[0])):
            *targets, formula = part.split(" = ")
            formula = re.sub(r"(?<=[\w)]) (?=[\w(])", " * ", formula.replace("^", "**"))
            found |= dict.fromkeys(targets, eval(formula, {}, found))
        return [found[name] for name in ("b0", "b1", "b2", "a1", "a2")]

    wanted = [section(pair, i) for i in range(order // 2)]
    k = "k = tan(pi f T)"
    wanted += [section(f"{k},  {odd}", 0)] * (order % 2)
    got = lag.sections(Delay("literal", order=order, cutoff_hz=10.4))
    np.testing.assert_allclose(got, wanted, rtol=1e-12)  # the same numbers, summed in another order
    state = lag.init(Delay("literal", order=order, cutoff_hz=10.4), jnp.ones(1)).sections
    starts = block[2].split(",  ")
    assert starts == ["s1 = (1 - b0) v", "s2 = (b2 - a2) v"]
    np.testing.assert_allclose(
        state[..., 0], [[1 - b0, b2 - a2] for b0, _, b2, _, a2 in wanted], rtol=1e-6
    )


def test_sections_are_cached_plain_numbers():
    delay = parse_delay("B4_4")
    assert lag.sections(delay) is lag.sections(delay)
    assert len(lag.sections(delay)) == 2
    assert all(isinstance(x, float) for row in lag.sections(delay) for x in row)
    assert lag.sections(parse_delay("E2")) == ()


@settings(max_examples=16, deadline=None, derandomize=True, phases=NO_SHRINKING)
@given(order=st.integers(1, 8), cutoff_hz=st.floats(0.5, 24.0), seed=st.integers(0, 2**31))
def test_filter_equals_scipy_in_float64(order, cutoff_hz, seed):
    delay = Delay("literal", order=order, cutoff_hz=cutoff_hz)
    first, x = noise(seed)
    with jax.enable_x64(True):
        got = run(delay, jnp.asarray(first), jnp.asarray(x))
    # The same sections in the same order; only the start state is computed differently, with a
    # rounding of 1e-16 times the poles' nearness to 1.
    atol = 1e-15 * 10 * max(1.0, gain_sensitivity(delay))
    np.testing.assert_allclose(got, filtered(delay, first, x), rtol=0, atol=atol)


@settings(max_examples=8, deadline=None, derandomize=True, phases=NO_SHRINKING)
@given(order=st.integers(1, 8), cutoff_hz=st.floats(0.5, 24.0), seed=st.integers(0, 2**31))
def test_filter_equals_scipy_in_float32(order, cutoff_hz, seed):
    delay = Delay("literal", order=order, cutoff_hz=cutoff_hz)
    first, x = (np.float32(v) for v in noise(seed))
    got = run(delay, jnp.asarray(first), jnp.asarray(x))
    # References up to pi + 2 rad; roundings of 6e-8 in coefficients and states, amplified by the
    # gain's sensitivity to them (10 at the paper's cutoffs: 5e-6 rad).
    atol = 6e-8 * 5 * max(8.0, gain_sensitivity(delay))
    np.testing.assert_allclose(got, filtered(delay, first, x), rtol=0, atol=atol)


@pytest.mark.parametrize("name", ["B4_4", "B4_21"])
def test_paper_filters_in_float32(name):
    delay = parse_delay(name)
    first, x = (np.float32(v) for v in noise(5, 1000))
    got = run(delay, jnp.asarray(first), jnp.asarray(x))
    # 5 rad * 6e-8 a rounding, ten of them: 3e-6 rad is 3 um at the tool.
    np.testing.assert_allclose(got, filtered(delay, first, x), rtol=0, atol=3e-6)


@pytest.mark.parametrize("name", ["E0", "E3", "B4_4", "B4_21", "butter:1:5Hz", "butter:7:3Hz"])
def test_constant_in_constant_out_for_ever(name):
    """The filter starts settled on its first input, whatever the order."""
    delay = parse_delay(name)
    first = np.random.default_rng(3).uniform(-np.pi, np.pi, JOINTS)
    with jax.enable_x64(True):
        got = run(delay, jnp.asarray(first), jnp.broadcast_to(first, (3000, JOINTS)))
    # 1e-12: a rounding of 1e-16 at each section, kept by poles at 1 - 1 / 30 or less.
    np.testing.assert_allclose(got, np.broadcast_to(first, got.shape), rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["B4_4", "B4_21"])
def test_constant_stays_in_float32(name):
    first = np.random.default_rng(4).uniform(-np.pi, np.pi, JOINTS).astype(np.float32)
    got = run(parse_delay(name), jnp.asarray(first), jnp.broadcast_to(first, (3000, JOINTS)))
    # 3 um at the tool, as above.
    np.testing.assert_allclose(got, np.broadcast_to(first, got.shape), rtol=0, atol=3e-6)


@settings(max_examples=6, deadline=None, derandomize=True, phases=NO_SHRINKING)
@given(order=st.integers(1, 8), cutoff_hz=st.floats(2.0, 24.0))
def test_dc_gain_is_one(order, cutoff_hz):
    """A step ends on its height: from another start, after many time constants."""
    delay = Delay("literal", order=order, cutoff_hz=cutoff_hz)
    with jax.enable_x64(True):
        got = run(delay, jnp.array([0.3]), jnp.full((600, 1), -1.2))
    # The slowest pole (order 8: damping 0.195 at 2 Hz) decays by exp(-0.195 * 12.6 / s * 12 s)
    # = 1e-13.
    assert float(got[-1, 0]) == pytest.approx(-1.2, abs=1e-10)


@pytest.mark.parametrize(
    "name", ["E0", "E1", "E2", "B4_21", "B4_4", "butter:2:3Hz", "butter:6:8Hz"]
)
def test_a_slow_ramp_is_late_by_the_group_delay(name):
    delay = parse_delay(name)
    slope = 0.05  # rad/s
    ramp = slope * CONTROL_DT_S * np.arange(1, 401)[:, None]
    with jax.enable_x64(True):
        late = run(delay, jnp.zeros(1), jnp.asarray(ramp))
    measured_s = (ramp[-1, 0] - float(late[-1, 0])) / slope
    # 1e-9 s: after 8 s the start has decayed; 1e-16 rad / (0.05 rad/s).
    assert measured_s == pytest.approx(delay.group_delay_s, abs=1e-9)


def test_state_is_a_fixed_point_of_apply():
    for name in ("E0", "E2", "B4_4"):
        delay = parse_delay(name)
        state = lag.init(delay, jnp.zeros(JOINTS))
        after = jax.eval_shape(functools.partial(lag.apply, delay), state, jnp.zeros(JOINTS))[0]
        assert jax.tree.map(lambda x: (x.shape, x.dtype), state) == jax.tree.map(
            lambda x: (x.shape, x.dtype), after
        )


def test_a_new_start_forgets_the_old_episode():
    delay = parse_delay("E2")
    state = lag.init(delay, jnp.zeros(2))
    for x in (1.0, 2.0, 3.0):
        state, _ = lag.apply(delay, state, jnp.full(2, x))
    np.testing.assert_array_equal(state.queue, [[2.0, 2.0], [3.0, 3.0]])
    np.testing.assert_array_equal(lag.init(delay, jnp.full(2, 9.0)).queue, np.full((2, 2), 9.0))


def test_queue_then_filter():
    """Both stages at once (no named delay has both): the queue's output enters the filter."""
    both = Delay("both", steps=2, order=4, cutoff_hz=10.4)
    first, x = noise(9)
    with jax.enable_x64(True):
        got = run(both, jnp.asarray(first), jnp.asarray(x))
    want = filtered(both, first, np.concatenate([[first, first], x[:-2]]))
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-13)
    assert both.group_delay_s == pytest.approx(0.040 + parse_delay("B4_4").group_delay_s)
