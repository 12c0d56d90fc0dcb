"""The compiled programs of a training run.

    reset(env, seeds, number) -> fresh      one block of environments at the start of an episode
    init(env, seeds, blocks) -> state       first weights, all environments in place
    iterate(env, state, fresh) -> (state, metrics)

Resetting is a program of its own because it is as much code as a control step: inside the other two
it was traced and compiled twice (the iteration took 42 s with it, 26 s without; resetting alone 14
s), and now compiles beside the iteration.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from types import ModuleType
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from mcx_jax.compute.sharding import env_mesh, put, shardings
from mcx_jax.config.training import TrainConfig
from mcx_jax.envs.v2v import V2VEnv
from mcx_jax.ppo.rollout import layout, reset_all

if TYPE_CHECKING:
    from mcx_jax.policy.file import Policy

RESET_STREAM = 1
"""Folded into a run's key for its resets; the rest of its random numbers come from another."""


def algorithm(config: TrainConfig) -> ModuleType:
    """The trainer module of the configuration's algorithm; both have the same functions."""
    from mcx_jax.first_order import trainer as first_order
    from mcx_jax.ppo import trainer as ppo

    return {"ppo": ppo, "first-order": first_order}[config.algo]


def reset(config: TrainConfig, env: Any, seed: jax.Array, number: jax.Array) -> Any:
    """The block of environments number `number` of a run, leaves (..., block_envs).

    Args:
        number: counts the blocks of a run, () int32: 0 to G - 1 fill the environments, block G + i
            is renewed before window i.
    """
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), RESET_STREAM), number)
    return reset_all(env, key, config.block_envs)


@dataclass(frozen=True)
class Training:
    """The programs of a run, compiled for a mesh; a seed axis in front where --seeds > 1.

    Attributes:
        config: of the run.
        env: the environment, on all devices.
        seeds: the seed, () int32, or all seeds, (seeds,).
        like: shapes and shardings of the state.
    """

    config: TrainConfig
    env: Any
    seeds: jax.Array
    like: Any
    _reset: Callable[..., Any]
    _init: Callable[..., Any]
    _iterate: Callable[..., Any]

    def start(self, policy: "Policy | None" = None) -> Any:
        """The state of a new run.

        Args:
            policy: begin with its weights and statistics, in every seed; None = with new ones.
        """
        blocks = [self._fresh(number) for number in range(self.config.reset_groups)]
        state = self._init(self.env, self.seeds, blocks)
        if policy is None:
            return state
        old = state.learner.policy.params, state.obs_stats
        params, stats = jax.tree.map(_like, (policy.params, policy.obs_stats), old)
        fitted = replace(state.learner.policy, params=params)
        return replace(state, learner=replace(state.learner, policy=fitted), obs_stats=stats)

    def iterate(self, state: Any, iteration: int) -> tuple[Any, Any]:
        """(state, metrics) after one more iteration; consumes the old state.

        Args:
            iteration: number of iterations done before.
        """
        return self._iterate(self.env, state, self._fresh(self.config.reset_groups + iteration))

    def _fresh(self, number: int) -> Any:
        return self._reset(self.env, self.seeds, jnp.int32(number))


def prepare(config: TrainConfig, env: Any, mesh: Mesh | None = None) -> Training:
    """Compile the programs of a run.

    Args:
        env: on any device.
        mesh: None = as many devices, of all processes, as the configuration can use.
    """
    mesh = env_mesh(config.shards, jax.devices()) if mesh is None else mesh
    algo = algorithm(config)
    if isinstance(env, V2VEnv):
        env = replace(env, whole_batches=True)
    env = put(mesh, env)
    resets, inits = partial(reset, config), partial(algo.init, config)
    iterates = partial(algo.iterate, config)
    seeds = jnp.int32(config.seed)
    if config.seeds > 1:
        seeds += jnp.arange(config.seeds, dtype=jnp.int32)
        resets = jax.vmap(resets, in_axes=(None, 0, None))
        inits = jax.vmap(inits, in_axes=(None, 0, 0))
        iterates = jax.vmap(iterates, in_axes=(None, 0, 0))
    seeds, number = put(mesh, (seeds, jnp.int32(0)))
    with jax.set_mesh(mesh), ThreadPoolExecutor(2) as beside:
        lowered = jax.jit(resets).lower(env, seeds, number)
        resetting = beside.submit(lowered.compile)
        fresh = _with_sharding(lowered.out_info, shardings(mesh, lowered.out_info, -1))
        blocks = [fresh] * config.reset_groups
        state = jax.eval_shape(inits, env, seeds, blocks)
        like = _with_sharding(state, layout(mesh, state))
        placed = jax.tree.map(lambda x: x.sharding, like)
        lowered = jax.jit(inits, out_shardings=placed).lower(env, seeds, blocks)
        starting = beside.submit(lowered.compile)
        jitted = jax.jit(iterates, donate_argnums=1, out_shardings=(placed, None))
        iterating = jitted.lower(env, like, fresh).compile()
        return Training(config, env, seeds, like, resetting.result(), starting.result(), iterating)


def _like(new: Any, old: jax.Array) -> jax.Array:
    """`new`, once for each seed, placed as `old` is."""
    return jax.device_put(jnp.broadcast_to(jnp.asarray(new, old.dtype), old.shape), old.sharding)


def _with_sharding(tree: Any, placed: Any) -> Any:
    """Shapes with the shardings of `placed`."""
    return jax.tree.map(
        lambda x, s: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=s), tree, placed
    )
