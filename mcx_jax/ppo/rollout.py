"""Collecting experience. The one `vmap` over environments is here, with the batch axis LAST.

Physics is fast on (joint, environment) rows, networks on (environment, feature) rows; observations
and actions are transposed where the two meet. Environment states and the networks' memories live
on from window to window.

Resets are staggered. An episode has E steps, a window T, so G = E / T windows make an episode and
the environments form G blocks. At the START of window i the block i mod G is replaced by fresh
environments (made by a program of their own, see `programs`) and nothing is reset inside a window:
no step pays for a reset, no `cond` runs two branches under `vmap`, and all phases of an episode are
in every window. A window's end is a truncation, not an end: the value of the last observation
follows. Where G does not divide N, or N < G, neighbouring blocks share an environment, which is
then reset earlier than need be: a shorter episode, otherwise harmless. Each of S shards
(`sharding`) has G blocks of its own, so that resetting moves nothing between devices. Where a
number is not finite, the environment is replaced too (`replace_broken`).
"""

import functools
import itertools
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax.sharding import Mesh

from mcx_jax.compute.sharding import over_envs, shardings
from mcx_jax.policy.gaussian import action_distribution
from mcx_jax.policy.networks import Carry, Networks, Params, init_carry, step
from mcx_jax.policy.normalise import RunningStats, normalise_obs


@struct.dataclass
class Actors:
    """Everything of the environments that lives on from one window to the next.

    Attributes:
        env_state: states of N environments, leaves (..., N).
        policy_carry: the policy's memory, leaves (N, H).
        value_carry: the value network's memory, leaves (N, H).
    """

    env_state: Any
    policy_carry: Carry
    value_carry: Carry


@struct.dataclass
class Transition:
    """One control step of every environment; stacked, time comes first.

    Attributes:
        obs: what the policy saw, not normalised, (N, F).
        action: sampled, centimetres and centiradians, (N, A).
        log_prob: of the action, (N,).
        reward: of the step, (N,).
        metrics: the environment's own after the step, leaves (N,).
    """

    obs: jax.Array
    action: jax.Array
    log_prob: jax.Array
    reward: jax.Array
    metrics: Any


@struct.dataclass
class Window:
    """T steps of N environments.

    Attributes:
        steps: leaves (T, N, ...).
        policy_carry: the policy's memory BEFORE the first step of each of the T / L sequences,
            leaves (T / L, N, H).
        last_obs: after the last step, not normalised, (N, F).
    """

    steps: Transition
    policy_carry: Carry
    last_obs: jax.Array


def layout(mesh: Mesh, state: Any) -> Any:
    """Shardings of a trainer's state (a seed axis in front or not): environments and memories over
    the devices, everything else on each."""
    actors = state.actors
    placed = Actors(
        env_state=shardings(mesh, actors.env_state, -1),
        policy_carry=shardings(mesh, actors.policy_carry, -2),
        value_carry=shardings(mesh, actors.value_carry, -2),
    )
    return replace(shardings(mesh, state), actors=placed)


def reset_all(env: Any, key: jax.Array, num_envs: int) -> Any:
    """States of `num_envs` environments at the start of an episode, leaves (..., N)."""
    keys = over_envs(jax.random.split(key, num_envs), 0)
    return over_envs(jax.vmap(env.reset, out_axes=-1)(keys), -1)


def step_all(env: Any, env_state: Any, action: jax.Array) -> Any:
    """One control step of all: leaves (..., N), action (N, A)."""
    return jax.vmap(env.step, in_axes=(-1, -1), out_axes=-1)(env_state, action.T)


