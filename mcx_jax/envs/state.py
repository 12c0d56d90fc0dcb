"""What changes within an episode."""

import jax
from flax import struct

from mcx_jax.arm.lag import LagState
from mcx_jax.envs.conditions import Conditions, Measurement
from mcx_jax.envs.motion import Track


@struct.dataclass
class ArmState:
    """Joint state."""

    q: jax.Array
    """(nq,) joint angles, rad."""
    qd: jax.Array
    """(nq,) joint velocities, rad/s."""


@struct.dataclass
class Metrics:
    """What one control step achieved; scalars, taken at its end."""

    pos_error_m: jax.Array
    """dp: distance from the tool to the goal."""
    ang_error_rad: jax.Array
    """da: angle between the tool and the goal."""
    ik_error: jax.Array
    """IK error before its last step, m + rad."""
    valid: jax.Array
    """bool, sticky within an episode: no IK failure, no excess error, all finite."""


@struct.dataclass
class EnvState:
    """Everything that changes within an episode."""

    arm: ArmState
    lag: tuple[LagState, ...]
    reference: jax.Array
    """(nq,) late joint reference q_hat of the last control step, rad."""
    track: Track
    goal_m: jax.Array
    """(3,) place of the goal on vessel B; a path is about it."""
    conditions: Conditions
    measured: Measurement
    """T_G^B now, as far as the controller knows."""
    step: jax.Array
    """() int32 control steps done."""
    obs: jax.Array
    """(38,) see observe.OBS_TABLE; (39,) with the measurement's age where that is not 0."""
    reward: jax.Array
    """() -(dp + da) at the end of the last step (paper eq. 4)."""
    done: jax.Array
    """() bool: the time limit is reached (never a failure: nothing terminates)."""
    metrics: Metrics
