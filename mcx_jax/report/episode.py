"""One episode with everything that the error statistics leave out: positions, references, torques.

The environment's public functions in one compiled program; baseline and controller side by side.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from mcx_jax.arm import ik
from mcx_jax.config.delay import CONTROL_DT_S
from mcx_jax.envs.state import EnvState
from mcx_jax.envs.v2v import V2VEnv
from mcx_jax.spatial import unpack


@struct.dataclass
class Episode:
    """Time series of one episode; axis 0 = end of control step 1, 2, ... Positions in frame B."""

    goal_m: Any
    """(steps, 3) goal."""
    reference_m: Any
    """(steps, 3) where the tool would be if the arm followed its late reference at once."""
    tool_m: Any
    """(steps, 3) tool."""
    pos_error_m: Any
    """(steps,) dp."""
    ang_error_rad: Any
    """(steps,) da."""
    correction: Any
    """(steps, 6) action of the control step, cm and crad in the goal's axes."""
    torque_nm: Any
    """(steps, nq) joint torque of the servos at the end of the control step."""

    @property
    def time_s(self) -> np.ndarray:
        """(steps,) end of each control step."""
        return CONTROL_DT_S * np.arange(1, len(self.pos_error_m) + 1)


def record(
    env: V2VEnv, controller: Any, *, episode: int, episodes: int, seed: int, sea: int
) -> tuple[Episode, Episode]:
    """(IK baseline, controller) over one of the episodes that `evaluate` runs with this seed.

    Args:
        episode: which of the sea's `episodes`.
        sea: index into env.motion.seas.
    """
    key = jax.random.split(jax.random.key(seed), episodes)[episode]
    return side_by_side(env, controller, key, sea, _sample)


def side_by_side(env: V2VEnv, controller: Any, key: jax.Array, sea: int, sample) -> tuple[Any, Any]:
    """(IK baseline, controller): what `sample` takes from the same episode, NumPy.

    Args:
        key: of the episode's windows of motion and goal.
        sea: index into env.motion.seas.
        sample: (env, state before, state after, action) -> pytree, for ONE episode; its leaves
            come back with the control steps as axis 0. A function of a module, since a new one
            compiles anew.
    """
    gains = jnp.asarray([0.0, 1.0])
    series = jax.device_get(_compiled()(env, controller, key, jnp.int32(sea), gains, sample=sample))
    return tuple(jax.tree.map(lambda x, k=k: x[..., k], series) for k in range(2))  # type: ignore


@functools.cache
def _compiled():
    return jax.jit(_roll_out, static_argnames="sample")


def _roll_out(env: V2VEnv, controller: Any, key, sea, gains, *, sample):
    """The same episode for each factor of the actions, batch axis last."""
    batched = functools.partial(jax.vmap, in_axes=-1, out_axes=-1)
    state = jax.vmap(lambda _: env.reset(key, sea), out_axes=-1)(gains)
    memory = batched(functools.partial(controller.init, env))(state)
    act, step = batched(functools.partial(controller.act, env)), batched(env.step)

    def body(carry, _):
        state, memory = carry
        memory, action = act(state, memory)
        action = gains * action
        after = step(state, action)
        return (after, memory), batched(functools.partial(sample, env))(state, after, action)

    return jax.lax.scan(body, (state, memory), None, env.episode_steps)[1]


def _sample(env: V2VEnv, before: EnvState, after: EnvState, action: jax.Array) -> Episode:
    model = env.model
    angles = unpack(after.arm.q, model.nq)
    return Episode(
        goal_m=jnp.stack(env.goal_ahead(after, 0)[1]),
        reference_m=jnp.stack(ik.tool_pose(model, unpack(after.reference, model.nq))[1]),
        tool_m=jnp.stack(ik.tool_pose(model, angles)[1]),
        pos_error_m=after.metrics.pos_error_m,
        ang_error_rad=after.metrics.ang_error_rad,
        correction=env.bounded(action),
        torque_nm=env.joint_torques(before, after),
    )


LAG_RANGE_S = (-0.2, 1.2)
"""Where a lag is looked for: longer than every delay that the command line accepts."""


def lag_s(goal_m: np.ndarray, follower_m: np.ndarray) -> float:
    """By how much a track follows another late: the shift with the least mean square distance.

    Args:
        goal_m, follower_m: (steps, 3) at the control rate. A constant distance (the arm sags) does
            not count. Resolution 1 ms; NaN if the episode diverged.
    """
    if not np.isfinite(follower_m).all():
        return np.nan
    time_s = CONTROL_DT_S * np.arange(len(goal_m))
    shifts = np.arange(LAG_RANGE_S[0], min(LAG_RANGE_S[1], 0.5 * time_s[-1]), 0.001)
    inside = (time_s >= shifts[-1]) & (time_s <= time_s[-1] + shifts[0])

    def distance(shift: float) -> float:
        late = [np.interp(time_s[inside] - shift, time_s, axis) for axis in goal_m.T]
        apart = np.stack(late, 1) - follower_m[inside]
        return float(np.square(apart - apart.mean(axis=0)).mean())

    return float(shifts[int(np.argmin([distance(shift) for shift in shifts]))])
