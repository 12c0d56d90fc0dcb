"""Training by back-propagation through the simulator (first-order policy gradient).

The loss is the mean tracking error of a window of some ten control steps; its gradient runs through
the arm's physics, the lag, the IK and the policy's memory. Nothing here outlasts ten steps: the
longest delay is two of them. Episodes and memories live on from window to window, with no gradient
between windows (truncated back-propagation through time; compare SHAC, Xu et al. 2022, without its
critic).

Under the Euler integrator the servo chatters, so the environment is run straight-through: the value
of the Euler step, the derivative of the implicitfast step (`envs.chain`).
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from mcx_jax.config import TrainConfig
from mcx_jax.ppo.networks import init_carry, init_params, step, unroll
from mcx_jax.ppo.normalise import RunningStats, init_stats, merge, normalise_obs
from mcx_jax.ppo.rollout import Actors, reset_all, reset_block, step_all
from mcx_jax.ppo.trainer import learning_rate, networks_of
from mcx_jax.sharding import over_envs
from mcx_jax.ppo.update import Fitted, gradient_step, init_fitted


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
    """

    pos_error_mm: jax.Array
    ang_error_mrad: jax.Array
    reward: jax.Array
    invalid_share: jax.Array
    rejected_share: jax.Array
    policy_grad_norm: jax.Array
    skipped_updates: jax.Array
    lr: jax.Array


def training_env(env: Any) -> Any:
    """The environment with a useful derivative; its values stay what they are."""
    chatters = getattr(env, "integrator", None) == "euler"
    return env.replace(integrator="straight-through") if chatters else env


def init(config: TrainConfig, env: Any, key: jax.Array) -> TrainState:
    """First weights, all environments reset, observation statistics from the first observations."""
    nets = networks_of(config.ppo, env.action_size)
    key, policy_key, env_key = jax.random.split(key, 3)
    params = init_params(nets.policy, policy_key, env.obs_size)
    memory = over_envs(init_carry(nets.policy, (config.num_envs,)), 0)
    env_state = reset_all(env, env_key, config.num_envs)
    actors = Actors(env_state=env_state, policy_carry=memory, value_carry=())
    finite = jnp.all(jnp.isfinite(env_state.obs), axis=0).astype(jnp.float32)
    return TrainState(
        learner=Learner(policy=init_fitted(params, config.ppo.max_grad_norm)),
        obs_stats=merge(init_stats((env.obs_size,)), env_state.obs.T, finite),
        actors=actors,
        key=key,
        iteration=jnp.zeros((), jnp.int32),
    )


def window_gradient(params, config: TrainConfig, env: Any, stats: RunningStats, actors: Actors):
    """Mean of dp + da (m + rad) over a window's valid steps, and its gradient by the policy.

    Observations count as given: the gradient runs from an error through the physics, the lag and
    the IK to the actions before it, and through the policy's memory to its weights, but not from an
    action through what is seen afterwards to later actions. With that loop in it the gradient grows
    with the policy's gain, to norms of 5 and more, and learning stalled near the baseline: E0,
    implicitfast, 580 updates at 5e-4, 1.37 mm of 1.5; without it 0.35 mm after 600 at 1e-3.

    Returns:
        (loss, gradient, (actors after the window, observations (T, N, F), metrics, leaves (T, N))).
    """
    nets = networks_of(config.ppo, env.action_size)
    steps, envs = config.first_order.horizon_steps, actors.env_state.obs.shape[-1]

    def simulate(nudges: jax.Array):
        """The window's loss with (T, N, A) added to the policy's actions."""

        def one_step(carry: Actors, nudge: jax.Array):
            obs = jax.lax.stop_gradient(carry.env_state.obs.T)
            seen = normalise_obs(stats, obs)
            memory, mean, _ = step(nets.policy, params, carry.policy_carry, seen)
            env_state = jax.checkpoint(step_all)(env, carry.env_state, mean + nudge)
            after = Actors(env_state=env_state, policy_carry=memory, value_carry=())
            return after, (obs, env_state.metrics)

        after, (obs, metrics) = jax.lax.scan(one_step, actors, nudges)
        error = metrics.pos_error_m + metrics.ang_error_rad
        # where, not a product: a NaN times zero is NaN.
        kept = jnp.where(metrics.valid, error, 0.0)
        loss = jnp.sum(kept) / jnp.maximum(jnp.sum(metrics.valid), 1)
        return loss, (after, obs, metrics)

    unmoved = jnp.zeros((steps, envs, env.action_size))
    gradient = jax.value_and_grad(simulate, has_aux=True)
    (loss, (after, obs, metrics)), by_action = gradient(unmoved)

    def actions(params):
        return unroll(nets.policy, params, actors.policy_carry, normalise_obs(stats, obs))[1]

    _, pull = jax.vjp(actions, params)
    return loss, pull(by_action)[0], (after, obs, metrics)


def train_iteration(
    config: TrainConfig, env: Any, state: TrainState
) -> tuple[TrainState, IterationMetrics]:
    """Reset one block of environments, then a gradient step for each window of the iteration."""
    settings = config.first_order
    env = training_env(env)
    key, reset_key = jax.random.split(state.key)
    actors = reset_block(
        env, state.actors, reset_key, state.iteration, config.reset_groups, config.shards
    )
    lr = learning_rate(config, settings.learning_rate, state.iteration)

    def one_window(carry, _):
        fitted, actors = carry
        _, grads, (after, obs, metrics) = window_gradient(
            fitted.params, config, env, state.obs_stats, actors
        )
        fitted, stats = gradient_step(fitted, grads, lr, config.ppo.max_grad_norm)
        return (fitted, after), (obs, metrics, stats)

    (fitted, actors), (obs, metrics, stats) = jax.lax.scan(
        one_window, (state.learner.policy, actors), None, settings.windows
    )
    valid = metrics.valid.astype(jnp.float32)
    new_state = TrainState(
        learner=Learner(policy=fitted),
        obs_stats=merge(state.obs_stats, obs, valid),
        actors=actors,
        key=key,
        iteration=state.iteration + 1,
    )
    return new_state, _metrics(metrics, valid, stats, lr)


def _metrics(metrics: Any, valid: jax.Array, stats: Any, lr: jax.Array) -> IterationMetrics:
    count = jnp.maximum(jnp.sum(valid), 1.0)

    def mean(x: jax.Array) -> jax.Array:
        return jnp.sum(jnp.where(metrics.valid, x, 0.0)) / count

    position, angle = mean(metrics.pos_error_m), mean(metrics.ang_error_rad)
    return IterationMetrics(
        pos_error_mm=1e3 * position,
        ang_error_mrad=1e3 * angle,
        reward=-(position + angle),
        invalid_share=1.0 - jnp.mean(valid),
        rejected_share=1.0 - jnp.mean(valid),
        policy_grad_norm=jnp.mean(stats.grad_norm),
        skipped_updates=jnp.sum(stats.skipped),
        lr=jnp.asarray(lr, jnp.float32),
    )


def init_seeds(config: TrainConfig, env: Any, keys: jax.Array) -> TrainState:
    """One state per key, on a new leading axis."""
    return jax.vmap(lambda key: init(config, env, key))(keys)


def train_iteration_seeds(
    config: TrainConfig, env: Any, states: TrainState
) -> tuple[TrainState, IterationMetrics]:
    """`train_iteration` of several seeds at once: states and metrics have a leading seed axis."""
    return jax.vmap(lambda state: train_iteration(config, env, state))(states)