def init_actors(nets: Networks, blocks: list[Any], num_envs: int, shards: int) -> Actors:
    """N environments from G blocks of fresh ones; all memories empty.

    Args:
        blocks: G times leaves (..., S * n), in the order of `insert_block`.
        num_envs: N.
    """
    bounds = [i * (num_envs // shards) // len(blocks) for i in range(len(blocks) + 1)]
    widths = [end - start for start, end in itertools.pairwise(bounds)]
    size = blocks[0].obs.shape[-1] // shards

    def join(*leaves: jax.Array) -> jax.Array:
        parts = [
            over_envs(x.reshape(*x.shape[:-1], shards, size)[..., :width], -2)
            for x, width in zip(leaves, widths, strict=True)
        ]
        return over_envs(jnp.concatenate(parts, -1).reshape(*leaves[0].shape[:-1], num_envs), -1)

    return Actors(
        env_state=jax.tree.map(join, *blocks),
        policy_carry=over_envs(init_carry(nets.policy, (num_envs,)), 0),
        value_carry=over_envs(init_carry(nets.value, (num_envs,)), 0),
    )


def insert_block(
    actors: Actors, fresh: Any, iteration: jax.Array, groups: int, shards: int
) -> Actors:
    """Put fresh environments in the place of one of `groups` blocks in each shard, and empty the
    memories there.

    Args:
        actors: of N environments.
        fresh: environments just reset, leaves (..., S * n).
        iteration: number of the window, (); block iteration mod groups is replaced.
        groups: G, windows in an episode.
        shards: S, divides N.
    """
    envs = actors.env_state.obs.shape[-1] // shards
    size = fresh.obs.shape[-1] // shards
    start = (iteration % groups) * envs // groups

    def last(old: jax.Array, new: jax.Array) -> jax.Array:
        parts = over_envs(old.reshape(*old.shape[:-1], shards, envs), -2)
        new = over_envs(new.reshape(*new.shape[:-1], shards, size), -2)
        parts = jax.lax.dynamic_update_slice_in_dim(parts, new, start, axis=parts.ndim - 1)
        return over_envs(parts.reshape(old.shape), -1)

    def empty(old: jax.Array) -> jax.Array:
        parts = over_envs(old.reshape(shards, envs, *old.shape[1:]), 0)
        zeros = jnp.zeros((shards, size, *old.shape[1:]), old.dtype)
        parts = jax.lax.dynamic_update_slice_in_dim(parts, zeros, start, axis=1)
        return over_envs(parts.reshape(old.shape), 0)

    return Actors(
        env_state=jax.tree.map(last, actors.env_state, fresh),
        policy_carry=jax.tree.map(empty, actors.policy_carry),
        value_carry=jax.tree.map(empty, actors.value_carry),
    )


def replace_broken(actors: Actors, fresh: Any, shards: int) -> tuple[Actors, jax.Array]:
    """Put fresh environments in the place of those that hold a number that is not finite, in their
    state or in a memory.

    Several of a shard may get the same fresh environment: they draw other actions.

    Args:
        actors: of N environments.
        fresh: environments just reset, leaves (..., S * n); number i mod n of its shard goes where
            environment i of the shard broke.
        shards: S, divides N.

    Returns:
        Actors, and how many were replaced, () float32.
    """
    num_envs, size = actors.env_state.obs.shape[-1], fresh.obs.shape[-1] // shards
    source = jnp.arange(num_envs // shards) % size
    memories = actors.policy_carry, actors.value_carry
    broken = ~(_finite(actors.env_state, -1) & _finite(memories, 0))

    def renew(old: jax.Array, new: jax.Array) -> jax.Array:
        parts = over_envs(new.reshape(*new.shape[:-1], shards, size), -2)[..., source]
        return over_envs(jnp.where(broken, parts.reshape(old.shape), old), -1)

    def empty(old: jax.Array) -> jax.Array:
        return over_envs(jnp.where(broken[:, None], 0.0, old), 0)

    renewed = Actors(
        env_state=jax.tree.map(renew, actors.env_state, fresh),
        policy_carry=jax.tree.map(empty, actors.policy_carry),
        value_carry=jax.tree.map(empty, actors.value_carry),
    )
    return renewed, jnp.sum(broken, dtype=jnp.float32)


def _finite(tree: Any, axis: int) -> jax.Array:
    """Whether all numbers along the other axes are finite, (N,)."""

    def one(x: jax.Array) -> jax.Array:
        return jnp.all(jnp.isfinite(x), [i for i in range(x.ndim) if i != axis % x.ndim])

    floats = [x for x in jax.tree.leaves(tree) if jnp.issubdtype(x.dtype, jnp.floating)]
    return functools.reduce(jnp.logical_and, map(one, floats))


def act(
    nets: Networks, params: Params, stats: RunningStats, actors: Actors, key: jax.Array
) -> tuple[Carry, Transition]:
    """Sample one action for every environment; reward and metrics are still those before it."""
    obs = actors.env_state.obs.T
    carry, mean, sigma = step(nets.policy, params, actors.policy_carry, normalise_obs(stats, obs))
    action, log_prob = action_distribution(mean, sigma).sample_and_log_prob(seed=key)
    before = actors.env_state
    return carry, Transition(obs, action, log_prob, before.reward, before.metrics)


def collect(
    env: Any,
    nets: Networks,
    params: Params,
    stats: RunningStats,
    actors: Actors,
    keys: jax.Array,
) -> tuple[Actors, Window]:
    """Run the policy for K x L steps.

    Args:
        params: the policy's weights.
        stats: of the observations; frozen meanwhile.
        keys: one for each step, (K, L): K sequences of L steps.

    Returns:
        The actors after the window (the value network's memory untouched), and the window.
    """

    def one_step(actors: Actors, key: jax.Array) -> tuple[Actors, Transition]:
        carry, transition = act(nets, params, stats, actors, key)
        env_state = step_all(env, actors.env_state, transition.action)
        transition = replace(transition, reward=env_state.reward, metrics=env_state.metrics)
        return replace(actors, env_state=env_state, policy_carry=carry), transition

    def one_sequence(actors: Actors, keys: jax.Array):
        first = actors.policy_carry
        actors, transitions = jax.lax.scan(one_step, actors, keys)
        return actors, (first, transitions)

    actors, (carries, steps) = jax.lax.scan(one_sequence, actors, keys)
    steps = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), steps)
    return actors, Window(steps=steps, policy_carry=carries, last_obs=actors.env_state.obs.T)
