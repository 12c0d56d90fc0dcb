"""The vessel-to-vessel task, ONE episode: `reset(key) -> state`, `step(state, action) -> state`.

Pure, jittable, vmappable, differentiable. `vmap` it with the batch axis last
(`in_axes=-1, out_axes=-1`): the physics then works on contiguous rows of environments.
"""

from dataclasses import replace
from typing import Literal

import jax
import jax.numpy as jnp
from flax import struct
from mujoco import MjModel

from mcx_jax.config import CONTROL_DT_S, PHYSICS_DT_S, SUBSTEPS, Delay, EnvConfig, MotionConfig
from mcx_jax.envs import chain, ik, lag, observe, vessels
from mcx_jax.envs.model import ChainModel, chain_model, load_mujoco
from mcx_jax.envs.motion import Motion, Track, draw_track, load_motion
from mcx_jax.envs.vessels import Segment
from mcx_jax.errors import UserError
from mcx_jax.spatial import Mat, Vec, exp_rotation, matmul, matvec, norm, unpack, vadd, vscale
from mcx_jax.stage import stage

START_POSE_RAD = (-0.1, -1.0, 2.4, -2.9, -1.5, 0.0)
"""Where the first IK of an episode starts (authors' code)."""
SETTLE_STEPS = 100
"""Physics steps with the vessels held still before an episode (authors' code)."""
ACTION_SCALE = 0.01
"""Actions are centimetres and centiradians (paper)."""
MAX_ERROR_M = 0.5
"""An episode whose tool is farther than this from the goal counts as invalid from then on."""
MAX_JOINT_SPEED_RAD_S = 100.0
"""Beyond this the simulation has diverged; counts as invalid."""


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
    """Remaining IK error, m + rad."""
    valid: jax.Array
    """bool, sticky within an episode: no IK failure, no excess error, all finite."""


@struct.dataclass
class EnvState:
    """Everything that changes within an episode."""

    arm: ArmState
    lag: lag.LagState
    reference: jax.Array
    """(nq,) late joint reference q_hat of the last control step, rad."""
    track: Track
    goal_m: jax.Array
    """(3,) position of the goal on vessel B."""
    goal_rotation: jax.Array
    """(3, 3) R_B_G now."""
    goal_position: jax.Array
    """(3,) p_B_G now, m."""
    step: jax.Array
    """() int32 control steps done."""
    obs: jax.Array
    """(38,) see observe.OBS_TABLE."""
    reward: jax.Array
    """() -(dp + da) at the end of the last step (paper eq. 4)."""
    done: jax.Array
    """() bool: the time limit is reached (never a failure: nothing terminates)."""
    metrics: Metrics


