"""What is drawn of an episode: poses of vessels and goal in the world, joint angles, errors.

The episode is simulated beforehand, by the program that `evaluate` runs; drawing only reads.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from mcx_jax.config.delay import CONTROL_DT_S, PHYSICS_DT_S, SUBSTEPS
from mcx_jax.envs import vessels
from mcx_jax.envs.motion import Motion, Track
from mcx_jax.envs.state import EnvState
from mcx_jax.envs.v2v import V2VEnv
from mcx_jax.report.episode import side_by_side
from mcx_jax.sea.spectrum import parse_sea

RECORDED = "motion"
"""What a recording's sea is called (`envs.motion`)."""
EPISODES = 50
"""Episodes to choose from: those of `evaluate` with its default `--episodes`."""


@struct.dataclass
class Poses:
    """One controller's episode; axis 0 = end of control step 1, 2, ... World frame I unless said.

    Positions (steps, 3) m, rotations (steps, 3, 3), the columns being the frame's axes.
    """

    a_m: Any
    """Deck origin of vessel A, which is the arm's base B."""
    a_rotation: Any
    b_m: Any
    """Deck origin of vessel B."""
    b_rotation: Any
    goal_m: Any
    goal_rotation: Any
    q_rad: Any
    """(steps, nq) joint angles."""
    pos_error_m: Any
    """(steps,) dp."""
    ang_error_rad: Any
    """(steps,) da."""
    seed: Any
    """(steps,) int32 which of the sea's tables; the same all the time, as the next two."""
    start_a: Any
    """(steps,) int32 where vessel A's window begins in the table, physics steps of 2 ms."""
    start_b: Any
    delay: Any
    """(steps,) int32 which of the environment's delays; the same all the time."""


@dataclass(frozen=True)
class Take:
    """An episode of one or two controllers, ready to be drawn: the same motion, the same goal."""

    names: tuple[str, ...]
    """What to call them: `ik` alone or `ik` and the other."""
    poses: tuple[Poses, ...]
    """Of each."""
    delay: str
    """That the episode has: its name and how late it makes slow motion."""
    sea: str
    """Name of the sea state."""

    @property
    def steps(self) -> int:
        """Control steps."""
        return len(self.poses[0].pos_error_m)

    @property
    def time_s(self) -> np.ndarray:
        """(steps,) seconds since the episode's beginning."""
        return CONTROL_DT_S * np.arange(1, self.steps + 1)

    @property
    def window_starts_s(self) -> tuple[float, float]:
        """Where the vessels' windows begin in their table, laboratory seconds."""
        poses = self.poses[0]
        return PHYSICS_DT_S * int(poses.start_a[0]), PHYSICS_DT_S * int(poses.start_b[0])


def simulate(
    env: V2VEnv, who: str, controller: Any, *, sea: int, seed: int = 0, episode: int = 0
) -> Take:
    """One of the test episodes that `evaluate --seed SEED` runs.

    Args:
        who: what to call the controller; `ik` stands alone.
        sea: index into env.motion.seas.
        episode: 0 to EPISODES - 1.
    """
    key = jax.random.split(jax.random.key(seed), EPISODES)[episode]
    both = side_by_side(env, controller, key, sea, _sample)
    names = ("ik",) if who == "ik" else ("ik", who)
    return Take(names, both[: len(names)], name_delay(env, both[0]), env.motion.seas[sea])


def describe_sea(sea: str) -> str:
    """A sea's name with its numbers at full scale: "Wd (Hs 2.5 m, Tp 10 s)"."""
    if sea == RECORDED:
        return "recorded"
    state = parse_sea(sea)
    return f"{sea} (Hs {state.hs_m:g} m, Tp {state.tp_s:g} s)"


def name_delay(env: V2VEnv, poses: Poses) -> str:
    """The episode's delay and how late it makes slow motion: "E2 (40 ms)"."""
    delay = env.delays[int(poses.delay[0])]
    return f"{delay.name} ({1e3 * delay.group_delay_s:.0f} ms)"


def vessel_poses(motion: Motion, track: Track, step: jax.Array):
    """World poses ((R, p) of A, (R, p) of B) at a physics step of the episode (m; rad)."""
    seg_a = vessels.segment(motion.knots_a, track.table, track.start_a + step)
    seg_b = vessels.segment(motion.knots_b, track.table, track.start_b + step)
    return vessels.poses(seg_a, seg_b, 0)


def _sample(env: V2VEnv, before: EnvState, after: EnvState, action: jax.Array) -> Poses:
    del before, action
    return poses_now(env, after)


def poses_now(env: V2VEnv, after: EnvState) -> Poses:
    """What is drawn of a state, without the axis of control steps."""
    track = after.track
    (r_a, p_a), (r_b, p_b) = vessel_poses(env.motion, track, after.step * SUBSTEPS)
    a_rotation, a_m = jnp.asarray(r_a), jnp.stack(p_a)
    goal = env.goal_ahead(after, 0)
    return Poses(
        a_m=a_m,
        a_rotation=a_rotation,
        b_m=jnp.stack(p_b),
        b_rotation=jnp.asarray(r_b),
        goal_m=a_m + a_rotation @ jnp.stack(goal[1]),
        goal_rotation=a_rotation @ jnp.asarray(goal[0]),
        q_rad=after.arm.q,
        pos_error_m=after.metrics.pos_error_m,
        ang_error_rad=after.metrics.ang_error_rad,
        seed=track.table % env.motion.seeds,
        start_a=track.start_a,
        start_b=track.start_b,
        delay=jnp.int32(0) if after.conditions.delay is None else after.conditions.delay,
    )
