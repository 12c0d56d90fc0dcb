"""The action distribution, in one place, so that only the trainers load distrax."""

from typing import Any

import distrax
import jax
import jax.numpy as jnp


def action_distribution(mean: jax.Array, sigma: jax.Array) -> Any:
    """Independent normal actions: mean (..., A), sigma (A,) -> `distrax.Distribution` over (A,).

    (Typed Any: distrax has an array type of its own that no checker takes for JAX's.)
    """
    return distrax.MultivariateNormalDiag(mean, jnp.broadcast_to(sigma, mean.shape))
