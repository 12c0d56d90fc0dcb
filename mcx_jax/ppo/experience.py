"""Turn a rollout window into training sequences: mask, values, advantages."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

from mcx_jax.config.training import PPOConfig
from mcx_jax.policy.networks import Carry, Networks, Params, step, unroll
from mcx_jax.policy.normalise import RunningStats, denormalise, normalise, normalise_obs
from mcx_jax.ppo.gae import discounted_returns, gae
from mcx_jax.ppo.loss import explained_variance, standardise
from mcx_jax.ppo.rollout import Window
from mcx_jax.ppo.sequences import flatten_starts, to_sequences


@struct.dataclass
class Batch:
    """Sequences to learn from: L steps of S sequences.

    Attributes:
        obs: normalised, (L, S, F).
        action: (L, S, A).
        log_prob: of the action when it was taken, (L, S).
        advantage: standardised over the whole batch, (L, S).
        target: of the value network, normalised, (L, S).
        mask: 1 = learn from it, (L, S).
        policy_carry: the policy's memory before each sequence, leaves (S, H).
        value_carry: the value network's, leaves (S, H).
    """

    obs: jax.Array
    action: jax.Array
    log_prob: jax.Array
    advantage: jax.Array
    target: jax.Array
    mask: jax.Array
    policy_carry: Carry
    value_carry: Carry


@struct.dataclass
class Judged:
    """A window with values, advantages and targets.

    Attributes:
        batch: what the updates read.
        value_carry: the value network's memory after the window, leaves (N, H).
        targets: value targets, not normalised, (T, N).
        mask: 1 for windows learned from, (N,).
        explained_variance: of the targets by the values before learning, ().
    """

    batch: Batch
    value_carry: Carry
    targets: jax.Array
    mask: jax.Array
    explained_variance: jax.Array


def accepted(window: Window, limit: float) -> jax.Array:
    """1 for the windows to learn from, (N,).

    The authors reject and redraw an episode in which the IK failed or whose mean squared reward
    exceeds a limit; here it is left out by a mask. Anything not finite counts as failed.
    """
    steps = window.steps
    reward_ok = jnp.mean(steps.reward**2, axis=0) <= limit  # False for NaN
    obs_ok = jnp.all(jnp.isfinite(steps.obs), axis=(0, 2)) & jnp.all(
        jnp.isfinite(window.last_obs), axis=1
    )
    valid = jnp.all(steps.metrics.valid, axis=0)
    return (reward_ok & obs_ok & valid).astype(jnp.float32)


def judge(
    config: PPOConfig,
    nets: Networks,
    value_params: Params,
    value_carry: Carry,
    obs_stats: RunningStats,
    value_stats: RunningStats,
    window: Window,
) -> Judged:
    """Values by one pass of the value network over the window, then advantages and sequences.

    Args:
        value_carry: the value network's memory before the window, leaves (N, H).
        obs_stats, value_stats: the statistics that the rollout used.
    """
    mask = accepted(window, config.reject_mean_sq_reward)
    window = _blank(window, mask)
    obs = normalise_obs(obs_stats, window.steps.obs)
    normalised, carries, end_carry = _values(nets, value_params, value_carry, obs, config)
    _, last = step(nets.value, value_params, end_carry, normalise_obs(obs_stats, window.last_obs))
    values, last_value = denormalise(value_stats, normalised), denormalise(value_stats, last)
    advantages, targets = _advantages(config, window.steps.reward, values, last_value)
    every_step = jnp.broadcast_to(mask, values.shape)
    per_step = Batch(
        obs=obs,
        action=window.steps.action,
        log_prob=window.steps.log_prob,
        advantage=standardise(advantages, every_step),
        target=normalise(value_stats, targets),
        mask=every_step,
        policy_carry=None,
        value_carry=None,
    )
    batch = replace(
        to_sequences(per_step, config.sequence_steps),
        policy_carry=flatten_starts(window.policy_carry),
        value_carry=flatten_starts(carries),
    )
    return Judged(
        batch=batch,
        value_carry=end_carry,
        targets=targets,
        mask=mask,
        explained_variance=explained_variance(values, targets, every_step),
    )


def _blank(window: Window, mask: jax.Array) -> Window:
    """Zeros for the windows left out: a NaN in them would survive a multiplication by 0."""

    def zero(axis: int, x: jax.Array) -> jax.Array:
        shape = [1] * x.ndim
        shape[axis] = -1
        return jnp.where(mask.reshape(shape) > 0, x, jnp.zeros((), x.dtype))

    return Window(
        steps=jax.tree.map(lambda x: zero(1, x), window.steps),
        policy_carry=jax.tree.map(lambda x: zero(1, x), window.policy_carry),
        last_obs=zero(0, window.last_obs),
    )


def _values(nets: Networks, params: Params, carry: Carry, obs: jax.Array, config: PPOConfig):
    """Normalised values (T, N), memories before each sequence (T / L, N, H), memory at the end."""
    chunks = obs.reshape(-1, config.sequence_steps, *obs.shape[1:])

    def one_sequence(carry: Carry, chunk: jax.Array):
        after, values = unroll(nets.value, params, carry, chunk)
        return after, (carry, values)

    end, (carries, values) = jax.lax.scan(one_sequence, carry, chunks)
    return values.reshape(obs.shape[:2]), carries, end


def _advantages(
    config: PPOConfig, rewards: jax.Array, values: jax.Array, last_value: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Advantages and value targets, (T, N). Nothing here ends for good, so no discount is 0."""
    discounts = jnp.full_like(rewards, config.gamma)
    advantages, targets = gae(
        rewards=rewards,
        values=values,
        last_value=last_value,
        discounts=discounts,
        lam=config.gae_lambda,
    )
    if config.value_target == "discounted":
        targets = discounted_returns(rewards=rewards, last_value=last_value, discounts=discounts)
    return advantages, targets
