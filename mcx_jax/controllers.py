"""Controllers without learning: what a correction policy has to beat.

A controller is `init(env, state) -> memory` and `act(env, state, memory) -> (memory, action)`, both
for ONE episode; a trained policy has the same two functions (`mcx_jax.policy.PolicyController`).
"""

from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from mcx_jax.delay import CONTROL_DT_S, PHYSICS_DT_S
from mcx_jax.envs.state import EnvState
from mcx_jax.envs.v2v import ACTION_SCALE, V2VEnv
from mcx_jax.spatial import (
    Mat,
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
        r, p = state.measured.pose
        r_old, p_old = unpack_matrix(memory[0]), unpack(memory[1], 3)
        turn = vscale(steps, log_rotation(matmul(r, transpose(r_old))))
        ahead = matmul(exp_rotation(turn), r), vadd(p, vscale(steps, vsub(p, p_old)))  # type: ignore[arg-type]
        memory = state.measured.rotation, state.measured.position
        return memory, correction((r, p), ahead)  # type: ignore[arg-type]


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
        return memory, correction(state.measured.pose, env.goal_ahead(state, lead))


def _lead_s(env: V2VEnv, lead_s: Any) -> Any:
    return env.known_delay.group_delay_s + HOLD_LEAD_S if lead_s is None else lead_s


def correction(now: tuple[Mat, Vec], wanted: tuple[Mat, Vec]) -> jax.Array:
    """(6,) action that turns goal pose `now` into `wanted`, cm and crad in the goal's axes."""
    shift = tmatvec(now[0], vsub(wanted[1], now[1]))
    turn = log_rotation(matmul(transpose(now[0]), wanted[0]))
    return jnp.stack([*shift, *turn]) / ACTION_SCALE


CLASSICAL = {"ik": IK(), "extrapolate": Extrapolate(), "preview": Preview()}
"""Controllers by the name that the command line uses; `mcx_jax.fitted` has two more."""
