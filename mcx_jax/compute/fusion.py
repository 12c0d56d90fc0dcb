"""Walls between stages of scalar code, so that XLA computes every stage once.

XLA on CPU has no multi-output fusion: each of the ~20 results of a stage becomes a fusion of its
own that recomputes everything it needs, through all stages before it. Measured on the arm's physics
step (2048 environments): 7,632 flops without walls, 2,840 with five; 4.6 M against 8.3 M steps/s.
`lax.optimization_barrier` does not help: XLA's CPU pipeline removes it before fusion.

Walls belong around everything that several results share: a control step of the environment took
3.4 us when the arm's stages, the IK's Jacobian and the look-up of the sea had none, 1.3 us with
them (2048 environments, two devices).

XLA also splits every fusion over all threads of a device and waits for them after each, which loses
more than it wins: hence one device per core (mcx_jax.compute.sharding).
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax


def stage(wall: jax.Array | None, f: Callable[..., Any], *args: Any) -> Any:
    """f(*args) as a computation of its own.

    It is the branch of a conditional whose predicate is true but known at run time only: a wall
    that the compiler cannot remove. The cost is one call, 0.1 us, for all environments together.
    Python floats, in the arguments and in the result, are constants of the model and stay so.

    Args:
        wall: () bool, true, UNBATCHED (a leaf of the environment, not of its state), or None for no
            wall (then XLA fuses freely: right on a GPU).
        f: pure.
        args: pytrees of JAX scalars and Python floats.
    """
    if wall is None:
        return f(*args)
    given, join_args = split_floats(args)
    join_result: Any = None
    shapes: list[Any] = []

    def taken(given):
        nonlocal join_result
        traced, join_result = split_floats(f(*join_args(given)))
        shapes[:] = [(jnp.shape(x), jnp.result_type(x)) for x in traced]
        return traced

    def never(_):
        return [jnp.zeros(shape, dtype) for shape, dtype in shapes]

    traced = lax.cond(wall, taken, never, given)
    return join_result(traced)


def split_floats(tree: Any) -> tuple[list[Any], Callable[[Sequence[Any]], Any]]:
    """(leaves that are not Python floats, function that puts such leaves back in their places)."""
    leaves, structure = jax.tree.flatten(tree)
    constant = [isinstance(x, float) for x in leaves]

    def join(traced: Sequence[Any]) -> Any:
        rest = iter(traced)
        filled = [x if c else next(rest) for x, c in zip(leaves, constant, strict=True)]
        return jax.tree.unflatten(structure, filled)

    return [x for x, c in zip(leaves, constant, strict=True) if not c], join


def opaque_true(x: jax.Array) -> jax.Array:
    """() bool: true, but the compiler cannot see it; for a wall where no environment is at hand.

    Args:
        x: any float32 array; its value does not matter.
    """
    bits = lax.bitcast_convert_type(x.reshape(-1)[0], jnp.int32)
    return (bits | 1) != 0
