"""The task for learners that are not written in JAX, as Gymnasium environments.

    import gymnasium
    import mcx_jax.integrations.gym  # registers the name

    one = gymnasium.make("mcx_jax/V2V-v0", delay="E2", sea="Wd")
    many = gymnasium.make_vec("mcx_jax/V2V-v0", num_envs=512, delay="E2")

Settings are those of `EnvConfig`, `ConditionsConfig` and `MotionConfig` by name (`noise_mm="1"`);
`test=True` takes the motion that training never sees. Observation: (38,) float32,
`envs.observe.OBS_TABLE`, m and rad. Action: (6,) float32, the goal moved in its own axes, 3 cm and
3 crad (rotation vector), within `max_correction`, which also the task applies. Reward: -(dp + da)
in m and rad. `info`: `dp_mm`, `da_mrad`, `valid`.

An episode is never terminated, only truncated, by the time limit or as soon as it is invalid (the
IK failed, the tool is half a metre off, the arm diverged). All rewards are negative: a terminated
failure would be worth more than tracking on. A state that is not finite is never shown: observation
and reward are then those of the step before.

An episode ends at the earlier of `episode_steps` (1000), which also decides where windows of motion
begin, and Gymnasium's own `max_episode_steps` (registered: 1000). A longer one needs both.

`render_mode="rgb_array"` draws as `mcx_jax.play` does (extra `viz`, off-screen OpenGL); `render` of
many gives one picture for each.

Episode n of seed s begins with the key `fold_in(key(s), n)`, alone and among many.
"""

import dataclasses
from collections.abc import Sequence
from functools import cache, partial
from importlib.util import find_spec
from typing import Any, Literal, get_type_hints

try:
    import gymnasium
except ModuleNotFoundError as error:
    from mcx_jax import extras

    raise ModuleNotFoundError(extras.missing("gymnasium", "mcx_jax.integrations.gym")) from error
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from mcx_jax.config.command_line import checked_value
from mcx_jax.config.delay import CONTROL_DT_S
from mcx_jax.config.task import ConditionsConfig, EnvConfig, MotionConfig
from mcx_jax.envs.state import EnvState
from mcx_jax.envs.v2v import V2VEnv, make_env
from mcx_jax.errors import UserError
from mcx_jax.integrations.playground import finite_step

ENV_ID = "mcx_jax/V2V-v0"
REGISTERED_STEPS = EnvConfig().episode_steps
"""`max_episode_steps` of the registered spec."""
NO_LIMIT = 2**31 - 1
RENDER_MODES = ("rgb_array",)


@struct.dataclass
class Transition:
    """What N environments return to the learner."""

    obs: Any
    """(N, 38); (N, 39) with the measurement's age, where `conditions` has `latency_steps`."""
    reward: Any
    """(N,)."""
    truncated: Any
    """(N,) bool: time limit, or no longer valid."""
    info: dict[str, Any]
    """dp_mm, da_mrad, valid, each (N,)."""


@jax.jit
def _reset(env: V2VEnv, seeds: jax.Array, episodes: jax.Array) -> tuple[EnvState, Transition]:
    keys = jax.vmap(lambda s, n: jax.random.fold_in(jax.random.key(s), n))(seeds, episodes)
    state = jax.vmap(env.reset, out_axes=-1)(keys)
    return state, _transition(state)


@jax.jit
def _step(
    env: V2VEnv, state: EnvState, actions: jax.Array, limit: jax.Array
) -> tuple[EnvState, Transition]:
    state = jax.vmap(partial(finite_step, env), in_axes=-1, out_axes=-1)(state, actions.T)
    transition = _transition(state)
    return state, dataclasses.replace(
        transition, truncated=transition.truncated | (state.step >= limit)
    )


