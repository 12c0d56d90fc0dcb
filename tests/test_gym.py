"""Gymnasium environments: the checker, one against many against the task itself, autoreset."""

import dataclasses

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from mcx_jax import gym
from mcx_jax.env_config import EnvConfig, MotionConfig
from mcx_jax.envs.v2v import make_env
from mcx_jax.errors import UserError

STEPS = 12
# implicitfast chatters less: rounding is not amplified as much as by Euler.
QUIET = {"delay": "E2", "sea": "Wd", "integrator": "implicitfast", "episode_steps": STEPS}
MANY = 3
SMALL = 0.03
"""Actions, cm and crad: 0.3, drawn anew every step, drives servos to their torque limits, where
rounding grows to 2e-4 m within a dozen steps."""
# Other fusions, other roundings (float32, poses of 1 m, a dozen steps); errors in mm and mrad.
CLOSE, CLOSE_MILLI = 2e-5, 2e-2


@pytest.fixture(scope="module")
def one():
    return gymnasium.make(gym.ENV_ID, **QUIET)


@pytest.fixture(scope="module")
def many():
    return gymnasium.make_vec(gym.ENV_ID, num_envs=MANY, **QUIET)


def actions(count, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-SMALL, SMALL, (count, MANY, 6)).astype(np.float32)


def assert_same(got, want, name=""):
    """Gymnasium's results: arrays, numbers, and infos of them with the same keys."""
    if isinstance(want, dict):
        assert set(got) == set(want), name
        for key in want:
            assert_same(got[key], want[key], f"{name} {key}")
    elif isinstance(want, np.ndarray) and want.dtype == object:
        assert [x is None for x in got] == [x is None for x in want], name
        for a, b in zip(got, want, strict=True):
            if b is not None:
                assert_same(a, b, name)
    else:
        atol = CLOSE_MILLI if name.endswith(("dp_mm", "da_mrad")) else CLOSE
        np.testing.assert_allclose(got, want, rtol=0, atol=atol, err_msg=name)


# Positions have no bound that holds for any arm; actions are in cm and crad, not in units of 10.
@pytest.mark.filterwarnings("ignore:.*A Box observation space m(ini|axi)mum value is -?infinity")
@pytest.mark.filterwarnings("ignore:.*recommend using a symmetric and normalized space")
def test_gymnasium_accepts_it(one):
    check_env(one.unwrapped)


def test_spaces(one, many):
    assert one.observation_space.shape == (38,) and one.action_space.shape == (6,)
    assert one.observation_space.dtype == one.action_space.dtype == np.float32
    np.testing.assert_array_equal(one.action_space.low, -5.0)
    np.testing.assert_array_equal(one.action_space.high, 5.0)
    assert many.observation_space.shape == (MANY, 38) and many.action_space.shape == (MANY, 6)
    assert many.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    obs, _ = many.reset(seed=0)
    assert obs in many.observation_space
    obs, reward, terminated, truncated, info = many.step(many.action_space.sample())
    assert obs in many.observation_space and obs.flags.writeable
    assert reward.shape == terminated.shape == truncated.shape == (MANY,)
    assert terminated.dtype == truncated.dtype == info["valid"].dtype == bool


def test_many_are_gymnasiums_own_vector_of_single_ones(many):
    single = lambda: gymnasium.make(gym.ENV_ID, **QUIET)  # noqa: E731
    theirs = SyncVectorEnv([single] * MANY, autoreset_mode=AutoresetMode.SAME_STEP)
    for got, want in zip(many.reset(seed=5), theirs.reset(seed=5), strict=True):
        assert_same(got, want, "reset")
    ends = []
    for i, action in enumerate(actions(2 * STEPS + 1)):
        got, want = many.step(action), theirs.step(action)
        for name, a, b in zip(("obs", "reward", "end", "cut", "info"), got, want, strict=True):
            assert_same(a, b, f"step {i}: {name}")
        ends.append(got[3])
    assert np.flatnonzero(np.all(ends, axis=1)).tolist() == [STEPS - 1, 2 * STEPS - 1]
    assert np.sum(ends) == 2 * MANY


