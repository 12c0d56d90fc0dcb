"""The compiled training iteration on probe environments: one program serves nearly all tests."""

import functools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probe_envs import make_probe

from mcx_jax.compute.sharding import env_mesh
from mcx_jax.config.task import EnvConfig
from mcx_jax.config.training import PPOConfig, TrainConfig
from mcx_jax.policy.networks import init_carry, init_params, step
from mcx_jax.policy.normalise import RunningStats, denormalise
from mcx_jax.ppo import trainer
from mcx_jax.ppo.rollout import init_actors, insert_block, reset_all
from mcx_jax.ppo.update import gradient_step, init_fitted
from mcx_jax.runs.programs import prepare, reset

CONFIG = TrainConfig(
    num_envs=64,
    total_steps=64 * 16 * 200,
    env=EnvConfig(episode_steps=32),
    ppo=PPOConfig(
        window_steps=16,
        sequence_steps=8,
        epochs=2,
        minibatches=4,
        gamma=0.9,
        gae_lambda=0.9,
        hidden=16,
        policy_lr=5e-3,
        value_lr=5e-3,
        lr_decay="constant",
        initial_sigma=0.5,
        reject_mean_sq_reward=100.0,
    ),
)


@functools.cache
def _training(config):
    return prepare(config, make_probe(), env_mesh(1))


def _train(env, iterations, config=CONFIG, seed=0):
    training = replace(_training(config), env=env, seeds=jnp.int32(seed))
    state, rows = training.start(), []
    for i in range(iterations):
        state, metrics = training.iterate(state, i)
        rows.append(metrics)
    return state, rows


def test_first_ratio_is_one_across_windows_and_resets():
    """Window 0 starts just reset, later ones in the middle of an episode but for the block that
    was reset at their start; each has two sequences, the second starting from a stored memory."""
    _, rows = _train(make_probe(hold=True), 5)
    for metrics in rows:
        assert float(metrics.first_ratio_deviation) < 1e-5
        assert float(metrics.policy_steps) > 0  # so the weights do change in between


def test_value_of_a_constant_reward():
    # 0.5 a step for ever at gamma 0.9 is worth 5; Adam at a constant step size wanders by 1 %.
    env = make_probe(constant_reward=0.5, scale=0.0)
    state, _ = _train(env, 60)
    stats = state.value_stats
    _, value = step(
        trainer.networks_of(CONFIG.ppo, env.action_size).value,
        state.learner.value.params,
        state.actors.value_carry,
        (state.actors.env_state.obs.T - state.obs_stats.mean) / state.obs_stats.std,
    )
    np.testing.assert_allclose(denormalise(stats, value), 5.0, atol=0.1)


@pytest.mark.parametrize(
    "probe", [{}, {"hold": True}, {"delay": 3}], ids=["one-step", "memory", "delay"]
)
def test_probe_is_learned(probe):
    """Mean squared error of the action: 0.58 at first (sigma^2 + 1/3), 1/3 is the best without
    seeing the target, or without remembering it."""
    _, rows = _train(make_probe(**probe), 100)
    assert 0.45 < float(rows[0].pos_error_mm) / 1e3 < 0.7
    assert float(rows[-1].pos_error_mm) / 1e3 < 0.08


def test_failed_environments_are_left_out():
    """NaN from step 20 of 32 on: the second window of an episode is never learned from."""
    state, rows = _train(make_probe(fail_at=20), 4)
    assert float(rows[0].rejected_share) == 0.0 and float(rows[0].invalid_share) == 0.0
    # After the first window one of the two blocks is reset in every iteration.
    assert [float(m.rejected_share) for m in rows[1:]] == [0.5, 0.5, 0.5]
    # 13 of the 16 steps 17..32 of an episode are invalid, in half of the environments.
    np.testing.assert_allclose([float(m.invalid_share) for m in rows[1:]], 13 / 32)
    assert [float(m.skipped_updates) for m in rows] == [0.0] * 4
    learned = (state.learner, state.obs_stats, state.value_stats)
    assert all(bool(jnp.all(jnp.isfinite(x))) for x in jax.tree.leaves(learned))
    assert all(np.isfinite(float(x)) for m in rows for x in jax.tree.leaves(m))


def test_kl_stop():
    """With a target of nearly 0 only the step at ratio 1 is made; the value network goes on."""
    config = replace(CONFIG, ppo=replace(CONFIG.ppo, target_kl=1e-9))
    state, (metrics,) = _train(make_probe(), 1, config)
    assert float(metrics.policy_steps) == 1.0
    assert float(metrics.kl) > 1.5e-9
    assert int(state.learner.policy.opt_state[1].count) == 1
    assert int(state.learner.value.opt_state[1].count) == 8


def test_seeds_in_one_call_are_the_single_seeds():
    """Not bit for bit: batched products sum in another order. After two iterations (16 Adam steps,
    the first of which amplify rounding: m / sqrt(v)) weights of size 0.1 agree within 1e-3."""
    together = prepare(replace(CONFIG, seed=5, seeds=2), make_probe(), env_mesh(1))
    states = together.start()
    for i in range(2):
        states, metrics = together.iterate(states, i)
    for k in range(2):
        state, rows = _train(make_probe(), 2, seed=5 + k)
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a[k], b, atol=1e-3),  # noqa: B023
            states.learner.policy.params,
            state.learner.policy.params,
        )
        np.testing.assert_allclose(metrics.reward[k], rows[-1].reward, rtol=1e-3)
    assert float(metrics.reward[0]) != float(metrics.reward[1])


