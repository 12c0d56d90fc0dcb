"""The task for learners that are not written in JAX, as Gymnasium environments.

    import gymnasium
    import mcx_jax.gym  # registers the name

    one = gymnasium.make("mcx_jax/V2V-v0", delay="E2", sea="Wd")
    many = gymnasium.make_vec("mcx_jax/V2V-v0", num_envs=512, delay="E2")

Settings are those of `EnvConfig` and `MotionConfig` by name; `test=True` takes the motion that
training never sees. Observation: (38,) float32, `envs.observe.OBS_TABLE`, m and rad. Action: (6,)
float32, the goal moved in its own axes, 3 cm and 3 crad (rotation vector), within `max_correction`,
which also the task applies. Reward: -(dp + da) in m and rad. `info`: `dp_mm`, `da_mrad`, `valid`.

An episode is never terminated, only truncated, by the time limit or as soon as it is invalid (the
IK failed, the tool is half a metre off, the arm diverged). All rewards are negative: a terminated
failure would be worth more than tracking on. A state that is not finite is never shown: observation
and reward are then those of the step before.

Episode n of seed s begins with the key `fold_in(key(s), n)`, alone and among many.
"""

import dataclasses
from collections.abc import Sequence
from functools import cache, partial
from typing import Any, Literal, get_type_hints

try:
    import gymnasium
except ModuleNotFoundError as error:
    from mcx_jax import extras

    raise ModuleNotFoundError(extras.missing("gymnasium", "mcx_jax.gym")) from error
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from mcx_jax.cli import checked_value
from mcx_jax.delay import CONTROL_DT_S
from mcx_jax.env_config import EnvConfig, MotionConfig
from mcx_jax.envs.state import EnvState
from mcx_jax.envs.v2v import V2VEnv, make_env
from mcx_jax.errors import UserError
from mcx_jax.playground import finite_step

ENV_ID = "mcx_jax/V2V-v0"


@struct.dataclass
class Told:
    """What a learner is told of N environments."""

    obs: Any
    """(N, 38); (N, 39) with the measurement's age, where `conditions` has `latency_steps`."""
    reward: Any
    """(N,)."""
    truncated: Any
    """(N,) bool: time limit, or no longer valid."""
    info: dict[str, Any]
    """dp_mm, da_mrad, valid, each (N,)."""


@jax.jit
def _reset(env: V2VEnv, seeds: jax.Array, episodes: jax.Array) -> tuple[EnvState, Told]:
    keys = jax.vmap(lambda s, n: jax.random.fold_in(jax.random.key(s), n))(seeds, episodes)
    state = jax.vmap(env.reset, out_axes=-1)(keys)
    return state, _tell(state)


@jax.jit
def _step(env: V2VEnv, state: EnvState, actions: jax.Array) -> tuple[EnvState, Told]:
    state = jax.vmap(partial(finite_step, env), in_axes=-1, out_axes=-1)(state, actions.T)
    return state, _tell(state)


@jax.jit
def _pick(mask: jax.Array, new: Any, old: Any) -> Any:
    """`new` where `mask` (N,), else `old`; leaves (..., N)."""
    return jax.tree.map(lambda a, b: jnp.where(mask, a, b), new, old)


def _tell(state: EnvState) -> Told:
    metrics = state.metrics
    info = {
        "dp_mm": 1e3 * metrics.pos_error_m,
        "da_mrad": 1e3 * metrics.ang_error_rad,
        "valid": metrics.valid,
    }
    return Told(state.obs.T, state.reward, state.done | ~metrics.valid, info)


class Episodes:
    """N environments and the episode that each is in; NumPy outside, one program each inside."""

    def __init__(self, env: V2VEnv, count: int) -> None:
        """Nothing is computed before the first reset."""
        self.env = env
        self.state: EnvState | None = None
        self.seeds = np.zeros(count, np.uint32)
        self.numbers = np.full(count, -1, np.int32)

    def seed(self, seeds: Sequence[int | None], rng: np.random.Generator) -> None:
        """Start again from episode 0 of these seeds.

        Args:
            seeds: None: goes on with its seed, or with one from `rng` if it has none yet.
        """
        for i, seed in enumerate(seeds):
            if seed is None and self.numbers[i] >= 0:
                continue
            seed = int(rng.integers(2**32)) if seed is None else seed
            if not 0 <= seed < 2**32:
                raise UserError(f"seed {seed}: must be 0 to 2^32 - 1")
            self.seeds[i], self.numbers[i] = seed, -1

    def reset(self, mask: np.ndarray) -> Told:
        """The next episode of the environments in `mask` (N,); what is told of the others is not
        to be used."""
        self.numbers += mask
        # The others get an episode that is thrown away: one program, whatever the mask.
        state, told = _reset(self.env, self.seeds, np.maximum(self.numbers, 0))
        self.state = state if self.state is None else _pick(mask, state, self.state)
        return _to_numpy(told)

    def step(self, actions: np.ndarray) -> Told:
        """One control step of all; actions (N, 6), cm and crad."""
        if self.state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        actions = np.asarray(actions, np.float32)
        self.state, told = _step(self.env, self.state, actions)
        return _to_numpy(told)


def _to_numpy(told: Told) -> Told:
    """Copies that may be written to."""
    return jax.tree.map(np.array, jax.device_get(told))


