"""vmap without batching every operation.

Most of tracing is JAX rewriting thousands of scalar operations for a batch, one by one (CPU time
with it and as here: a reset 4.0 and 2.1 s, a training iteration 4.3 and 3.0 s). Functions made of
elementwise operations on leading components (`x[0] * y[1]`, `stack`) mean the same on arrays with a
batch axis behind: they can be called once, on the whole batch.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap


def batch_last(f: Callable[..., Any]) -> Callable[..., Any]:
    """f, which under vmap is called once, with the batch as the last axis of all its arguments.

    It can be differentiated outside the vmap only, not without one (`custom_vmap` has no reverse
    mode of its own).

    Args:
        f: elementwise, of pytrees of arrays; bool arguments that are not batched (walls) stay so.
    """
    called = custom_vmap(f)

    @called.def_vmap
    def rule(size: int, batched: Any, *args: Any) -> tuple[Any, Any]:
        def last(x: jax.Array, is_batched: bool) -> jax.Array:
            if is_batched:
                return jnp.moveaxis(x, 0, -1)
            x = jnp.asarray(x)
            return x if x.dtype == bool else jnp.broadcast_to(x[..., None], (*x.shape, size))

        out = f(*jax.tree.map(last, args, tuple(batched)))
        first = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), out)
        return first, jax.tree.map(lambda _: True, first)

    return called