@struct.dataclass
class V2VEnv:
    """The task's constants. Pass it through jit as an argument: it holds the tables of motion."""

    motion: Motion
    mjx_model: object
    """mjx.Model for --physics mjx, else None."""
    wall: jax.Array | None
    """() bool, true: keeps XLA on CPU from recomputing stages (mcx_jax.stage); None on a GPU."""
    model: ChainModel = struct.field(pytree_node=False)
    delay: Delay = struct.field(pytree_node=False)
    integrator: str = struct.field(pytree_node=False)
    """euler or implicitfast, with the chain engine also euler-smooth or implicitfast-smooth."""
    episode_steps: int = struct.field(pytree_node=False)

    @property
    def obs_size(self) -> int:
        """Length of the observation."""
        return observe.OBS_SIZE

    @property
    def action_size(self) -> int:
        """Length of the action: 3 translation (cm), 3 rotation (crad)."""
        return 6

    def reset(self, key: jax.Array, sea: jax.Array | int | None = None) -> EnvState:
        """A new episode: random windows and goal, arm settled on the goal, vessels still.

        Args:
            sea: index into motion.seas; None draws one.
        """
        uniform = jax.random.uniform(key, (7,))
        track = draw_track(self.motion, uniform[:4], sea)
        goal_m = vessels.draw_goal(uniform[4:])
        with jax.named_scope("vessels"):
            seg_a, seg_b = self._segments(track, jnp.int32(0))
            goal = stage(self.wall, vessels.goal_in_base, seg_a, seg_b, goal_m, 0)
        with jax.named_scope("ik"):
            start = jnp.asarray(_start_pose(self.model), goal_m.dtype)
            found = ik.solve(self.model, start, goal, ik.COLD_ITERATIONS, self.wall)
        with jax.named_scope("settle"):
            arm = ArmState(q=found.q, qd=jnp.zeros_like(found.q))
            still = vessels.still(seg_a)
            arm = self._simulate(arm, found.q, jnp.zeros_like(found.q), still, SETTLE_STEPS)
        tool = ik.tool_pose(self.model, unpack(arm.q, self.model.nq), self.wall)
        errors = stage(self.wall, observe.tracking_error, goal, tool)
        return EnvState(
            arm=arm,
            lag=lag.init(self.delay, found.q),
            reference=found.q,
            track=track,
            goal_m=goal_m,
            goal_rotation=_stack_matrix(goal[0]),
            goal_position=jnp.stack(goal[1]),
            step=jnp.int32(0),
            obs=observe.observe(goal, tool, errors),
            reward=-(errors[0] + errors[1]),
            done=jnp.asarray(False),
            metrics=Metrics(*errors, ik_error=found.error, valid=_valid(found, arm, errors[0])),
        )

    def step(self, state: EnvState, action: jax.Array) -> EnvState:
        """One control step of 20 ms.

        Args:
            action: (6,) correction of the goal in its own axes: 3 cm, 3 crad (rotation vector).
        """
        goal = _goal(state)
        with jax.named_scope("correct"):
            target = stage(self.wall, correct, goal, action)
        with jax.named_scope("ik"):
            found = ik.solve(self.model, state.arm.q, target, ik.WARM_ITERATIONS, self.wall)
        with jax.named_scope("lag"):
            lag_state, reference = lag.apply(self.delay, state.lag, found.q)
            rate = (reference - state.reference) / CONTROL_DT_S
            rate = jnp.where(state.step == 0, 0.0, rate)
        with jax.named_scope("vessels"):
            seg_a, seg_b = self._segments(state.track, state.step)
            goal = stage(self.wall, vessels.goal_in_base, seg_a, seg_b, state.goal_m, SUBSTEPS)
        with jax.named_scope("arm"):
            arm = self._simulate(state.arm, reference, rate, seg_a, SUBSTEPS)
        with jax.named_scope("observe"):
            tool = ik.tool_pose(self.model, unpack(arm.q, self.model.nq), self.wall)
            errors = stage(self.wall, observe.tracking_error, goal, tool)
            obs = observe.observe(goal, tool, errors)
        valid = state.metrics.valid & _valid(found, arm, errors[0])
        return replace(
            state,
            arm=arm,
            lag=lag_state,
            reference=reference,
            goal_rotation=_stack_matrix(goal[0]),
            goal_position=jnp.stack(goal[1]),
            step=state.step + 1,
            obs=obs,
            reward=-(errors[0] + errors[1]),
            done=state.step + 1 >= self.episode_steps,
            metrics=Metrics(*errors, ik_error=found.error, valid=valid),
        )

    def _segments(self, track: Track, step: jax.Array) -> tuple[Segment, Segment]:
        """Motion of both vessels during the control step that begins at `step` (20 ms units)."""
        now = step * SUBSTEPS
        return (
            vessels.segment(self.motion.knots_a, track.table, track.start_a + now, self.wall),
            vessels.segment(self.motion.knots_b, track.table, track.start_b + now, self.wall),
        )

    def _simulate(
        self, arm: ArmState, reference: jax.Array, rate: jax.Array, seg_a: Segment, count: int
    ) -> ArmState:
        """The engine behind one function: physics steps of 2 ms with the references held."""
        ctrl = command(self.model, reference, rate)
        # The engines advance a base at physics step i by the deck's motion at that instant.
        base_at = lambda i: vessels.base_state(seg_a, i, self.wall)  # noqa: E731
        if self.mjx_model is None:
            q, qd = chain.substeps(
                self.model, self.integrator, arm.q, arm.qd, ctrl, base_at, count, self.wall
            )
        else:
            from mcx_jax.envs import mjx_engine

            q, qd = mjx_engine.substeps(self.mjx_model, arm.q, arm.qd, ctrl, base_at, count)
        return ArmState(q=q, qd=qd)


