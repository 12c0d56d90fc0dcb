"""Cutting a window of many environments into sequences for back-propagation through time."""

from typing import TypeVar

import jax
import jax.numpy as jnp

from mcx_jax.compute.sharding import over_envs

Tree = TypeVar("Tree")


def to_sequences(tree: Tree, sequence_steps: int) -> Tree:
    """Cut the time axis into chunks and put them side by side, those of an environment together.

    Args:
        tree: leaves (time T, env N, ...).
        sequence_steps: L, divides T.

    Returns:
        Leaves (step L, sequence N * K, ...), K = T / L. Sequence n * K + k holds the steps
        k * L .. k * L + L - 1 of environment n, in order.
    """

    def cut(x: jax.Array) -> jax.Array:
        time, envs, *rest = x.shape
        chunks = x.reshape(time // sequence_steps, sequence_steps, envs, *rest)
        return jnp.moveaxis(chunks, 0, 2).reshape(sequence_steps, -1, *rest)

    return jax.tree.map(cut, tree)


def flatten_starts(tree: Tree) -> Tree:
    """Carries at the chunks' starts: (chunk K, env N, ...) -> (sequence N * K, ...), same order."""
    return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1).reshape(-1, *x.shape[2:]), tree)


def minibatch_order(
    key: jax.Array, sequences: int, epochs: int, minibatches: int, shards: int
) -> jax.Array:
    """Random order of the sequences in every epoch, cut into equal minibatches. Every minibatch has
    equally many of every shard, so that none moves to another device.

    Args:
        sequences: in all shards together.

    Returns:
        Numbers within the shard, (epochs * minibatches, shards, sequences / shards / minibatches)
        int32.
    """
    keys = jax.random.split(key, (epochs, shards))
    mine = sequences // shards
    order = jax.vmap(jax.vmap(lambda k: jax.random.permutation(k, mine)))(keys)
    order = order.reshape(epochs, shards, minibatches, mine // minibatches)
    return jnp.swapaxes(order, 1, 2).reshape(epochs * minibatches, shards, -1)


def take(tree: Tree, chosen: jax.Array, axis: int) -> Tree:
    """The sequences of a minibatch.

    Args:
        tree: leaves with all sequences on `axis`, the shards one after the other.
        chosen: numbers within the shard, (S, m).

    Returns:
        Leaves with S * m sequences on `axis`.
    """
    shards = chosen.shape[0]

    def one(x: jax.Array) -> jax.Array:
        before, after = x.shape[:axis], x.shape[axis + 1 :]
        parts = over_envs(x.reshape(*before, shards, -1, *after), axis)
        pick = jax.vmap(lambda part, i: jnp.take(part, i, axis), (axis, 0), axis)
        return over_envs(pick(parts, chosen).reshape(*before, -1, *after), axis)

    return jax.tree.map(one, tree)
