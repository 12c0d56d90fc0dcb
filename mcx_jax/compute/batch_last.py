"""vmap without batching every operation.

Most of tracing is JAX rewriting thousands of scalar operations for a batch, one by one (with it and
as here: a reset 2.7 and 0.5 s, a control step 2.5 and 0.8 s). Functions made of elementwise
operations on leading components (`x[0] * y[1]`, `stack`) mean the same on arrays with a batch axis
behind: they can be called once, on the whole batch.

A primitive of its own and not `jax.custom_batching.custom_vmap`, which traces the function for one
element as well: every function here would be traced twice.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir


def batch_last(f: Callable[..., Any]) -> Callable[..., Any]:
    """f, which under vmap is called once, with the batch as the last axis of all its arguments.

    It can be differentiated outside the vmap only, not without one (the primitive has no derivative
    of its own).

    Args:
        f: elementwise, of pytrees of arrays; bool arguments that are not batched (walls) stay so.
    """

    def called(*args: Any) -> Any:
        leaves, structure = jax.tree.flatten(args)
        result: Any = None

        def flat(*leaves: Any) -> list[jax.Array]:
            nonlocal result
            out, result = jax.tree.flatten(f(*jax.tree.unflatten(structure, leaves)))
            return out

        out = _whole.bind(*leaves, f=flat)
        return jax.tree.unflatten(result, out)

    return called


_whole = Primitive("batch_last")
_whole.multiple_results = True


@_whole.def_impl
def _run(*args: Any, f: Callable[..., list[jax.Array]]) -> list[jax.Array]:
    return f(*args)


@_whole.def_abstract_eval
def _shapes(*args: Any, f: Callable[..., list[jax.Array]]) -> list[ShapedArray]:
    return [ShapedArray(x.shape, x.dtype) for x in jax.eval_shape(f, *args)]


def _rule(args: Sequence[Any], axes: Sequence[int | None], *, f: Callable[..., list[jax.Array]]):
    """vmap: (results, the axis of the batch in each)."""
    size = next(x.shape[a] for x, a in zip(args, axes, strict=True) if a is not None)

    def last(x: Any, axis: int | None) -> jax.Array:
        if axis is not None:
            return jnp.moveaxis(x, axis, -1)
        x = jnp.asarray(x)
        return x if x.dtype == bool else jnp.broadcast_to(x[..., None], (*x.shape, size))

    out = f(*map(last, args, axes))
    return out, [x.ndim - 1 for x in out]


mlir.register_lowering(_whole, mlir.lower_fun(_run, multiple_results=True))
batching.primitive_batchers[_whole] = _rule
