"""Controllers without learning: what a correction policy has to beat.

A controller is `init(env, state) -> memory` and `act(env, state, memory) -> (memory, action)`, both
for ONE episode; a trained policy has the same two functions (`policy.file.PolicyController`).
"""

from collections.abc import Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from mcx_jax.compute.fusion import stage
from mcx_jax.config.delay import CONTROL_DT_S, PHYSICS_DT_S
from mcx_jax.envs.state import EnvState
from mcx_jax.envs.v2v import ACTION_SCALE, V2VEnv
from mcx_jax.spatial import (
    Mat,
    Scalar,
    Vec,
    exp_rotation,
    log_rotation,
    matmul,
    tmatvec,
    transpose,
    unpack,
    unpack_matrix,
    vadd,
    vscale,
    vsub,
)

HOLD_LEAD_S = 0.010
"""A reference is held for 20 ms; on average it is 10 ms old when the arm follows it."""


class Controller(Protocol):
    """What `evaluate` runs."""

    def init(self, env: V2VEnv, state: EnvState) -> Any:
        """Memory at the beginning of an episode."""
        ...

    def act(self, env: V2VEnv, state: EnvState, memory: Any) -> tuple[Any, jax.Array]:
        """(memory, (6,) action in cm and crad)."""
        ...


@struct.dataclass
class IK:
    """The paper's baseline: no correction."""

    def init(self, env: V2VEnv, state: EnvState) -> tuple[()]:
        """No memory."""
        return ()

    def act(self, env: V2VEnv, state: EnvState, memory: tuple[()]) -> tuple[tuple[()], jax.Array]:
        """Zero."""
        return memory, jnp.zeros(6)


@struct.dataclass
class Extrapolate:
    """The goal's pose T_G^B continued with its last velocity over the known delay, half the hold
    and the age of the measurement."""

    lead_s: jax.Array | float | None = None
    """How far ahead of the measurement's time, s; None = the known delay's group delay plus 10 ms.
    """

    def init(self, env: V2VEnv, state: EnvState) -> tuple[jax.Array, jax.Array]:
        """The present pose."""
        return state.measured.rotation, state.measured.position

    def act(self, env: V2VEnv, state: EnvState, memory):
        """Move the goal by lead / 20 ms times its last change."""
        steps = (_lead_s(env, self.lead_s) + state.conditions.age_s) / CONTROL_DT_S
        now = state.measured.pose
        r_old, p_old = unpack_matrix(memory[0]), unpack(memory[1], 3)
        turn = turn_of(now[0], transpose(r_old), env.wall)
        change = (*vscale(steps, vsub(now[1], p_old)), *vscale(steps, turn))
        memory = state.measured.rotation, state.measured.position
        return memory, correction(now, moved(now, change, env.wall), env.wall)


@struct.dataclass
class Preview:
    """The true future pose of the goal, as if the motion were known in advance: what aiming a fixed
    lead ahead can reach. A policy that also learns the servo's own error can be better."""

    lead_s: float | None = struct.field(pytree_node=False, default=None)
    """How far ahead, s, rounded to 2 ms; None = the delay's group delay plus 10 ms."""

    def init(self, env: V2VEnv, state: EnvState) -> tuple[()]:
        """No memory."""
        return ()

    def act(self, env: V2VEnv, state: EnvState, memory: tuple[()]):
        """Aim at the pose that the goal will have."""
        lead = round(_lead_s(env, self.lead_s) / PHYSICS_DT_S)
        return memory, correction(state.measured.pose, env.goal_ahead(state, lead), env.wall)


def _lead_s(env: V2VEnv, lead_s: Any) -> Any:
    return env.known_delay.group_delay_s + HOLD_LEAD_S if lead_s is None else lead_s


def moved(pose: tuple[Mat, Vec], change: Sequence[Scalar], wall: jax.Array | None):
    """A goal's pose in B after a change in B's axes: 3 m, 3 rad (rotation vector).

    Args:
        wall: see `mcx_jax.compute.fusion`. Without walls XLA computed a controller's rotations
            again for every number of its action: a control step of `extrapolate` took 195 us
            instead of 3 (256 episodes at once).
    """
    turn = stage(wall, exp_rotation, tuple(change[3:]))
    return stage(wall, matmul, turn, pose[0]), vadd(pose[1], tuple(change[:3]))  # type: ignore[arg-type]


def correction(
    now: tuple[Mat, Vec], wanted: tuple[Mat, Vec], wall: jax.Array | None = None
) -> jax.Array:
    """(6,) action that turns goal pose `now` into `wanted`, cm and crad in the goal's axes."""
    shift = stage(wall, tmatvec, now[0], vsub(wanted[1], now[1]))
    turn = turn_of(transpose(now[0]), wanted[0], wall)
    return jnp.stack([*shift, *turn]) / ACTION_SCALE


def turn_of(a: Mat, b: Mat, wall: jax.Array | None = None) -> Vec:
    """Rotation vector of a b, rad."""
    return stage(wall, log_rotation, stage(wall, matmul, a, b))


CLASSICAL = {"ik": IK(), "extrapolate": Extrapolate(), "preview": Preview()}
"""Controllers by the name that the command line uses; `mcx_jax.controllers.fitted` has two more."""