def test_against_the_task(one):
    env_config = EnvConfig(delay="E2", integrator="implicitfast", episode_steps=STEPS)
    env = make_env(env_config, MotionConfig(sea="Wd"), split="train")
    reset = jax.jit(lambda env, key: env.reset(key))
    step = jax.jit(lambda env, state, action: env.step(state, action))
    for episode in range(2):
        obs, info = one.reset(seed=11) if episode == 0 else one.reset()
        state = reset(env, jax.random.fold_in(jax.random.key(11), episode))
        assert_same(obs, np.asarray(state.obs))
        for i, action in enumerate(actions(STEPS, seed=episode)[:, 0]):
            obs, reward, terminated, truncated, info = one.step(action)
            state = step(env, state, jnp.asarray(action))
            assert_same(obs, np.asarray(state.obs))
            dp_m, da_rad = state.metrics.pos_error_m, state.metrics.ang_error_rad
            assert reward == pytest.approx(-float(dp_m + da_rad), abs=CLOSE)
            assert_same(
                info, {"dp_mm": 1e3 * float(dp_m), "da_mrad": 1e3 * float(da_rad), "valid": True}
            )
            assert (terminated, truncated) == (False, i == STEPS - 1)


def test_final_observation_is_the_old_episodes(many):
    many.reset(seed=2)
    for action in actions(STEPS):
        obs, reward, _, truncated, info = many.step(action)
    assert truncated.all()
    final = np.stack(info["final_obs"])
    # Entries 36 and 37 are dp and da, which the reward is made of.
    np.testing.assert_allclose(-final[:, 36:].sum(1), reward, rtol=1e-5)
    np.testing.assert_allclose(info["final_info"]["dp_mm"], 1e3 * final[:, 36], rtol=1e-5)
    np.testing.assert_allclose(info["dp_mm"], 1e3 * obs[:, 36], rtol=1e-5)
    assert np.abs(final[:, 9:12] - obs[:, 9:12]).max(1).min() > 1e-3  # another goal


def test_seeds(many):
    first, _ = many.reset(seed=7)
    second, _ = many.reset()
    assert not np.allclose(first, second)
    np.testing.assert_array_equal(many.reset(seed=7)[0], first)
    np.testing.assert_array_equal(many.reset()[0], second)
    np.testing.assert_array_equal(many.reset(seed=[9, 7, None])[0][1], first[0])
    np.testing.assert_array_equal(many.reset(seed=8)[0][:-1], first[1:])


def test_training_and_test_motion_differ(one):
    other = gymnasium.make(gym.ENV_ID, test=True, **QUIET)
    assert not np.allclose(one.reset(seed=1)[0], other.reset(seed=1)[0])


def test_compiled_once(many):
    many.reset(seed=0)
    many.step(actions(1)[0])
    sizes = gym._reset._cache_size(), gym._step._cache_size()
    for action in actions(STEPS):  # one reset among them
        many.step(action)
    many.reset(seed=[4, None, 6])
    assert (gym._reset._cache_size(), gym._step._cache_size()) == sizes


def test_a_diverged_environment_is_cut_and_never_shown(many):
    """One of three gets a state that is not finite in the middle of its episode."""
    many.reset(seed=3)
    before = many.step(actions(1)[0])
    episodes = many.unwrapped._episodes
    arm = episodes.state.arm
    bad = dataclasses.replace(arm, q=arm.q.at[:, 1].set(jnp.nan))
    episodes.state = dataclasses.replace(episodes.state, arm=bad)
    obs, reward, terminated, truncated, info = many.step(actions(1)[0])
    assert truncated.tolist() == [False, True, False] and not terminated.any()
    assert info["final_info"]["valid"].tolist() == [False, False, False]
    assert info["final_info"]["_valid"].tolist() == [False, True, False]
    np.testing.assert_array_equal(info["final_obs"][1], before[0][1])
    assert reward[1] == before[1][1]
    assert np.isfinite(obs).all() and np.isfinite(reward).all() and info["valid"].all()
    obs, _, _, truncated, _ = many.step(actions(1)[0])
    assert np.isfinite(obs).all() and not truncated.any()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"dely": "E2"}, "unknown setting 'dely': use test or a field of EnvConfig or Motion"),
        ({"delay": "F2"}, "unknown delay 'F2'"),
        ({"delay": 2}, "setting delay is 2, must be of type str"),
        ({"physics": "MJX"}, "setting physics is 'MJX', must be one of chain, mjx"),
        ({"split": "Paper"}, "setting split is 'Paper', must be one of seeds, paper"),
        ({"num_envs": 0}, "num_envs 0: must be a positive integer"),
    ],
)
def test_mistakes(settings, message):
    with pytest.raises(UserError, match=message):
        gym.V2VVector(**settings)


def test_mistakes_in_seeds(many):
    with pytest.raises(UserError, match="2 seeds for 3 environments"):
        many.reset(seed=[1, 2])
    with pytest.raises(UserError, match="must be 0 to 2"):
        many.reset(seed=2**32 - 1)