def _checked(actions: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Actions as float32.

    Raises:
        UserError: another shape, no numbers, or not finite ones.
    """
    try:
        array = np.asarray(actions, np.float32)
    except (TypeError, ValueError):
        raise UserError(f"action: must be an array of numbers, shape {shape}") from None
    if array.shape != shape:
        raise UserError(f"action of shape {array.shape}: must have shape {shape}, cm and crad")
    if not np.isfinite(array).all():
        raise UserError("action is NaN or infinite: must be finite numbers, cm and crad")
    return array


@jax.jit
def _pick(mask: jax.Array, new: Any, old: Any) -> Any:
    """`new` where `mask` (N,), else `old`; leaves (..., N)."""
    return jax.tree.map(lambda a, b: jnp.where(mask, a, b), new, old)


def _transition(state: EnvState) -> Transition:
    metrics = state.metrics
    info = {
        "dp_mm": 1e3 * metrics.pos_error_m,
        "da_mrad": 1e3 * metrics.ang_error_rad,
        "valid": metrics.valid,
    }
    return Transition(state.obs.T, state.reward, state.done | ~metrics.valid, info)


class Episodes:
    """N environments and the episode that each is in; NumPy outside, one program each inside."""

    def __init__(self, settings: "_Settings", count: int, limit: int = NO_LIMIT) -> None:
        """Nothing is computed before the first reset.

        Args:
            limit: control steps after which an episode is truncated; its own end may be earlier.
        """
        self.settings, self.env, self.limit = settings, settings.task, np.int32(limit)
        self.state: EnvState | None = None
        self.seeds = np.zeros(count, np.uint32)
        self.numbers = np.full(count, -1, np.int32)
        self._live: Any = None

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

    def reset(self, mask: np.ndarray) -> Transition:
        """The next episode of the environments in `mask` (N,); the entries of the other
        environments are undefined."""
        self.numbers += mask
        # The others get an episode that is thrown away: one program, whatever the mask.
        state, transition = _reset(self.env, self.seeds, np.maximum(self.numbers, 0))
        self.state = state if self.state is None else _pick(mask, state, self.state)
        return _to_numpy(transition)

    def step(self, actions: np.ndarray) -> Transition:
        """One control step of all; actions (N, 6) float32, cm and crad."""
        if self.state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        self.state, transition = _step(self.env, self.state, actions, self.limit)
        return _to_numpy(transition)

    def pictures(self) -> tuple[np.ndarray, ...]:
        """What each looks like now, (360, 640, 3) uint8.

        Raises:
            UserError: the extra `viz` is missing, or no off-screen OpenGL works.
        """
        if self.state is None:
            raise gymnasium.error.ResetNeeded("call reset before render")
        if self._live is None:
            self._live = _live(self.settings, self.env)
        return self._live.pictures(self.state)

    def close(self) -> None:
        """Give the renderer back, if there is one."""
        if self._live is not None:
            self._live.close()
            self._live = None


def _live(settings: "_Settings", env: V2VEnv):
    """The renderer, which only `render` needs."""
    if find_spec("PIL") is None:
        raise UserError("render needs pillow: pip install 'mcx_jax[viz]'")
    from mcx_jax.play.live import Live

    return Live(env, settings.motion, settings.split)


def _to_numpy(transition: Transition) -> Transition:
    """Copies that may be written to."""
    return jax.tree.map(np.array, jax.device_get(transition))


@cache
def _task(env: EnvConfig, motion: MotionConfig, split: Literal["train", "test"]) -> V2VEnv:
    """Shared by all environments of a process with the same settings: the tables are large."""
    return dataclasses.replace(make_env(env, motion, split=split), whole_batches=True)


@dataclasses.dataclass(frozen=True)
class _Settings:
    """What the keywords of an environment say."""

    env: EnvConfig
    motion: MotionConfig
    split: Literal["train", "test"]

    @property
    def task(self) -> V2VEnv:
        return _task(self.env, self.motion, self.split)


def _read(test: bool, settings: dict[str, Any]) -> _Settings:
    """The settings by their plain names, whichever dataclass they are a field of."""
    conditions, env = _fields(ConditionsConfig, settings), _fields(EnvConfig, settings)
    motion = _fields(MotionConfig, settings)
    if settings:
        raise UserError(
            f"unknown setting {next(iter(settings))!r}: use test or a field of EnvConfig, "
            "ConditionsConfig or MotionConfig"
        )
    if conditions and "conditions" in env:
        raise UserError(f"settings conditions and {next(iter(conditions))}: give one of them")
    if conditions:
        env["conditions"] = ConditionsConfig(**conditions)
    split = "test" if checked_value(bool, test, "setting test") else "train"
    return _Settings(EnvConfig(**env), MotionConfig(**motion), split)


def _fields(config: type, settings: dict[str, Any]) -> dict[str, Any]:
    """Those of the settings that are fields of a dataclass, checked; taken out of `settings`."""
    hints = get_type_hints(config)
    given = {k: settings.pop(k) for k in hints if k in settings}
    return {k: checked_value(hints[k], x, f"setting {k}") for k, x in given.items()}


def _spaces(env: V2VEnv) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """(observation, action). An observation has no bounds: any arm, any reach."""
    bound = env.config.max_correction
    return (
        gymnasium.spaces.Box(-np.inf, np.inf, (env.obs_size,), np.float32),
        gymnasium.spaces.Box(-bound, bound, (env.action_size,), np.float32),
    )


def _checked_mode(render_mode: str | None) -> str | None:
    if render_mode not in (None, *RENDER_MODES):
        raise UserError(f"render_mode {render_mode!r}: use {', '.join(RENDER_MODES)} or None")
    return render_mode


def _no_options(options: dict[str, Any] | None) -> None:
    if options:
        raise UserError(f"reset takes no options, not {next(iter(options))!r}")


class V2V(gymnasium.Env[np.ndarray, np.ndarray]):
    """One environment (see the module)."""

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": round(1 / CONTROL_DT_S)}

    def __init__(
        self, *, test: bool = False, render_mode: str | None = None, **settings: Any
    ) -> None:
        """Settings: fields of EnvConfig, ConditionsConfig and MotionConfig.

        Args:
            test: the motion that training never sees.
            render_mode: "rgb_array", or None for no pictures. Nothing is loaded before `render`.

        Raises:
            UserError: an unknown or impossible setting.
        """
        self.render_mode = _checked_mode(render_mode)
        self._episodes = Episodes(_read(test, settings), 1)
        self._taken = 0
        self._shape = (self._episodes.env.action_size,)
        self.observation_space, self.action_space = _spaces(self._episodes.env)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """(observation, info) of episode 0 of `seed`, or of the next episode. No options."""
        super().reset(seed=seed)
        _no_options(options)
        self._check_limit()
        self._episodes.seed([seed], self.np_random)
        transition = self._episodes.reset(np.array([True]))
        self._taken = 0
        return transition.obs[0], _first(transition.info)

    def _check_limit(self) -> None:
        """Nothing tells an environment that `gymnasium.make` cuts its episodes short; a reset after
        as many steps as are registered does."""
        steps = self._episodes.env.episode_steps
        if self._taken == REGISTERED_STEPS < steps:
            raise UserError(_beyond(steps, REGISTERED_STEPS))

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """(observation, reward, False, truncated, info) after 20 ms; action (6,)."""
        transition = self._episodes.step(_checked(action, self._shape)[None])
        self._taken += 1
        reward, truncated = float(transition.reward[0]), bool(transition.truncated[0])
        return transition.obs[0], reward, False, truncated, _first(transition.info)

    def render(self) -> np.ndarray | None:
        """(360, 640, 3) uint8: the scene now; None without a render mode, as Gymnasium has it."""
        return self._episodes.pictures()[0] if self.render_mode else None

    def close(self) -> None:
        """Give the renderer back."""
        self._episodes.close()


def _beyond(steps: int, limit: int) -> str:
    return (
        f"episode_steps {steps}, but Gymnasium cuts an episode at max_episode_steps {limit}: give "
        f"both, max_episode_steps={steps}"
    )


def _limit(max_episode_steps: int | None, settings: dict[str, Any]) -> int:
    """Control steps after which many environments are truncated, from what `make_vec` passes on.

    Raises:
        UserError: episodes would silently be shorter than asked for.
    """
    if max_episode_steps is None or max_episode_steps == -1:
        return NO_LIMIT
    limit = checked_value(int, max_episode_steps, "max_episode_steps")
    if limit < 1:
        raise UserError(f"max_episode_steps {limit}: must be positive, or -1 for none")
    steps = settings.get("episode_steps")
    if type(steps) is int and limit == REGISTERED_STEPS < steps:
        raise UserError(_beyond(steps, limit))
    if steps is None and limit > REGISTERED_STEPS:
        raise UserError(
            f"max_episode_steps {limit}, but an episode has episode_steps {REGISTERED_STEPS}: give "
            f"both, episode_steps={limit}"
        )
    return limit


def _first(info: dict[str, np.ndarray]) -> dict[str, Any]:
    return {name: value[0].item() for name, value in info.items()}


class V2VVector(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many environments in one program (see the module).

    An environment whose episode ends is reset in the same step: its observation and info are those
    of the new episode, the last ones of the old are `info["final_obs"]` and `info["final_info"]`.
    With `autoreset_mode="NextStep"`, which Gymnasium's wrappers of observations need, in the step
    after it, whose action is not used and whose reward is 0.
    """

    metadata = {**V2V.metadata, "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        num_envs: int = 1,
        *,
        test: bool = False,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        **settings: Any,
    ) -> None:
        """As `V2V`, `num_envs` of them.

        Args:
            autoreset_mode: "SameStep" or "NextStep".
            max_episode_steps: an earlier end than `episode_steps`; -1 or None: none.
        """
        if num_envs < 1:
            raise UserError(f"num_envs {num_envs}: must be a positive integer")
        self.num_envs = num_envs
        self.render_mode = _checked_mode(render_mode)
        self.metadata = {**self.metadata, "autoreset_mode": _autoreset(autoreset_mode)}
        self._next_step = self.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
        self._ended = np.zeros(num_envs, bool)
        limit = _limit(max_episode_steps, settings)
        self._episodes = Episodes(_read(test, settings), num_envs, limit)
        self.single_observation_space, self.single_action_space = _spaces(self._episodes.env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """(observations, infos); an integer seeds environment i with seed + i. No options."""
        _no_options(options)
        if seed is None or isinstance(seed, int | np.integer):
            seed = None if seed is None else int(seed)
            super().reset(seed=seed)
            seed = [None if seed is None else seed + i for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise UserError(f"{len(seed)} seeds for {self.num_envs} environments")
        self._episodes.seed(seed, self.np_random)
        self._ended[:] = False
        everyone = np.ones(self.num_envs, bool)
        transition = self._episodes.reset(everyone)
        return transition.obs, _masked(transition.info, everyone)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """(observations, rewards, terminated, truncated, infos) after 20 ms; actions (N, 6)."""
        shape = self.num_envs, self._episodes.env.action_size
        transition, final = self._episodes.step(_checked(actions, shape)), {}
        if self._next_step:
            transition = self._begin(self._ended, transition)
            self._ended = ended = transition.truncated
        elif (ended := transition.truncated).any():
            final = _final(transition)
            transition = self._begin(ended, transition)
        info = _masked(transition.info, np.ones(self.num_envs, bool)) | final
        return transition.obs, transition.reward, np.zeros_like(ended), ended, info

    def _begin(self, mask: np.ndarray, transition: Transition) -> Transition:
        """`transition`, with the next episodes where `mask` says so. The reward stays that of the
        step in which the episode ended."""
        if not mask.any():
            return transition
        fresh = self._episodes.reset(mask)
        return Transition(
            obs=np.where(mask[:, None], fresh.obs, transition.obs),
            reward=np.where(mask & self._next_step, 0, transition.reward),
            truncated=transition.truncated & ~mask,
            info={k: np.where(mask, fresh.info[k], v) for k, v in transition.info.items()},
        )

    def render(self) -> tuple[np.ndarray, ...] | None:
        """One picture for each environment, (360, 640, 3) uint8; None without a render mode."""
        return self._episodes.pictures() if self.render_mode else None

    def close_extras(self, **kwargs: Any) -> None:
        """Give the renderer back."""
        self._episodes.close()


def _autoreset(mode: AutoresetMode | str) -> AutoresetMode:
    allowed = AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP
    names = {name.value: name for name in allowed}
    found = mode if mode in allowed else names.get(str(mode))
    if found is None:
        raise UserError(f"autoreset_mode {mode!r}: use {' or '.join(names)}")
    return AutoresetMode(found)


def _final(transition: Transition) -> dict[str, Any]:
    """Gymnasium's `final_obs` and `final_info`: the last of the episodes that have ended."""
    ended = transition.truncated
    obs = np.full(len(ended), None, object)
    for i in np.flatnonzero(ended):
        obs[i] = transition.obs[i]
    last = {k: np.where(ended, v, np.zeros_like(v)) for k, v in transition.info.items()}
    return _masked({"final_obs": obs, "final_info": _masked(last, ended)}, ended)


def _masked(info: dict[str, Any], mask: np.ndarray) -> dict[str, Any]:
    """Gymnasium's form: beside every key, under `_key`, for which environments it holds."""
    return info | {f"_{name}": mask.copy() for name in info}


gymnasium.register(
    ENV_ID,
    entry_point="mcx_jax.integrations.gym:V2V",
    vector_entry_point="mcx_jax.integrations.gym:V2VVector",
    max_episode_steps=REGISTERED_STEPS,
)
