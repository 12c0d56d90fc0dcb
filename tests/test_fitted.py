"""Controllers that are fitted on training motion."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mcx_jax.config.task import ConditionsConfig, EnvConfig, MotionConfig
from mcx_jax.controllers import fitted
from mcx_jax.controllers.classical import Extrapolate, Preview
from mcx_jax.envs.conditions import Conditions, Measurement
from mcx_jax.envs.v2v import make_env
from mcx_jax.errors import UserError
from mcx_jax.spatial import unpack, unpack_matrix

SEA = MotionConfig(sea="Wc")
QUIET = EnvConfig(delay="E1", integrator="implicitfast", episode_steps=100)
LEAD_STEPS = 20
"""40 ms in physics steps."""


@pytest.fixture(scope="module")
def small():
    """Fewer episodes to fit on: a test is no contest."""
    patch = pytest.MonkeyPatch()
    patch.setattr(fitted, "FIT_EPISODES", 12)
    yield
    patch.undo()


def data(env, seed=9, lead=LEAD_STEPS, age=0):
    keys = jax.random.split(jax.random.key(seed), 8)
    x, y = fitted._regression(env, keys, jnp.int32(lead), jnp.int32(age))
    return (np.asarray(a, np.float64).reshape(-1, a.shape[-1]) for a in (x, y))


def rms(x):
    return np.sqrt(np.mean(np.square(x), axis=0))


def test_the_filter_predicts_better_than_a_straight_line(small):
    """On test motion, fitted on training motion; lines go through the last two poses."""
    train, test = (make_env(QUIET, SEA, split=split) for split in ("train", "test"))
    fir = fitted.fit_fir(train, 0.002 * LEAD_STEPS)
    x, y = data(test)
    missed = rms(y - x @ np.asarray(fir.weights[0], np.float64))
    last_change = x.reshape(len(x), 2, fitted.TAPS - 1, 3)[:, :, -1].reshape(-1, 6)
    straight = rms(y - 2.0 * last_change)
    # Measured: 3 to 14 % of what the line misses, of six components.
    assert np.all(missed < 0.25 * straight), (missed, straight)


def test_no_motion_asks_for_no_correction(small):
    env = make_env(QUIET, SEA, split="train")
    state = env.reset(jax.random.key(0))
    fir = fitted.fit_fir(env, 0.03)
    memory, action = fir.act(env, state, fir.init(env, state))
    np.testing.assert_allclose(action, np.zeros(6), atol=1e-4)
    assert memory.shape == (fitted.TAPS, 12)


@pytest.mark.parametrize("who", ["extrapolate-best", "fir"])
def test_a_lead_that_diverges_is_never_the_best(who, monkeypatch):
    env = make_env(QUIET, SEA, split="train")
    monkeypatch.setattr(fitted, "fit_fir", lambda env, lead_s: lead_s)
    scores = iter([0.3, np.nan, 0.2, *[0.4] * (len(fitted.LEADS_S) - 3)])
    monkeypatch.setattr(fitted, "_score", lambda env, controller: next(scores))
    chosen = fitted.fitted(who, env)
    lead_s = chosen if who == "fir" else float(chosen.lead_s)
    assert lead_s == pytest.approx(env.known_delay.group_delay_s + fitted.LEADS_S[2])
    monkeypatch.setattr(fitted, "_score", lambda env, controller: np.nan)
    with pytest.raises(UserError, match=f"{who}: the arm diverges"):
        fitted.fitted(who, env)


def test_no_controller_computes_rotations_outside_a_wall():
    """Without walls XLA computed them again for every number of the action: 195 us, not 3."""
    measured = Measurement(jnp.eye(3), jnp.zeros(3), jnp.zeros((0, 12)))
    state = SimpleNamespace(measured=measured, conditions=Conditions(*[None] * 5))
    ahead = unpack_matrix(measured.rotation), unpack(measured.position, 3)

    def act(controller, wall):
        delay = SimpleNamespace(group_delay_s=0.03)
        env: Any = SimpleNamespace(wall=wall, known_delay=delay, goal_ahead=lambda *_: ahead)
        return controller.act(env, state, controller.init(env, state))

    weights = jnp.zeros((1, 6 * (fitted.TAPS - 1), 6))
    for controller in (Extrapolate(), Preview(), fitted.Fir(weights)):
        outside = jax.make_jaxpr(lambda wall: act(controller, wall))(jnp.asarray(True))  # noqa: B023
        free = jax.make_jaxpr(lambda: act(controller, None))()  # noqa: B023
        assert {"sqrt", "atan2"} <= operations(free)  # what this test looks for is there
        assert not {"sqrt", "atan2", "sin", "cos"} & operations(outside), controller


def operations(traced):
    """Names of the operations that are in no branch of a conditional."""
    names = set()
    for equation in traced.eqns:
        names.add(equation.primitive.name)
        inner = equation.params.get("jaxpr") if equation.primitive.name != "cond" else None
        names |= operations(inner) if inner is not None else set()
    return names


def test_a_short_episode_is_fitted_on_motion_that_there_is(small):
    """Windows end 2 s after the episode; 500 steps would read beyond the table in some."""
    env = make_env(QUIET, SEA, split="train")
    keys = jax.random.split(jax.random.key(0), 2)
    x, _ = fitted._regression(env, keys, jnp.int32(LEAD_STEPS), jnp.int32(0))
    assert x.shape[1] == 100 + 50 - fitted.TAPS + 1


def test_late_measurements_have_weights_of_their_own(small):
    late = dataclasses.replace(QUIET, conditions=ConditionsConfig(latency_steps="0:2"))
    env = make_env(late, SEA, split="train")
    fir = fitted.fit_fir(env, 0.002 * LEAD_STEPS)
    assert fir.weights.shape == (3, 6 * (fitted.TAPS - 1), 6)
    for age in range(3):
        x, y = data(env, age=age)
        own = rms(y - x @ np.asarray(fir.weights[age], np.float64))[:3]
        other = rms(y - x @ np.asarray(fir.weights[(age + 1) % 3], np.float64))[:3]
        assert np.all(own < 0.7 * other)  # the other weights predict for 20 ms too early or late
