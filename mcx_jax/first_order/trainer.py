"""Training by back-propagation through the simulator (first-order policy gradient).

The loss is the mean tracking error of a window of some ten control steps; its gradient runs through
the arm's physics, the lag, the IK and the policy's memory. Nothing here outlasts ten steps: the
longest delay is two of them. Episodes and memories live on from window to window, with no gradient
between windows (truncated back-propagation through time; compare SHAC, Xu et al. 2022, without its
critic).

The environment's values are the real ones, its derivative is that of an arm whose servos neither
chatter nor saturate (`envs.chain.joint_accelerations`).
"""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from mcx_jax.arm.chain import SMOOTH
from mcx_jax.config.training import TrainConfig
from mcx_jax.policy.networks import init_params, step
from mcx_jax.policy.normalise import RunningStats, init_stats, merge, normalise_obs
from mcx_jax.ppo.loss import reported_mean
from mcx_jax.ppo.rollout import Actors, init_actors, insert_block, replace_broken, step_all
from mcx_jax.ppo.trainer import learning_rate, networks_of
from mcx_jax.ppo.update import Fitted, gradient_step, init_fitted

CHATTERING_GRADIENT = 0.5
"""Factor of the gradient through what is seen, for integrators under which servos chatter: what is
seen is noisy there, and the true derivative (1) grows with the policy's gain. E0, implicitfast, 600
windows at 1e-3, means of the four seas: 0.029 to 0.121 mm; at 0 (observations count as given) 0.041
to 0.152 mm, at 1 0.057 to 0.205 mm. Under quiet 1 is better: B4_4, 3 M steps, 0.060 to 0.190 mm,
with 0.5 0.084 to 0.249 mm."""


@struct.dataclass
class Learner:
    """The policy alone: no critic is needed."""

    policy: Fitted


@struct.dataclass
class TrainState:
    """Everything needed to go on exactly where training stopped; fields as `ppo.trainer`'s."""

    learner: Learner
    obs_stats: RunningStats
    actors: Actors
    key: jax.Array
    iteration: jax.Array


@struct.dataclass
class IterationMetrics:
    """What an iteration reports; all () float32.

    Attributes:
        pos_error_mm: mean position error over the valid steps (no exploration noise).
        ang_error_mrad: mean orientation error over the same.
        reward: mean reward over the same.
        invalid_share: share of steps that are not valid.
        rejected_share: the same: they are left out of the loss.
        policy_grad_norm: mean over the windows, before clipping.
        skipped_updates: windows whose gradient was not finite.
        lr: step size.
        reset_envs: environments that held a number that is not finite and were reset.
        lost: 1 if nothing was learned: no step valid, or no gradient finite.
    """

    pos_error_mm: jax.Array
    ang_error_mrad: jax.Array
    reward: jax.Array
    invalid_share: jax.Array
    rejected_share: jax.Array
    policy_grad_norm: jax.Array
    skipped_updates: jax.Array
    lr: jax.Array
    reset_envs: jax.Array
    lost: jax.Array


def training_env(env: Any) -> Any:
    """The environment with a useful derivative; its values stay what they are."""
    name = getattr(env, "integrator", None)
    return env.replace(integrator=name + SMOOTH) if name else env


def init(config: TrainConfig, env: Any, seed: jax.Array, blocks: list[Any]) -> TrainState:
    """First weights; observation statistics from the first observations. Arguments as PPO's."""
    nets = networks_of(config.ppo, env.action_size)
    key, policy_key = jax.random.split(jax.random.key(seed))
    params = init_params(nets.policy, policy_key, env.obs_size)
    actors = init_actors(nets, blocks, config.num_envs, config.shards)
    first_obs = actors.env_state.obs.T
    finite = jnp.all(jnp.isfinite(first_obs), axis=1).astype(jnp.float32)
    return TrainState(
        learner=Learner(policy=init_fitted(params, config.ppo.max_grad_norm)),
        obs_stats=merge(init_stats((env.obs_size,)), first_obs, finite),
        actors=replace(actors, value_carry=()),
        key=key,
        iteration=jnp.zeros((), jnp.int32),
    )


