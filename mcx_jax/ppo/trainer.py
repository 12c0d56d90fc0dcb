"""One training iteration, rollout and learning in one pure function (run by `runs.programs`).

`env` is an argument (it holds the sea's tables; closed over, they would be baked into the program).
Several seeds are an outer `vmap` over the state.
"""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from mcx_jax.config.training import PPOConfig, TrainConfig
from mcx_jax.policy.networks import Networks, init_params, make_networks
from mcx_jax.policy.normalise import RunningStats, init_stats, merge
from mcx_jax.ppo.experience import Judged, judge
from mcx_jax.ppo.loss import masked_mean, reported_mean
from mcx_jax.ppo.rollout import Actors, Window, collect, init_actors, insert_block, replace_broken
from mcx_jax.ppo.update import Learner, UpdateStats, init_fitted, learn

VALUE_KEEP = 0.9
"""Weight that the value targets' statistics keep per iteration. A trained policy's returns are 20
times smaller than a beginner's: measured by those, they would drown in the network's own noise."""
COSINE_END = 0.05
"""Share of the first step size that a cosine schedule ends with."""


@struct.dataclass
class TrainState:
    """Everything needed to go on exactly where training stopped.

    Attributes:
        learner: weights and optimisers of both networks.
        obs_stats: running statistics of the observations, (F,).
        value_stats: running statistics of the value targets, ().
        actors: environments and memories, N of them.
        key: for all random numbers to come, () PRNG key.
        iteration: number of iterations done, () int32.
    """

    learner: Learner
    obs_stats: RunningStats
    value_stats: RunningStats
    actors: Actors
    key: jax.Array
    iteration: jax.Array


@struct.dataclass
class IterationMetrics:
    """What an iteration reports; all () float32.

    Attributes:
        pos_error_mm: mean position error over the valid steps, exploration noise included; NaN if
            there is none.
        ang_error_mrad: mean orientation error over the same.
        reward: mean reward over the same.
        invalid_share: share of steps that are not valid.
        rejected_share: share of windows that were not learned from.
        kl: last KL estimate of the iteration, nats.
        clip_share: share of clipped ratios, mean over the updates.
        entropy: of the policy, nats.
        sigma: mean standard deviation of the actions, centimetres and centiradians.
        explained_variance: of the value targets, before learning.
        value_loss: mean over the updates.
        policy_steps: policy steps taken (fewer than planned after a KL stop).
        policy_grad_norm: mean over the steps, before clipping.
        value_grad_norm: the same of the value network.
        skipped_updates: steps left out for a gradient that was not finite.
        first_ratio_deviation: largest |ratio - 1| on the first minibatch: rounding, or a mistake.
        lr: step size of the policy.
        reset_envs: environments that held a number that is not finite and were reset.
        lost: 1 if nothing was learned: no window accepted, or no step of one of the networks made.
    """

    pos_error_mm: jax.Array
    ang_error_mrad: jax.Array
    reward: jax.Array
    invalid_share: jax.Array
    rejected_share: jax.Array
    kl: jax.Array
    clip_share: jax.Array
    entropy: jax.Array
    sigma: jax.Array
    explained_variance: jax.Array
    value_loss: jax.Array
    policy_steps: jax.Array
    policy_grad_norm: jax.Array
    value_grad_norm: jax.Array
    skipped_updates: jax.Array
    first_ratio_deviation: jax.Array
    lr: jax.Array
    reset_envs: jax.Array
    lost: jax.Array


def networks_of(config: PPOConfig, action_size: int) -> Networks:
    """The networks of a configuration, without weights."""
    return make_networks(config.hidden, config.initial_sigma, action_size, config.cell)


def init(config: TrainConfig, env: Any, seed: jax.Array, blocks: list[Any]) -> TrainState:
    """First weights; observation statistics from the first observations.

    Args:
        seed: () int32.
        blocks: fresh environments for all blocks, see `rollout.init_actors`.
    """
    ppo, nets = config.ppo, networks_of(config.ppo, env.action_size)
    key, policy_key, value_key = jax.random.split(jax.random.key(seed), 3)
    policy = init_params(nets.policy, policy_key, env.obs_size)
    value = init_params(nets.value, value_key, env.obs_size)
    actors = init_actors(nets, blocks, config.num_envs, config.shards)
    first_obs = actors.env_state.obs.T
    finite = jnp.all(jnp.isfinite(first_obs), axis=1).astype(jnp.float32)
    return TrainState(
        learner=Learner(
            policy=init_fitted(policy, ppo.max_grad_norm),
            value=init_fitted(value, ppo.max_grad_norm),
        ),
        obs_stats=merge(init_stats((env.obs_size,)), first_obs, finite),
        value_stats=init_stats(()),
        actors=actors,
        key=key,
        iteration=jnp.zeros((), jnp.int32),
    )


def learning_rate(config: TrainConfig, first: float, iteration: jax.Array) -> jax.Array:
    """Step size of an iteration: constant, or half a cosine down to `COSINE_END` of the first."""
    if config.ppo.lr_decay == "constant":
        return jnp.float32(first)
    progress = jnp.clip(iteration / config.iterations, 0.0, 1.0)
    return first * (COSINE_END + (1 - COSINE_END) * 0.5 * (1 + jnp.cos(jnp.pi * progress)))


