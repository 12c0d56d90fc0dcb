"""The vessel-to-vessel task, ONE episode: `reset(key) -> state`, `step(state, action) -> state`.

Pure, jittable, vmappable, differentiable. `vmap` it with the batch axis last
(`in_axes=-1, out_axes=-1`): the physics then works on contiguous rows of environments.
"""

from dataclasses import replace
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import struct

from mcx_jax.arm import chain, ik, lag, servo
from mcx_jax.arm.load import load_arm, start_pose
from mcx_jax.arm.model import ChainModel
from mcx_jax.compute.batch_last import batch_last
from mcx_jax.compute.fusion import stage
from mcx_jax.config.delay import CONTROL_DT_S, SUBSTEPS, Delay
from mcx_jax.config.task import EnvConfig, MotionConfig
from mcx_jax.envs import conditions, observe, vessels
from mcx_jax.envs.conditions import Conditions, Measurement
from mcx_jax.envs.goal_path import GoalPath, load_goal_path
from mcx_jax.envs.motion import Motion, Track, draw_track, load_motion
from mcx_jax.envs.state import ArmState, EnvState, Metrics
from mcx_jax.envs.vessels import Segment
from mcx_jax.spatial import Mat, Vec, exp_rotation, matmul, matvec, norm, unpack, vadd, vscale

SETTLE_STEPS = 100
"""Physics steps with the vessels held still before an episode (authors' code)."""
ACTION_SCALE = 0.01
"""Actions are centimetres and centiradians (paper)."""
MAX_ERROR_M = 0.5
"""An episode whose tool is farther than this from the goal counts as invalid from then on."""
MAX_JOINT_SPEED_RAD_S = 100.0
"""Beyond this the simulation has diverged; counts as invalid."""


