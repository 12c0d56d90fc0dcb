"""Running mean and standard deviation, for observations and for value targets."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from flax import struct

STD_FLOOR = 1e-5
"""Columns that hardly move (the cosines of a small tilt, say) are not blown up beyond 1e5 times:
float32 resolves 6e-8 near 1, so below this a column would be rounding noise and nothing else. As a
pose it is 10 micrometres or 10 microradians."""
CLIP = 10.0
"""Bound of a normalised observation: an arm thrown off course must not saturate the network for
everyone through its gradients."""


@struct.dataclass
class RunningStats:
    """Statistics of all samples seen so far.

    Attributes:
        count: number of samples, () float32 (its rounding, 1 in 1.7e7, is harmless).
        mean: (...) in the samples' unit.
        var: variance (not the sum of squares, which float32 would lose), (...).
    """

    count: jax.Array
    mean: jax.Array
    var: jax.Array

    @property
    def std(self) -> jax.Array:
        """Standard deviation, at least `STD_FLOOR`, (...)."""
        return jnp.maximum(jnp.sqrt(self.var), STD_FLOOR)


def init_stats(shape: tuple[int, ...]) -> RunningStats:
    """No samples yet: normalises by mean 0 and deviation 1."""
    return RunningStats(count=jnp.zeros(()), mean=jnp.zeros(shape), var=jnp.ones(shape))


def normalise(stats: RunningStats, x: jax.Array) -> jax.Array:
    """(x - mean) / std over the trailing axes."""
    return (x - stats.mean) / stats.std


def normalise_obs(stats: RunningStats, obs: jax.Array) -> jax.Array:
    """`normalise`, bounded by `CLIP`; what both networks read."""
    return jnp.clip(normalise(stats, obs), -CLIP, CLIP)


def denormalise(stats: RunningStats, y: jax.Array) -> jax.Array:
    """Inverse of `normalise`."""
    return y * stats.std + stats.mean


def merge(stats: RunningStats, x: jax.Array, mask: jax.Array, keep: float = 1.0) -> RunningStats:
    """Statistics with one batch more (Chan, Golub & LeVeque 1979, parallel form).

    Args:
        stats: over trailing axes of shape S.
        x: samples (*batch, *S); entries where mask is 0 may be anything, NaN too.
        mask: (*batch,), 1 for samples that count.
        keep: weight of all earlier samples; below 1 they are forgotten.
    """
    stats = replace(stats, count=keep * stats.count)
    axes = tuple(range(mask.ndim))
    weight = mask.reshape(mask.shape + (1,) * (x.ndim - mask.ndim))
    batch_count = jnp.sum(mask)
    share = weight / jnp.maximum(batch_count, 1.0)
    # Deviations from the old mean: a batch mean of raw values near 1 would keep fewer digits.
    deviation = jnp.where(weight > 0, x - stats.mean, 0.0)
    shift = jnp.sum(deviation * share, axes)
    batch_var = jnp.sum(share * (deviation - shift) ** 2, axes)
    total = jnp.maximum(stats.count + batch_count, 1.0)
    old, new = stats.count / total, batch_count / total
    var = old * stats.var + new * batch_var + old * new * shift**2
    empty = stats.count + batch_count == 0
    return RunningStats(
        count=stats.count + batch_count,
        mean=stats.mean + new * shift,
        var=jnp.where(empty, stats.var, var),
    )