@cache
def _task(env: EnvConfig, motion: MotionConfig, split: Literal["train", "test"]) -> V2VEnv:
    """Shared by all environments of a process with the same settings: the tables are large."""
    return dataclasses.replace(make_env(env, motion, split=split), whole_batches=True)


def _make_task(test: bool, settings: dict[str, Any]) -> V2VEnv:
    configs = []
    for config in (EnvConfig, MotionConfig):
        hints = get_type_hints(config)
        given = {k: settings.pop(k) for k in hints if k in settings}
        checked = {k: checked_value(hints[k], x, f"setting {k}") for k, x in given.items()}
        configs.append(config(**checked))
    if settings:
        raise UserError(
            f"unknown setting {next(iter(settings))!r}: use test or a field of EnvConfig or "
            "MotionConfig"
        )
    return _task(*configs, "test" if test else "train")


def _spaces(env: V2VEnv) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """(observation, action). An observation has no bounds: any arm, any reach."""
    bound = env.config.max_correction
    return (
        gymnasium.spaces.Box(-np.inf, np.inf, (env.obs_size,), np.float32),
        gymnasium.spaces.Box(-bound, bound, (env.action_size,), np.float32),
    )


class V2V(gymnasium.Env[np.ndarray, np.ndarray]):
    """One environment (see the module)."""

    metadata = {"render_modes": [], "render_fps": round(1 / CONTROL_DT_S)}

    def __init__(
        self, *, test: bool = False, render_mode: str | None = None, **settings: Any
    ) -> None:
        """Settings: fields of EnvConfig and MotionConfig.

        Args:
            test: the motion that training never sees.
            render_mode: without effect, as nothing is drawn; learners' helpers pass one unasked.

        Raises:
            UserError: an unknown or impossible setting.
        """
        del render_mode
        env = _make_task(test, settings)
        self.observation_space, self.action_space = _spaces(env)
        self._episodes = Episodes(env, 1)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """(observation, info) of episode 0 of `seed`, or of the next episode. No options."""
        super().reset(seed=seed)
        self._episodes.seed([seed], self.np_random)
        told = self._episodes.reset(np.array([True]))
        return told.obs[0], _first(told.info)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """(observation, reward, False, truncated, info) after 20 ms."""
        told = self._episodes.step(np.asarray(action)[None])
        reward, truncated = float(told.reward[0]), bool(told.truncated[0])
        return told.obs[0], reward, False, truncated, _first(told.info)


def _first(info: dict[str, np.ndarray]) -> dict[str, Any]:
    return {name: value[0].item() for name, value in info.items()}


class V2VVector(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many environments in one program (see the module).

    An environment whose episode ends is reset in the same step: its observation and info are those
    of the new episode, the last ones of the old are `info["final_obs"]` and `info["final_info"]`.
    """

    metadata = {**V2V.metadata, "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, num_envs: int = 1, *, test: bool = False, **settings: Any) -> None:
        """As `V2V`, `num_envs` of them."""
        if num_envs < 1:
            raise UserError(f"num_envs {num_envs}: must be a positive integer")
        self.num_envs = num_envs
        env = _make_task(test, settings)
        self.single_observation_space, self.single_action_space = _spaces(env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._episodes = Episodes(env, num_envs)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """(observations, infos); an integer seeds environment i with seed + i. No options."""
        if seed is None or isinstance(seed, int):
            super().reset(seed=seed)
            seed = [None if seed is None else seed + i for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise UserError(f"{len(seed)} seeds for {self.num_envs} environments")
        self._episodes.seed(seed, self.np_random)
        everyone = np.ones(self.num_envs, bool)
        told = self._episodes.reset(everyone)
        return told.obs, _masked(told.info, everyone)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """(observations, rewards, terminated, truncated, infos) after 20 ms; actions (N, 6)."""
        told = self._episodes.step(actions)
        ended = told.truncated
        info = _masked(told.info, np.ones(self.num_envs, bool))
        obs = told.obs
        if ended.any():
            obs, info = self._renew(told)
        return obs, told.reward, np.zeros_like(ended), ended, info

    def _renew(self, told: Told) -> tuple[np.ndarray, dict[str, Any]]:
        """Next episodes where one has ended: observations and infos."""
        ended = told.truncated
        fresh = self._episodes.reset(ended)
        final_obs = np.full(self.num_envs, None, object)
        for i in np.flatnonzero(ended):
            final_obs[i] = told.obs[i]
        values = {k: np.where(ended, fresh.info[k], v) for k, v in told.info.items()}
        last = {k: np.where(ended, v, np.zeros_like(v)) for k, v in told.info.items()}
        ends = {"final_obs": final_obs, "final_info": _masked(last, ended)}
        info = _masked(values, np.ones(self.num_envs, bool)) | _masked(ends, ended)
        return np.where(ended[:, None], fresh.obs, told.obs), info


def _masked(info: dict[str, Any], mask: np.ndarray) -> dict[str, Any]:
    """Gymnasium's form: beside every key, under `_key`, for which environments it holds."""
    return info | {f"_{name}": mask.copy() for name in info}


gymnasium.register(
    ENV_ID, entry_point="mcx_jax.gym:V2V", vector_entry_point="mcx_jax.gym:V2VVector"
)
