"""Losses of PPO, as means over the entries that count (`mask` 1; elsewhere nothing enters)."""

import jax
import jax.numpy as jnp
from flax import struct


def masked_mean(x: jax.Array, mask: jax.Array) -> jax.Array:
    """Mean of x where mask is 1; 0 if that is nowhere. x there may be anything, NaN too."""
    return jnp.sum(jnp.where(mask > 0, x, 0.0)) / jnp.maximum(jnp.sum(mask), 1.0)


def reported_mean(x: jax.Array, mask: jax.Array) -> jax.Array:
    """Like `masked_mean`, but NaN when the mask is empty; for reporting."""
    return jnp.where(jnp.any(mask > 0), masked_mean(x, mask), jnp.nan)


def standardise(x: jax.Array, mask: jax.Array) -> jax.Array:
    """Mean 0 and deviation 1 over the entries with mask 1; 0 elsewhere."""
    mean = masked_mean(x, mask)
    std = jnp.sqrt(masked_mean((x - mean) ** 2, mask))
    return jnp.where(mask > 0, (x - mean) / (std + 1e-8), 0.0)


@struct.dataclass
class SurrogateStats:
    """What the policy loss saw; all ().

    Attributes:
        kl: estimate of KL(old || new), nats.
        clip_share: share of entries whose ratio is outside 1 +- clip.
        ratio_deviation: largest |ratio - 1|.
        entropy: of the action distribution, nats.
    """

    kl: jax.Array
    clip_share: jax.Array
    ratio_deviation: jax.Array
    entropy: jax.Array


def clipped_surrogate(
    *,
    log_prob: jax.Array,
    old_log_prob: jax.Array,
    advantage: jax.Array,
    entropy: jax.Array,
    mask: jax.Array,
    clip: float,
    entropy_coef: float,
) -> tuple[jax.Array, SurrogateStats]:
    """PPO's policy loss (Schulman et al. 2017, eqs. 7 and 9); all arrays of one shape.

    The KL estimate is E[(r - 1) - log r] (Schulman 2020, "k3"): never negative and of low variance.
    """
    log_ratio = jnp.where(mask > 0, log_prob - old_log_prob, 0.0)
    ratio = jnp.exp(log_ratio)
    gain = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - clip, 1 + clip) * advantage)
    mean_entropy = masked_mean(entropy, mask)
    loss = -masked_mean(gain, mask) - entropy_coef * mean_entropy
    stats = SurrogateStats(
        kl=masked_mean(ratio - 1.0 - log_ratio, mask),
        clip_share=masked_mean((jnp.abs(ratio - 1.0) > clip).astype(jnp.float32), mask),
        ratio_deviation=jnp.max(jnp.abs(ratio - 1.0)),
        entropy=mean_entropy,
    )
    return loss, stats


def huber(error: jax.Array) -> jax.Array:
    """Huber's loss with threshold 1: quadratic within, linear beyond."""
    size = jnp.abs(error)
    return jnp.where(size <= 1.0, 0.5 * error**2, size - 0.5)


def value_loss(value: jax.Array, target: jax.Array, mask: jax.Array) -> jax.Array:
    """Mean Huber loss of normalised values against normalised targets."""
    return masked_mean(huber(value - target), mask)


def explained_variance(value: jax.Array, target: jax.Array, mask: jax.Array) -> jax.Array:
    """1 - Var(target - value) / Var(target): 1 = perfect, 0 = no better than a constant."""
    error = target - value
    variance = masked_mean((target - masked_mean(target, mask)) ** 2, mask)
    residual = masked_mean((error - masked_mean(error, mask)) ** 2, mask)
    return 1.0 - residual / jnp.maximum(variance, 1e-20)