def test_no_lapack():
    """jaxlib's batched LAPACK calls can wait for each other for ever (see `lstm`), so there must be
    none in a program of several seeds."""
    env, seeds = make_probe(), jnp.arange(2)
    fresh = jax.vmap(lambda seed: reset(CONFIG, env, seed, jnp.int32(0)))
    init = jax.vmap(lambda seed, blocks: trainer.init(CONFIG, env, seed, blocks))
    iterate = jax.vmap(lambda state, fresh: trainer.iterate(CONFIG, env, state, fresh))
    blocks = [jax.eval_shape(fresh, seeds)] * CONFIG.reset_groups
    states = jax.eval_shape(init, seeds, blocks)
    programs = (fresh, seeds), (init, seeds, blocks), (iterate, states, blocks[0])
    for function, *arguments in programs:
        assert "lapack" not in jax.jit(function).lower(*arguments).as_text()


@pytest.mark.parametrize(
    ("num_envs", "shards", "starts", "size"),
    [
        (10, 1, [0, 2, 5, 7], 3),  # G = 4 does not divide N: neighbours overlap
        (2, 1, [0, 0, 1, 1], 1),  # N < G
        (8, 2, [0, 1, 2, 3], 1),  # two shards of four: environments i and 4 + i
        (10, 2, [0, 1, 2, 3], 2),  # two shards of five
    ],
)
def test_blocks_cover_all_environments(num_envs, shards, starts, size):
    nets = trainer.networks_of(CONFIG.ppo, 2)
    env = make_probe()
    blocks = [reset_all(env, jax.random.key(i), shards * size) for i in range(4)]
    actors = init_actors(nets, blocks, num_envs, shards)
    assert actors.env_state.obs.shape == (4, num_envs)
    old = actors.replace(
        env_state=actors.env_state.replace(t=jnp.full((num_envs,), 9)),
        policy_carry=jax.tree.map(jnp.ones_like, actors.policy_carry),
        value_carry=jax.tree.map(jnp.ones_like, actors.value_carry),
    )
    insert = jax.jit(insert_block, static_argnums=(3, 4))
    for i in range(8):
        after = insert(old, blocks[i % 4], jnp.int32(i), 4, shards)
        expected = np.zeros((shards, num_envs // shards), bool)
        expected[:, starts[i % 4] : starts[i % 4] + size] = True
        expected = expected.ravel()
        assert ((np.asarray(after.env_state.t) == 0) == expected).all()
        np.testing.assert_array_equal(after.env_state.obs[:, expected], blocks[i % 4].obs)
        for carry in (after.policy_carry.h, after.policy_carry.c, after.value_carry.h):
            assert ((np.asarray(carry) == 0).all(axis=1) == expected).all()


def test_gradient_that_is_not_finite_is_left_out():
    fitted = init_fitted({"w": jnp.array([1.0, 2.0])}, 1.0)
    bad, stats = gradient_step(fitted, {"w": jnp.array([1.0, jnp.nan])}, jnp.float32(0.1), 1.0)
    assert float(stats.skipped) == 1.0
    jax.tree.map(np.testing.assert_array_equal, bad, fitted)
    # Adam's first step is lr * sign(g), whatever the clipping.
    good, stats = gradient_step(fitted, {"w": jnp.array([30.0, -40.0])}, jnp.float32(0.1), 1.0)
    np.testing.assert_allclose(good.params["w"], [0.9, 2.1], rtol=1e-5)
    assert float(stats.skipped) == 0.0 and float(stats.grad_norm) == 50.0


def test_learning_rate():
    config = replace(CONFIG, ppo=replace(CONFIG.ppo, lr_decay="cosine"))
    rates = [trainer.learning_rate(config, 1.0, jnp.int32(i)) for i in (0, 100, 200, 500)]
    # Half way: 0.05 + 0.95 * 0.5.
    np.testing.assert_allclose(rates, [1.0, 0.525, 0.05, 0.05], atol=1e-6)
    assert trainer.learning_rate(CONFIG, 0.25, jnp.int32(150)) == 0.25


def test_new_statistics_leave_the_values_alone():
    nets = trainer.networks_of(CONFIG.ppo, 2)
    value = init_params(nets.value, jax.random.key(0), 4)
    learner = trainer.Learner(policy=init_fitted(value, 1.0), value=init_fitted(value, 1.0))
    one = jnp.ones(())
    old, new = RunningStats(one, -one, 4 * one), RunningStats(one, 0.5 * one, 0.01 * one)
    changed = trainer.rescale_value(learner, old, new)
    obs = jax.random.normal(jax.random.key(1), (5, 4))
    carry = init_carry(nets.value, (5,))
    _, before = step(nets.value, learner.value.params, carry, obs)
    _, after = step(nets.value, changed.value.params, carry, obs)
    np.testing.assert_allclose(denormalise(new, after), denormalise(old, before), atol=1e-5)