def window_gradient(params, config: TrainConfig, env: Any, stats: RunningStats, actors: Actors):
    """Mean of dp + da (m + rad) over a window's valid steps, with --relative-mm of a logarithm of
    it, and its gradient by the policy.

    The gradient runs from an error through the physics, the lag and the IK to the actions before
    it, and through the policy's memory to its weights; on the way from an action through what is
    seen afterwards to later actions it is multiplied by CHATTERING_GRADIENT a step, unless the
    integrator is quiet.

    Returns:
        (loss, gradient, (actors after the window, observations (T, N, F), metrics, leaves (T, N))).
    """
    nets = networks_of(config.ppo, env.action_size)
    quiet = getattr(env, "integrator", "") == "quiet" + SMOOTH
    through = 1.0 if quiet else CHATTERING_GRADIENT

    def simulate(params):
        def one_step(carry: Actors, _):
            obs = carry.env_state.obs.T
            fixed = jax.lax.stop_gradient(obs)
            seen = normalise_obs(stats, fixed + through * (obs - fixed))
            memory, action, _ = step(nets.policy, params, carry.policy_carry, seen)
            env_state = jax.checkpoint(step_all)(env, carry.env_state, action)
            after = Actors(env_state=env_state, policy_carry=memory, value_carry=())
            return after, (fixed, env_state.metrics)

        steps = config.first_order.horizon_steps
        after, (obs, metrics) = jax.lax.scan(one_step, actors, None, steps)
        count = jnp.sum(metrics.valid, axis=0)

        def mean(error: jax.Array) -> jax.Array:
            """(N,) of the valid steps; where, not a product: a NaN times zero is NaN."""
            return jnp.sum(jnp.where(metrics.valid, error, 0.0), axis=0) / jnp.maximum(count, 1)

        scale = 1e-3 * config.first_order.relative_mm
        terms = mean(metrics.pos_error_m), mean(metrics.ang_error_rad)
        if scale:
            terms = tuple(scale * jnp.log1p(error / scale) for error in terms)
        loss = jnp.sum(count * (terms[0] + terms[1])) / jnp.maximum(jnp.sum(count), 1)
        return loss, (after, obs, metrics)

    (loss, aux), gradient = jax.value_and_grad(simulate, has_aux=True)(params)
    return loss, gradient, aux


def iterate(
    config: TrainConfig, env: Any, state: TrainState, fresh: Any
) -> tuple[TrainState, IterationMetrics]:
    """Renew one block of environments, then a gradient step for each window of the iteration.

    Args:
        fresh: environments just reset, leaves (..., block_envs).
    """
    settings = config.first_order
    env = training_env(env)
    actors = insert_block(state.actors, fresh, state.iteration, config.reset_groups, config.shards)
    lr = learning_rate(config, settings.learning_rate, state.iteration)

    def one_window(carry, _):
        fitted, actors = carry
        actors, reset_envs = replace_broken(actors, fresh, config.shards)
        _, grads, (after, obs, metrics) = window_gradient(
            fitted.params, config, env, state.obs_stats, actors
        )
        fitted, stats = gradient_step(fitted, grads, lr, config.ppo.max_grad_norm)
        return (fitted, after), (obs, metrics, stats, reset_envs)

    (fitted, actors), (obs, metrics, stats, reset_envs) = jax.lax.scan(
        one_window, (state.learner.policy, actors), None, settings.windows
    )
    seen = metrics.valid & jnp.all(jnp.isfinite(obs), axis=-1)
    new_state = TrainState(
        learner=Learner(policy=fitted),
        obs_stats=merge(state.obs_stats, obs, seen.astype(jnp.float32)),
        actors=actors,
        key=state.key,
        iteration=state.iteration + 1,
    )
    return new_state, _metrics(metrics, stats, lr, jnp.sum(reset_envs))


def _metrics(metrics: Any, stats: Any, lr: jax.Array, reset_envs: jax.Array) -> IterationMetrics:
    valid = metrics.valid.astype(jnp.float32)
    learned = jnp.any(metrics.valid) & jnp.any(stats.skipped == 0)
    position = reported_mean(metrics.pos_error_m, valid)
    angle = reported_mean(metrics.ang_error_rad, valid)
    return IterationMetrics(
        pos_error_mm=1e3 * position,
        ang_error_mrad=1e3 * angle,
        reward=-(position + angle),
        invalid_share=jnp.mean(1.0 - valid),
        rejected_share=jnp.mean(1.0 - valid),
        policy_grad_norm=jnp.mean(stats.grad_norm),
        skipped_updates=jnp.sum(stats.skipped),
        lr=jnp.asarray(lr, jnp.float32),
        reset_envs=reset_envs,
        lost=1.0 - learned,
    )
