"""Controllers whose numbers are found on training motion: the strongest rivals without a policy.

`extrapolate-best` is `extrapolate` with the lead that tracks best; `fir` predicts the goal by a
linear filter of its last poses (finite impulse response), fitted by least squares. Both see what a
policy sees of the goal, know the delay and the age of measurements, and are fitted under the
conditions they are evaluated under: they know more than a policy that was trained for many.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from mcx_jax.config.delay import PHYSICS_DT_S, SUBSTEPS
from mcx_jax.console.terminal import silent
from mcx_jax.controllers.classical import HOLD_LEAD_S, Extrapolate, correction, moved, turn_of
from mcx_jax.envs import conditions
from mcx_jax.envs.motion import LOOK_AHEAD_STEPS
from mcx_jax.envs.state import EnvState
from mcx_jax.envs.v2v import V2VEnv
from mcx_jax.errors import UserError
from mcx_jax.evaluation.episodes import episode_errors
from mcx_jax.evaluation.statistics import WARM_UP_STEPS
from mcx_jax.spatial import (
    log_rotation,
    matmul,
    transpose,
    unpack,
    unpack_matrix,
)

TAPS = 25
"""Poses that the filter sees, half a second of them."""
LEADS_S = tuple(HOLD_LEAD_S + x for x in (-0.010, 0.0, 0.004, 0.008, 0.012, 0.020))
"""Leads tried beyond the known delay: the servo's own lag is in none of the names."""
FIT_EPISODES, FIT_STEPS = 48, 500
FIT_SEED = 1_000_003
RIDGE = 1e-9
"""Times the number of rows, m2: far below the motion, so that 144 unknowns stay determined."""


@struct.dataclass
class Fir:
    """The goal's pose ahead as a linear function of how it got where it is."""

    weights: jax.Array
    """(ages, 6 (TAPS - 1), 6): from the changes of pose (m, rad, in B) to the change still to come,
    for every age of the measurement in control steps that the task knows."""

    def init(self, env: V2VEnv, state: EnvState) -> jax.Array:
        """(TAPS, 12) poses: the present one, as if the goal had always been there."""
        return jnp.broadcast_to(_flat(state.measured), (TAPS, 12))

    def act(self, env: V2VEnv, state: EnvState, memory: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Move the goal to where it is predicted."""
        memory = jnp.concatenate([memory[1:], _flat(state.measured)[None]])
        latency = state.conditions.latency
        weights = self.weights[0] if latency is None else self.weights[latency]
        change = unpack(features(memory, env.wall) @ weights, 6)
        now = state.measured.pose
        return memory, correction(now, moved(now, change, env.wall), env.wall)


def _flat(measured: conditions.Measurement) -> jax.Array:
    return jnp.concatenate([measured.rotation.ravel(), measured.position])


def features(poses: jax.Array, wall: jax.Array | None = None) -> jax.Array:
    """(6 (TAPS - 1),) changes from the last TAPS - 1 poses to the present one, m and rad in B.

    Args:
        poses: (TAPS, 12).
        wall: see `mcx_jax.compute.fusion`.
    """
    r, p = poses[:, :9].reshape(-1, 3, 3), poses[:, 9:]
    now = unpack_matrix(r[-1])
    turns = jax.vmap(lambda old: jnp.stack(turn_of(now, transpose(unpack_matrix(old)), wall)))
    return jnp.concatenate([(p[-1] - p[:-1]).ravel(), turns(r[:-1]).ravel()])


def fit_fir(env: V2VEnv, lead_s: float) -> Fir:
    """Least squares over training motion.

    Args:
        env: on training motion; its conditions are those of the fit.
        lead_s: how far ahead of the present, not of a late measurement, to predict.
    """
    oldest = int(env.config.conditions.ranges["latency_steps"].high)
    lead = round(lead_s / PHYSICS_DT_S)
    return Fir(jnp.stack([_weights(env, lead, age) for age in range(oldest + 1)]))


def _weights(env: V2VEnv, lead: int, age: int) -> jax.Array:
    """Least squares for measurements of one age."""
    keys = jax.random.split(jax.random.key(FIT_SEED), FIT_EPISODES)
    x, y = jax.device_get(_regression(env, keys, jnp.int32(lead), jnp.int32(age)))
    x, y = (a.reshape(-1, a.shape[-1]).astype(np.float64) for a in (x, y))
    normal = x.T @ x + RIDGE * len(x) * np.eye(x.shape[1])
    return jnp.asarray(np.linalg.solve(normal, x.T @ y), jnp.float32)


@jax.jit
def _regression(
    env: V2VEnv, keys: jax.Array, lead: jax.Array, age: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """(episodes, steps, features), (episodes, steps, 6): what the filter sees and what it wants."""

    def episode(key):
        track, goal_m, drawn = env.draw(key)
        drawn = drawn if drawn.latency is None else replace(drawn, latency=age)
        goal = lambda step: env.goal_at(track, goal_m, drawn, step)  # noqa: E731
        first = conditions.first_measurement(drawn, env.config, goal(jnp.int32(0)))

        def body(measured, step):
            measured = conditions.measure(drawn, measured.queue, goal(step * SUBSTEPS), step)
            r, p = goal(step * SUBSTEPS + lead)
            turn = log_rotation(matmul(r, transpose(unpack_matrix(measured.rotation))))
            shift = jnp.stack(p) - measured.position
            return measured, (_flat(measured), jnp.concatenate([shift, jnp.stack(turn)]))

        # Motion ends 2 s after the episode: half of them are left for the lead.
        steps = min(FIT_STEPS, env.episode_steps + LOOK_AHEAD_STEPS // 2)
        _, (poses, wanted) = jax.lax.scan(body, first, jnp.arange(1, steps + 1))
        rows = jnp.arange(steps - TAPS + 1)[:, None] + jnp.arange(TAPS)
        return jax.vmap(features)(poses[rows]), wanted[TAPS - 1 :]

    return jax.lax.map(episode, keys)


def fitted(who: str, env: V2VEnv, say: Callable[[str], None] = silent) -> Any:
    """The controller `extrapolate-best` or `fir`, with the lead that tracks best.

    Args:
        env: on training motion.
        say: what happens is said to it (`mcx_jax.console.terminal.working`).

    Raises:
        UserError: none of them keeps the arm's state finite.
    """
    known_s = env.known_delay.group_delay_s
    candidates, scores = [], []
    for i, lead in enumerate(LEADS_S):
        say(f"fitting {who}: lead {i + 1} of {len(LEADS_S)} (compiles with the first)")
        best = who == "extrapolate-best"
        lead_s = known_s + lead
        candidates.append(Extrapolate(jnp.float32(lead_s)) if best else fit_fir(env, lead_s))
        scores.append(_score(env, candidates[-1]))
    if not np.isfinite(scores).any():
        raise UserError(f"{who}: the arm diverges on training motion, whatever the lead")
    return candidates[int(np.argmin(np.nan_to_num(scores, nan=np.inf)))]


def _score(env: V2VEnv, controller: Any) -> float:
    """Mean of dp and da (m + rad) over training episodes, the reward's own measure; NaN if one
    of them diverges."""
    dp, da, *_ = episode_errors(env, controller, (1.0,), 8, FIT_SEED)
    return float(np.mean(dp[WARM_UP_STEPS:]) + np.mean(da[WARM_UP_STEPS:]))