def iterate(
    config: TrainConfig, env: Any, state: TrainState, fresh: Any
) -> tuple[TrainState, IterationMetrics]:
    """Renew one block of environments, collect one window from every environment, learn from it.

    Args:
        fresh: environments just reset, leaves (..., block_envs).

    The statistics of observations and value targets are frozen during the iteration, so that
    rollout and learning see the same numbers and the first ratio is 1; they are merged at its end.
    """
    ppo, nets = config.ppo, networks_of(config.ppo, env.action_size)
    key, act_key, order_key = jax.random.split(state.key, 3)
    with jax.named_scope("rollout"):
        actors = insert_block(
            state.actors, fresh, state.iteration, config.reset_groups, config.shards
        )
        actors, reset_envs = replace_broken(actors, fresh, config.shards)
        act_keys = _step_keys(ppo, act_key)
        params = state.learner.policy.params
        after, window = collect(env, nets, params, state.obs_stats, actors, act_keys)
    with jax.named_scope("judge"):
        judged = judge(
            ppo,
            nets,
            state.learner.value.params,
            actors.value_carry,
            state.obs_stats,
            state.value_stats,
            window,
        )
    with jax.named_scope("learn"):
        rates = (
            learning_rate(config, ppo.policy_lr, state.iteration),
            learning_rate(config, ppo.value_lr, state.iteration),
        )
        learner, stats = learn(
            ppo, nets, rates, state.learner, judged.batch, order_key, config.shards
        )
    every_step = jnp.broadcast_to(judged.mask, judged.targets.shape)
    value_stats = merge(state.value_stats, judged.targets, every_step, VALUE_KEEP)
    learner = rescale_value(learner, state.value_stats, value_stats)
    new_state = TrainState(
        learner=learner,
        obs_stats=merge(state.obs_stats, window.steps.obs, every_step),
        value_stats=value_stats,
        actors=replace(after, value_carry=judged.value_carry),
        key=key,
        iteration=state.iteration + 1,
    )
    return new_state, _metrics(window, judged, stats, learner, rates[0], reset_envs)


def rescale_value(learner: Learner, old: RunningStats, new: RunningStats) -> Learner:
    """Change the value network's head so that its values, not normalised, stay what they were when
    the statistics change (Pop-Art, van Hasselt et al. 2016)."""
    params = learner.value.params["params"]
    head = params["net"]["head"]
    head = {
        "kernel": head["kernel"] * (old.std / new.std),
        "bias": (old.std * head["bias"] + old.mean - new.mean) / new.std,
    }
    params = {"params": {**params, "net": {**params["net"], "head": head}}}
    return replace(learner, value=replace(learner.value, params=params))


def _step_keys(config: PPOConfig, key: jax.Array) -> jax.Array:
    """One key for each step of a window, (K, L)."""
    chunks = config.window_steps // config.sequence_steps
    return jax.random.split(key, (chunks, config.sequence_steps))


def _metrics(
    window: Window,
    judged: Judged,
    stats: UpdateStats,
    learner: Learner,
    lr: jax.Array,
    reset_envs: jax.Array,
) -> IterationMetrics:
    env_metrics = window.steps.metrics
    valid = env_metrics.valid.astype(jnp.float32)
    raw_sigma = learner.policy.params["params"]["raw_sigma"]
    last = jnp.maximum(jnp.sum(stats.computed).astype(jnp.int32) - 1, 0)
    policy_moved = jnp.any(stats.stepped > stats.policy_step.skipped)
    value_moved = jnp.any(stats.value_step.skipped == 0)
    learned = jnp.any(judged.mask > 0) & policy_moved & value_moved
    return IterationMetrics(
        pos_error_mm=1e3 * reported_mean(env_metrics.pos_error_m, valid),
        ang_error_mrad=1e3 * reported_mean(env_metrics.ang_error_rad, valid),
        reward=reported_mean(window.steps.reward, valid),
        invalid_share=jnp.mean(1.0 - valid),
        rejected_share=jnp.mean(1.0 - judged.mask),
        kl=stats.surrogate.kl[last],
        clip_share=masked_mean(stats.surrogate.clip_share, stats.computed),
        entropy=stats.surrogate.entropy[last],
        sigma=jnp.mean(jax.nn.softplus(raw_sigma)),
        explained_variance=judged.explained_variance,
        value_loss=jnp.mean(stats.value_loss),
        policy_steps=jnp.sum(stats.stepped),
        policy_grad_norm=masked_mean(stats.policy_step.grad_norm, stats.stepped),
        value_grad_norm=jnp.mean(stats.value_step.grad_norm),
        skipped_updates=jnp.sum(stats.policy_step.skipped + stats.value_step.skipped),
        first_ratio_deviation=stats.surrogate.ratio_deviation[0],
        lr=lr,
        reset_envs=reset_envs,
        lost=1.0 - learned,
    )
