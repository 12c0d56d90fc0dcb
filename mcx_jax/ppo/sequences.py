"""Cutting a window of many environments into sequences for back-propagation through time."""

from typing import TypeVar

import jax
import jax.numpy as jnp

Tree = TypeVar("Tree")


def to_sequences(tree: Tree, sequence_steps: int) -> Tree:
    """Cut the time axis into chunks and put them side by side.

    Args:
        tree: leaves (time T, env N, ...).
        sequence_steps: L, divides T.

    Returns:
        Leaves (step L, sequence K * N, ...), K = T / L. Sequence k * N + n holds the steps
        k * L .. k * L + L - 1 of environment n, in order.
    """

    def cut(x: jax.Array) -> jax.Array:
        time, envs, *rest = x.shape
        chunks = x.reshape(time // sequence_steps, sequence_steps, envs, *rest)
        return jnp.swapaxes(chunks, 0, 1).reshape(sequence_steps, -1, *rest)

    return jax.tree.map(cut, tree)


def flatten_starts(tree: Tree) -> Tree:
    """Carries at the chunks' starts: (chunk K, env N, ...) -> (sequence K * N, ...), same order."""
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), tree)


def minibatch_order(key: jax.Array, sequences: int, epochs: int, minibatches: int) -> jax.Array:
    """Random order of the sequences in every epoch, cut into equal minibatches.

    Returns:
        Sequence numbers, (epochs * minibatches, sequences / minibatches) int32.
    """
    keys = jax.random.split(key, epochs)
    order = jax.vmap(lambda k: jax.random.permutation(k, sequences))(keys)
    return order.reshape(epochs * minibatches, sequences // minibatches)