@struct.dataclass
class V2VEnv:
    """The task's constants. Pass it through jit as an argument: it holds the tables of motion."""

    motion: Motion
    mjx_model: Any
    """mjx.Model for --physics mjx, else None."""
    wall: jax.Array | None
    """() bool, true: keeps XLA on a CPU from recomputing stages (`compute.fusion`); GPU: None."""
    model: ChainModel = struct.field(pytree_node=False)
    config: EnvConfig = struct.field(pytree_node=False)
    known_delay: Delay = struct.field(pytree_node=False)
    """What a controller without learning believes the delay to be."""
    integrator: str = struct.field(pytree_node=False)
    """euler, implicitfast, quiet or mixed; the ending -smooth changes the chain engine's derivative
    (`chain.joint_accelerations`)."""
    goal_path: GoalPath | None = None
    """None: the goal stays where it is drawn."""
    whole_batches: bool = struct.field(pytree_node=False, default=False)
    """Traces faster under vmap, but can be differentiated outside it only (`batch_last`)."""

    @property
    def delays(self) -> tuple[Delay, ...]:
        """An episode has one of them."""
        return self.config.delays

    def with_delay(self, delay: str) -> "V2VEnv":
        """The same task with another `--delay`, which controllers without learning know."""
        config = replace(self.config, delay=delay)
        return replace(self, config=config, known_delay=config.delays[0])

    @property
    def episode_steps(self) -> int:
        """Control steps of an episode."""
        return self.config.episode_steps

    @property
    def obs_size(self) -> int:
        """Length of the observation."""
        return observe.OBS_SIZE + (1 if self.config.conditions.late_sensor else 0)

    @property
    def action_size(self) -> int:
        """Length of the action: 3 translation (cm), 3 rotation (crad)."""
        return 6

    def draw(
        self, key: jax.Array, sea: jax.Array | int | None = None
    ) -> tuple[Track, jax.Array, Conditions]:
        """What is random in an episode: windows of motion, place of the goal, (3,) m, conditions.

        Args:
            sea: index into motion.seas; None draws one.
        """
        uniform = jax.random.uniform(key, (7,))
        track = draw_track(self.motion, uniform[:4], sea)
        path_steps = self.goal_path.period_steps if self.goal_path else 0
        drawn = conditions.draw(self.config, key, path_steps)
        return track, vessels.draw_goal(uniform[4:]), drawn

    def reset(
        self,
        key: jax.Array,
        sea: jax.Array | int | None = None,
        given: Conditions | None = None,
    ) -> EnvState:
        """A new episode: random windows and goal, arm settled on the goal, vessels still.

        Args:
            sea: index into motion.seas; None draws one.
            given: in place of the conditions that `draw` finds.
        """
        track, goal_m, drawn = self.draw(key, sea)
        drawn = drawn if given is None else given
        with jax.named_scope("vessels"):
            seg_a, seg_b = self._segments(track, jnp.int32(0))
            place = self.goal_on_deck(goal_m, drawn, jnp.int32(0))
            goal = self._goal(seg_a, seg_b, place, 0)
            measured = conditions.first_measurement(drawn, self.config, goal)
        with jax.named_scope("ik"):
            start = jnp.asarray(start_pose(self.model), goal_m.dtype)
            found = self._solve(start, goal, ik.COLD_ITERATIONS)
        with jax.named_scope("settle"):
            arm = ArmState(q=found.q, qd=jnp.zeros_like(found.q))
            still = vessels.still(seg_a)
            rest = jnp.zeros_like(found.q)
            arm = self._simulate(arm, found.q, rest, still, SETTLE_STEPS, drawn)
        errors, obs = self._observe(arm, goal, measured, drawn)
        return EnvState(
            arm=arm,
            lag=lag.init_all(self.delays, found.q),
            reference=found.q,
            track=track,
            goal_m=goal_m,
            conditions=drawn,
            measured=measured,
            step=jnp.int32(0),
            obs=obs,
            reward=-(errors[0] + errors[1]),
            done=jnp.asarray(False),
            metrics=Metrics(*errors, ik_error=found.error, valid=_valid(found, arm, errors[0])),
        )

    def step(self, state: EnvState, action: jax.Array) -> EnvState:
        """One control step of 20 ms.

        Args:
            action: (6,) correction of the goal in its own axes: 3 cm, 3 crad (rotation vector);
                bounded by --max-correction.
        """
        drawn = state.conditions
        with jax.named_scope("correct"):
            target = self._whole(_corrected, state.measured, self.bounded(action))
        with jax.named_scope("ik"):
            found = self._solve(state.arm.q, target, ik.WARM_ITERATIONS)
        with jax.named_scope("lag"):
            lag_state, reference = lag.apply_one(self.delays, drawn.delay, state.lag, found.q)
            rate = _rate(state, reference)
        with jax.named_scope("vessels"):
            seg_a, seg_b = self._segments(state.track, state.step)
            place = self.goal_on_deck(state.goal_m, drawn, (state.step + 1) * SUBSTEPS)
            goal = self._goal(seg_a, seg_b, place, SUBSTEPS)
        with jax.named_scope("arm"):
            arm = self._simulate(state.arm, reference, rate, seg_a, SUBSTEPS, drawn)
        with jax.named_scope("observe"):
            measured = conditions.measure(drawn, state.measured.queue, goal, state.step + 1)
            errors, obs = self._observe(arm, goal, measured, drawn)
        valid = state.metrics.valid & _valid(found, arm, errors[0])
        return replace(
            state,
            arm=arm,
            lag=lag_state,
            reference=reference,
            measured=measured,
            step=state.step + 1,
            obs=obs,
            reward=-(errors[0] + errors[1]),
            done=state.step + 1 >= self.episode_steps,
            metrics=Metrics(*errors, ik_error=found.error, valid=valid),
        )

    def bounded(self, action: jax.Array) -> jax.Array:
        """The correction that `step` makes of an action: each component within --max-correction."""
        return jnp.clip(action, -self.config.max_correction, self.config.max_correction)

    def goal_on_deck(self, goal_m: jax.Array, drawn: Conditions, step: jax.Array) -> jax.Array:
        """(3,) place of the goal on vessel B, m, at a physics step of the episode."""
        if self.goal_path is None or drawn.path_start is None:
            return goal_m
        return goal_m + self.goal_path.at(drawn.path_start + step)

    def goal_at(
        self, track: Track, goal_m: jax.Array, drawn: Conditions, step: jax.Array
    ) -> tuple[Mat, Vec]:
        """The TRUE pose T_G^B at a physics step of an episode."""
        place = self.goal_on_deck(goal_m, drawn, step)
        return vessels.goal_pose(self.motion, track, place, step, self.wall)

    def goal_ahead(self, state: EnvState, steps: jax.Array | int) -> tuple[Mat, Vec]:
        """The TRUE pose T_G^B a number of physics steps after now."""
        step = state.step * SUBSTEPS + steps
        return self.goal_at(state.track, state.goal_m, state.conditions, step)

    def joint_torques(self, before: EnvState, after: EnvState) -> jax.Array:
        """(nq,) torques of the servos at the end of the control step between two states, N m."""
        rate = _rate(before, after.reference)
        ctrl = servo.commands(self.model, after.reference, rate)
        angles, rates = unpack(after.arm.q, self.model.nq), unpack(after.arm.qd, self.model.nq)
        commands = unpack(ctrl, len(self.model.actuators))
        return jnp.stack(chain.actuate(self.model, angles, rates, commands)[0])

    def strain(self, before: EnvState, after: EnvState) -> tuple[jax.Array, jax.Array]:
        """Whether the control step between two states asked the arm for what it cannot do: () bool,
        the corrected goal is out of its reach (the IK does not get there); () bool, a joint has to
        be faster than its velocity servo takes."""
        lost = servo.lost_lead(self.model, _rate(before, after.reference))
        return ~(after.metrics.ik_error < ik.TOLERANCE), jnp.any(lost != 0.0)

    def _observe(
        self, arm: ArmState, goal: tuple[Mat, Vec], measured: Measurement, drawn: Conditions
    ):
        """True errors (dp m, da rad), and the observation, made of what is measured."""
        perfect = not self.config.conditions.imperfect_sensor

        def look(wall, q, goal, measured):
            tool = ik.tool_pose(self.model, unpack(q, self.model.nq), wall)
            errors = stage(wall, observe.tracking_error, goal, tool)
            if perfect:
                return errors, observe.observe(goal, tool, errors)
            seen = stage(wall, observe.tracking_error, measured.pose, tool)
            return errors, observe.observe(measured.pose, tool, seen)

        errors, obs = self._whole(look, arm.q, goal, measured)
        if drawn.latency is not None:
            obs = jnp.append(obs, drawn.age_s)
        return errors, obs

    def _whole(self, f, *args):
        """f(wall, *args), on whole batches where asked."""
        return (batch_last(f) if self.whole_batches else f)(self.wall, *args)

    def _goal(self, seg_a: Segment, seg_b: Segment, place: jax.Array, i: int) -> tuple[Mat, Vec]:
        """True T_G^B at physics step i of a control step."""

        def pose(wall, seg_a, seg_b, place):
            return stage(wall, vessels.goal_in_base, seg_a, seg_b, place, i)

        return self._whole(pose, seg_a, seg_b, place)

    def _solve(self, start: jax.Array, target: tuple[Mat, Vec], iterations: int) -> ik.IKResult:
        """Joint angles that bring the tool to a pose; the branch next to `start`."""

        def solve(wall, start, target):
            return ik.solve(self.model, start, target, iterations, wall)

        return self._whole(solve, start, target)

    def _segments(self, track: Track, step: jax.Array) -> tuple[Segment, Segment]:
        """Motion of both vessels during the control step that begins at `step` (20 ms units)."""
        now = step * SUBSTEPS
        return (
            vessels.segment(self.motion.knots_a, track.table, track.start_a + now, self.wall),
            vessels.segment(self.motion.knots_b, track.table, track.start_b + now, self.wall),
        )

    def _simulate(
        self,
        arm: ArmState,
        reference: jax.Array,
        rate: jax.Array,
        seg_a: Segment,
        count: int,
        drawn: Conditions,
    ) -> ArmState:
        """Advance the arm by `count` physics steps of 2 ms, references held, by either engine."""
        ctrl = servo.commands(self.model, reference, rate)
        # The engines advance a base at physics step i by the deck's motion at that instant.
        if self.mjx_model is None:

            def simulate(wall, q, qd, ctrl, seg_a, plant):
                base_at = lambda i: vessels.base_state(seg_a, i, wall)  # noqa: E731
                system = self.model, self.integrator
                return chain.substeps(*system, q, qd, ctrl, base_at, count, wall, plant)

            q, qd = self._whole(simulate, arm.q, arm.qd, ctrl, seg_a, drawn.plant)
        else:
            from mcx_jax.arm import mjx_engine

            base_at = lambda i: vessels.base_state(seg_a, i, self.wall)  # noqa: E731
            advance = partial(mjx_engine.substeps, self.mjx_model, integrator=self.integrator)
            q, qd = advance(arm.q, arm.qd, ctrl, base_at, count)
        return ArmState(q=q, qd=qd)