def correct(goal: tuple[Mat, Vec], action: jax.Array) -> tuple[Mat, Vec]:
    """T_H^B = T_G^B T_H^G: the goal moved by the action (cm) and turned by it (crad)."""
    a = unpack(action, 6)
    shift = vscale(ACTION_SCALE, (a[0], a[1], a[2]))
    turn = vscale(ACTION_SCALE, (a[3], a[4], a[5]))
    return matmul(goal[0], exp_rotation(turn)), vadd(goal[1], matvec(goal[0], shift))


def command(model: ChainModel, reference: jax.Array, rate: jax.Array) -> jax.Array:
    """(nu,) actuator commands: position servos get the reference, velocity servos its rate."""
    return jnp.stack([(reference if act.bias[1] else rate)[act.joint] for act in model.actuators])


def _goal(state: EnvState) -> tuple[Mat, Vec]:
    r, p = state.goal_rotation, state.goal_position
    rows = tuple(tuple(r[i, j] for j in range(3)) for i in range(3))
    return rows, (p[0], p[1], p[2])  # type: ignore[return-value]


def _stack_matrix(m: Mat) -> jax.Array:
    return jnp.stack([jnp.stack(row) for row in m])


def _valid(found: ik.IKResult, arm: ArmState, pos_error_m: jax.Array) -> jax.Array:
    speed = norm(unpack(arm.qd, arm.qd.shape[0]))
    # A NaN fails every comparison.
    return found.ok & (pos_error_m < MAX_ERROR_M) & (speed < MAX_JOINT_SPEED_RAD_S)


def _start_pose(model: ChainModel) -> tuple[float, ...]:
    if model.nq == len(START_POSE_RAD):
        return START_POSE_RAD
    return tuple(0.5 * sum(link.q_range) if link.q_range[1] < 1e9 else 0.3 for link in model.links)


def make_env(
    config: EnvConfig, motion_config: MotionConfig, *, split: Literal["train", "test"] = "train"
) -> V2VEnv:
    """Build the task.

    Args:
        split: "train" or "test" motion; they never share waves.

    Raises:
        UserError: the arm or the motion file cannot be used.
    """
    mj = load_mujoco(config.arm)
    model = chain_model(mj, config.tool_site)
    _check_arm(config.arm, mj, model)
    integrator = model.integrator if config.integrator == "model" else config.integrator
    mjx_model = None
    if config.physics == "mjx":
        from mcx_jax.envs import mjx_engine

        mjx_model = mjx_engine.put_model(mj, integrator)
    return V2VEnv(
        motion=load_motion(motion_config, config.episode_steps, split),
        mjx_model=mjx_model,
        wall=jnp.asarray(True) if jax.default_backend() == "cpu" else None,
        model=model,
        delay=config.parsed_delay,
        integrator=integrator,
        episode_steps=config.episode_steps,
    )


def _check_arm(name: str, mj: MjModel, model: ChainModel) -> None:
    """Refuse an arm that cannot do this task."""
    if model.nq < 6:
        raise UserError(f"--arm {name}: it has {model.nq} joints; a full pose needs at least 6")
    if abs(model.timestep_s - PHYSICS_DT_S) > 1e-9:
        raise UserError(
            f"--arm {name}: its timestep is {model.timestep_s:g} s; set <option timestep="
            f'"{PHYSICS_DT_S}"/> (500 Hz physics)'
        )
    servos = [act.joint for act in model.actuators if act.bias[1]]
    if sorted(servos) != list(range(model.nq)):
        raise UserError(f"--arm {name}: every joint needs exactly one position servo actuator")
    if any(not act.bias[1] and not act.bias[2] for act in model.actuators):
        raise UserError(f"--arm {name}: torque motors are not driven here; use servo actuators")
