"""Gradient steps on both networks: epochs over minibatches of whole sequences, in one scan.

Every update may take one policy step and takes one value step. Policy steps end for the iteration
when the KL estimate exceeds 1.5 times its target (Spinning Up's rule, which the authors' settings
come from): the step that sees it is not taken, and the rest are not computed (under a `vmap` over
seeds the `cond` becomes a `select`: computed and thrown away). Both presets use this one mechanism.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import optax
from flax import struct

from mcx_jax.config.training import PPOConfig
from mcx_jax.policy.gaussian import action_distribution
from mcx_jax.policy.networks import Networks, Params, unroll
from mcx_jax.ppo.experience import Batch
from mcx_jax.ppo.loss import SurrogateStats, clipped_surrogate, value_loss
from mcx_jax.ppo.sequences import minibatch_order, take

KL_STOP_FACTOR = 1.5


@struct.dataclass
class Fitted:
    """One network's weights and its optimiser's state.

    Attributes:
        params: weights.
        opt_state: Adam's moments.
    """

    params: Params
    opt_state: optax.OptState


@struct.dataclass
class Learner:
    """Both networks."""

    policy: Fitted
    value: Fitted


@struct.dataclass
class StepStats:
    """One gradient step; all ().

    Attributes:
        grad_norm: global norm before clipping.
        skipped: 1 if the gradient was not finite and the step was left out.
    """

    grad_norm: jax.Array
    skipped: jax.Array


@struct.dataclass
class UpdateStats:
    """One update; stacked over an iteration, (U,) each.

    Attributes:
        computed: 1 if the policy's loss was computed (0 after the KL stop).
        stepped: 1 if the policy made a step.
        surrogate: what the policy loss saw (0 where not computed).
        policy_step: the policy's gradient step (0 where none).
        value_loss: mean Huber loss before the step.
        value_step: the value network's gradient step.
    """

    computed: jax.Array
    stepped: jax.Array
    surrogate: SurrogateStats
    policy_step: StepStats
    value_loss: jax.Array
    value_step: StepStats


def make_optimiser(max_grad_norm: float) -> optax.GradientTransformation:
    """Adam's direction for step size 1, with the gradient's global norm clipped before (0: not)."""
    clip = optax.clip_by_global_norm(max_grad_norm) if max_grad_norm > 0 else optax.identity()
    return optax.chain(clip, optax.scale_by_adam())


def init_fitted(params: Params, max_grad_norm: float) -> Fitted:
    """Weights with an optimiser that has seen nothing."""
    return Fitted(params=params, opt_state=make_optimiser(max_grad_norm).init(params))


def gradient_step(
    fitted: Fitted, grads: Params, lr: jax.Array, max_grad_norm: float
) -> tuple[Fitted, StepStats]:
    """One Adam step, left out if any gradient is not finite."""
    norm = optax.tree.norm(grads)
    finite = jnp.isfinite(norm)
    direction, opt_state = make_optimiser(max_grad_norm).update(grads, fitted.opt_state)
    params = jax.tree.map(lambda p, d: p - lr * d, fitted.params, direction)
    new = Fitted(params=params, opt_state=opt_state)
    kept = jax.tree.map(lambda a, b: jnp.where(finite, a, b), new, fitted)
    return kept, StepStats(grad_norm=norm, skipped=1.0 - finite)


def policy_loss(
    params: Params, config: PPOConfig, nets: Networks, batch: Batch
) -> tuple[jax.Array, SurrogateStats]:
    """The clipped surrogate of a batch of sequences."""
    _, mean, sigma = unroll(nets.policy, params, batch.policy_carry, batch.obs)
    distribution = action_distribution(mean, sigma)
    return clipped_surrogate(
        log_prob=distribution.log_prob(batch.action),
        old_log_prob=batch.log_prob,
        advantage=batch.advantage,
        entropy=distribution.entropy(),
        mask=batch.mask,
        clip=config.clip,
        entropy_coef=config.entropy_coef,
    )


def critic_loss(params: Params, nets: Networks, batch: Batch) -> jax.Array:
    """The value network's Huber loss of a batch of sequences."""
    _, value = unroll(nets.value, params, batch.value_carry, batch.obs)
    return value_loss(value, batch.target, batch.mask)


def policy_update(
    config: PPOConfig, nets: Networks, lr: jax.Array, fitted: Fitted, batch: Batch
) -> tuple[Fitted, UpdateStats]:
    """A policy step, not taken if the KL estimate is beyond its limit (then `stepped` = 0)."""
    gradient = jax.grad(policy_loss, has_aux=True)
    grads, surrogate = gradient(fitted.params, config, nets, batch)
    new, step = gradient_step(fitted, grads, lr, config.max_grad_norm)
    go_on = surrogate.kl <= KL_STOP_FACTOR * config.target_kl
    kept = jax.tree.map(lambda a, b: jnp.where(go_on, a, b), new, fitted)
    zero = jnp.zeros(())
    return kept, UpdateStats(
        computed=jnp.ones(()),
        stepped=go_on.astype(jnp.float32),
        surrogate=surrogate,
        policy_step=step,
        value_loss=zero,
        value_step=StepStats(zero, zero),
    )


def no_policy_update(fitted: Fitted) -> tuple[Fitted, UpdateStats]:
    """The same after the KL stop: nothing is computed."""
    zero = jnp.zeros(())
    surrogate = SurrogateStats(zero, zero, zero, zero)
    step = StepStats(zero, zero)
    return fitted, UpdateStats(zero, zero, surrogate, step, zero, step)


def update(
    config: PPOConfig,
    nets: Networks,
    rates: tuple[jax.Array, jax.Array],
    learner: Learner,
    stopped: jax.Array,
    batch: Batch,
) -> tuple[Learner, UpdateStats]:
    """One minibatch: a policy step unless `stopped`, and a value step.

    Args:
        rates: step sizes of policy and value network, ().
        stopped: () bool.
    """
    policy, stats = jax.lax.cond(
        stopped,
        lambda fitted, _: no_policy_update(fitted),
        lambda fitted, batch: policy_update(config, nets, rates[0], fitted, batch),
        learner.policy,
        batch,
    )
    loss, grads = jax.value_and_grad(critic_loss)(learner.value.params, nets, batch)
    value, step = gradient_step(learner.value, grads, rates[1], config.max_grad_norm)
    return Learner(policy, value), replace(stats, value_loss=loss, value_step=step)


def learn(
    config: PPOConfig,
    nets: Networks,
    rates: tuple[jax.Array, jax.Array],
    learner: Learner,
    batch: Batch,
    key: jax.Array,
    shards: int,
) -> tuple[Learner, UpdateStats]:
    """All updates of an iteration; the statistics are stacked, (epochs * minibatches,)."""
    sequences = batch.mask.shape[1]
    order = minibatch_order(key, sequences, config.epochs, config.minibatches, shards)

    def body(carry: tuple[Learner, jax.Array], chosen: jax.Array):
        learner, stopped = carry
        learner, stats = update(config, nets, rates, learner, stopped, _minibatch(batch, chosen))
        return (learner, stats.stepped == 0), stats

    (learner, _), stats = jax.lax.scan(body, (learner, jnp.zeros((), bool)), order)
    return learner, stats


def _minibatch(batch: Batch, chosen: jax.Array) -> Batch:
    """The sequences `chosen` of a batch, see `sequences.take`."""
    per_step = replace(batch, policy_carry=None, value_carry=None)
    policy_carry, value_carry = take((batch.policy_carry, batch.value_carry), chosen, 0)
    return replace(take(per_step, chosen, 1), policy_carry=policy_carry, value_carry=value_carry)