def _rate(before: EnvState, reference: jax.Array) -> jax.Array:
    """(nq,) finite difference of the late reference, rad/s; 0 in the first step (authors' code)."""
    rate = (reference - before.reference) / CONTROL_DT_S
    return jnp.where(before.step == 0, 0.0, rate)


def _corrected(wall: jax.Array | None, measured: Measurement, action: jax.Array):
    return stage(wall, correct, measured.pose, action)


def correct(goal: tuple[Mat, Vec], action: jax.Array) -> tuple[Mat, Vec]:
    """T_H^B = T_G^B T_H^G: the goal moved by the action (cm) and turned by it (crad)."""
    a = unpack(action, 6)
    shift = vscale(ACTION_SCALE, (a[0], a[1], a[2]))
    turn = vscale(ACTION_SCALE, (a[3], a[4], a[5]))
    return matmul(goal[0], exp_rotation(turn)), vadd(goal[1], matvec(goal[0], shift))


def _valid(found: ik.IKResult, arm: ArmState, pos_error_m: jax.Array) -> jax.Array:
    speed = norm(unpack(arm.qd, arm.qd.shape[0]))
    # A NaN fails every comparison.
    return found.ok & (pos_error_m < MAX_ERROR_M) & (speed < MAX_JOINT_SPEED_RAD_S)


def make_env(
    config: EnvConfig, motion_config: MotionConfig, *, split: Literal["train", "test"] = "train"
) -> V2VEnv:
    """Build the task.

    Args:
        split: "train" or "test" motion; they never share waves.

    Raises:
        UserError: the arm or the motion file cannot be used.
    """
    mj, model = load_arm(config.arm, config.tool_site)
    integrator = model.integrator if config.integrator == "model" else config.integrator
    mjx_model = None
    if config.physics == "mjx":
        from mcx_jax.arm import mjx_engine

        mjx_model = mjx_engine.put_model(mj, integrator)
    return V2VEnv(
        motion=load_motion(motion_config, config.episode_steps, split),
        mjx_model=mjx_model,
        wall=jnp.asarray(True) if jax.default_backend() == "cpu" else None,
        model=model,
        config=config,
        known_delay=config.delays[0],
        integrator=integrator,
        goal_path=load_goal_path(config.goal),
    )
