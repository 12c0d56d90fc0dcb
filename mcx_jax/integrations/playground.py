"""The task as an environment of MuJoCo Playground: its `reset` and `step`, its `State`, its names.

Nothing of Playground is imported. One episode, pure: `jax.jit` and `jax.vmap` are the caller's, and
so is its end: Playground's wrapper counts the steps (`episode_length`, at most `episode_steps`).
Its automatic reset goes back to an environment's first state, so N environments are N windows of
motion. Nothing terminates: all rewards are negative, and an end would be worth more than tracking.
"""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from mcx_jax.config.delay import CONTROL_DT_S, PHYSICS_DT_S, SUBSTEPS
from mcx_jax.config.task import EnvConfig, MotionConfig
from mcx_jax.envs.state import EnvState
from mcx_jax.envs.v2v import V2VEnv, make_env


@struct.dataclass
class State:
    """What Playground's wrappers and learners read and replace."""

    data: EnvState
    """This project's own state, not MJX's; learners hand it through unread."""
    obs: jax.Array
    """(38,) see envs.observe.OBS_TABLE; (39,) with the measurement's age."""
    reward: jax.Array
    """() -(dp + da), m and rad."""
    done: jax.Array
    """() float32, always 0."""
    metrics: dict[str, jax.Array]
    """dp_mm, da_mrad and valid (0 or 1), each () float32, beside what wrappers have put there."""
    info: dict[str, Any]
    """What wrappers have put there."""


def finite_step(env: V2VEnv, state: EnvState, action: jax.Array) -> EnvState:
    """`env.step`; where the result is not finite, observation, reward and errors are the old ones,
    so that no learner ever sees a NaN. The state is invalid then."""
    after = env.step(state, action)
    finite = jnp.isfinite(after.obs).all() & jnp.isfinite(after.reward)
    shown = [(s.obs, s.reward, s.metrics) for s in (after, state)]
    obs, reward, metrics = jax.tree.map(lambda new, old: jnp.where(finite, new, old), *shown)
    metrics = replace(metrics, valid=after.metrics.valid & finite)
    return replace(after, obs=obs, reward=reward, metrics=metrics)


class V2V:
    """The vessel-to-vessel task with the properties and methods of Playground's MjxEnv."""

    dt, sim_dt, n_substeps = CONTROL_DT_S, PHYSICS_DT_S, SUBSTEPS

    def __init__(
        self,
        env: EnvConfig = EnvConfig(),  # noqa: B008 - frozen
        motion: MotionConfig = MotionConfig(),  # noqa: B008
        *,
        test: bool = False,
    ) -> None:
        """Build the task.

        Args:
            test: the motion that training never sees.

        Raises:
            UserError: the arm or the motion file cannot be used.
        """
        self.env = make_env(env, motion, split="test" if test else "train")
        self.observation_size, self.action_size = self.env.obs_size, self.env.action_size

    @property
    def unwrapped(self) -> "V2V":
        """Itself."""
        return self

    def reset(self, rng: jax.Array) -> State:
        """A new episode."""
        return _state(self.env.reset(rng), {}, {})

    def step(self, state: State, action: jax.Array) -> State:
        """One control step of 20 ms; action (6,) in cm and crad."""
        return _state(finite_step(self.env, state.data, action), state.metrics, state.info)


def _state(data: EnvState, metrics: dict[str, jax.Array], info: dict[str, Any]) -> State:
    errors = data.metrics
    # Wrappers add metrics of their own, which a scan over steps must find again.
    metrics = metrics | {
        "dp_mm": 1e3 * errors.pos_error_m,
        "da_mrad": 1e3 * errors.ang_error_rad,
        "valid": errors.valid.astype(jnp.float32),
    }
    return State(data, data.obs, data.reward, jnp.zeros_like(data.reward), metrics, info)
