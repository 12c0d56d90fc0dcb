"""The action distribution, in one place, so that only the trainers load distrax."""

import distrax
import jax
import jax.numpy as jnp


def action_distribution(mean: jax.Array, sigma: jax.Array) -> distrax.MultivariateNormalDiag:
    """Independent normal actions: mean (..., A), sigma (A,) -> distribution over (A,)."""
    return distrax.MultivariateNormalDiag(mean, jnp.broadcast_to(sigma, mean.shape))
