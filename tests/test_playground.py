"""Interface of MuJoCo Playground, used as its wrappers do: vmap, scan, more in the dicts."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mcx_jax.config.task import EnvConfig, MotionConfig
from mcx_jax.integrations.playground import V2V, State

STEPS = 10
MANY = 3


@pytest.fixture(scope="module")
def env():
    config = EnvConfig(delay="E1", integrator="implicitfast", episode_steps=STEPS)
    return V2V(config, MotionConfig(sea="Wb"))


@pytest.fixture(scope="module")
def program(env):
    """Reset MANY, then STEPS steps under a scan: the states before and after, rewards (T, N)."""

    def run(keys, actions, poison):
        first = jax.vmap(env.reset)(keys)
        # As Brax's EpisodeWrapper and EvalWrapper do.
        first.info["steps"] = jnp.zeros(MANY)
        first.metrics["reward"] = first.reward
        arm = first.data.arm
        poisoned = dataclasses.replace(arm, q=arm.q + poison[:, None])
        begun = first.replace(data=dataclasses.replace(first.data, arm=poisoned))

        def step(state, action):
            state = jax.vmap(env.step)(state, action)
            state.info["steps"] = state.info["steps"] + 1
            return state, (state.reward, state.done)

        last, (rewards, dones) = jax.lax.scan(step, begun, actions)
        return first, last, rewards, dones

    return jax.jit(run)


ACTIONS = np.random.default_rng(0).uniform(-0.03, 0.03, (STEPS, MANY, 6)).astype(np.float32)


def test_properties(env):
    assert (env.observation_size, env.action_size) == (38, 6)
    assert (env.dt, env.sim_dt, env.n_substeps) == (0.02, 0.002, 10)
    assert env.unwrapped is env
    state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
    assert isinstance(state, State)
    assert (state.obs.shape, state.reward.shape, state.done.shape) == ((38,), (), ())
    assert all(x.dtype == jnp.float32 for x in (state.obs, state.reward, state.done))
    assert all(x.dtype == jnp.float32 and x.shape == () for x in state.metrics.values())


@pytest.mark.slow
def test_is_the_task(env, program):
    keys = jax.random.split(jax.random.PRNGKey(4), MANY)
    first, last, rewards, dones = program(keys, ACTIONS, jnp.zeros(MANY))
    reset = jax.jit(lambda env, key: env.reset(key))
    step = jax.jit(lambda env, state, action: env.step(state, action))
    state = reset(env.env, keys[1])
    np.testing.assert_allclose(first.obs[1], state.obs, atol=1e-6)
    for i in range(STEPS):
        state = step(env.env, state, jnp.asarray(ACTIONS[i, 1]))
        # Other fusions, other roundings.
        np.testing.assert_allclose(rewards[i, 1], state.reward, atol=2e-5)
    np.testing.assert_allclose(last.obs[1], state.obs, atol=2e-5)
    np.testing.assert_allclose(last.metrics["dp_mm"], 1e3 * last.obs[:, 36], rtol=1e-5)
    np.testing.assert_allclose(last.metrics["da_mrad"], 1e3 * last.obs[:, 37], rtol=1e-5)
    assert set(last.metrics) == {"dp_mm", "da_mrad", "valid", "reward"}
    np.testing.assert_array_equal(last.info["steps"], STEPS)
    np.testing.assert_array_equal(last.metrics["valid"], 1.0)
    assert not dones.any()  # the time limit is the wrapper's


@pytest.mark.slow
def test_a_diverged_environment_is_invalid_and_never_shown(program):
    keys = jax.random.split(jax.random.PRNGKey(4), MANY)
    poison = jnp.array([0.0, jnp.nan, 0.0])
    first, last, rewards, dones = program(keys, ACTIONS, poison)
    np.testing.assert_array_equal(last.metrics["valid"], [1.0, 0.0, 1.0])
    np.testing.assert_array_equal(last.obs[1], first.obs[1])
    np.testing.assert_array_equal(rewards[:, 1], first.reward[1])
    assert np.isfinite(last.obs).all() and not dones.any()
