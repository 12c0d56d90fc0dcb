"""The task: protocol, order of a control step, vessels and goal, reward, validity, derivative."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mcx_jax.arm import chain, ik, lag, servo
from mcx_jax.arm.model import load_mujoco
from mcx_jax.config.delay import CONTROL_DT_S, PHYSICS_DT_S, SUBSTEPS
from mcx_jax.config.task import EnvConfig, MotionConfig
from mcx_jax.controllers.classical import IK, Extrapolate, Preview
from mcx_jax.envs import observe, vessels
from mcx_jax.envs.motion import LOOK_AHEAD_STEPS, draw_track, load_motion
from mcx_jax.envs.sampler import KNOT_STEPS
from mcx_jax.envs.v2v import MAX_ERROR_M, SETTLE_STEPS, correct, make_env
from mcx_jax.errors import UserError
from mcx_jax.spatial import unpack, unpack_matrix

STEPS = 12
ROWS = 128
# implicitfast chatters less: rounding is not amplified as much as by Euler.
QUIET = EnvConfig(delay="E2", integrator="implicitfast", episode_steps=STEPS)
ROUGH = MotionConfig(sea="Wd")
# Poses of 1 m in float32 through a dozen operations.
POSE_F32 = 1e-6


@pytest.fixture(scope="module")
def env():
    return make_env(QUIET, ROUGH, split="test")


@pytest.fixture(scope="module")
def reset():
    return jax.jit(lambda env, key: env.reset(key))


@pytest.fixture(scope="module")
def step():
    return jax.jit(lambda env, state, action: env.step(state, action))


@pytest.fixture(scope="module")
def batch_reset():
    return jax.jit(lambda env, keys: jax.vmap(env.reset, out_axes=-1)(keys))


@pytest.fixture(scope="module")
def keys():
    return jax.random.split(jax.random.key(3), ROWS)


@pytest.fixture(scope="module")
def starts(env, batch_reset, keys):
    """ROWS fresh episodes, batch axis last."""
    return batch_reset(env, keys)


@pytest.fixture(scope="module")
def first(env, reset, keys):
    """The fresh episode of keys[0]."""
    return reset(env, keys[0])


@pytest.fixture(scope="module")
def episode(env, step, first):
    """States 0 to STEPS of an episode with random actions, and the actions."""
    actions = np.random.default_rng(2).uniform(-0.3, 0.3, (STEPS, 6)).astype(np.float32)
    states = [first]
    for action in actions:
        states.append(step(env, states[-1], jnp.asarray(action)))
    return states, actions


def column(tree, i):
    """Row i of a batch whose axis is last."""
    return jax.tree.map(lambda x: x[..., i], tree)


def goal_of(state):
    return state.measured.pose


def assert_states_close(got, want, atol):
    got, want = (jax.tree.leaves_with_path(x) for x in (got, want))
    for (path, x), (_, y) in zip(got, want, strict=True):
        np.testing.assert_allclose(x, y, rtol=0, atol=atol, err_msg=jax.tree_util.keystr(path))


# --- protocol -----------------------------------------------------------------------------------


def test_reset_and_step_are_a_fixed_point(env):
    def kinds(tree):
        return jax.tree.map(lambda x: (x.shape, x.dtype), tree)

    fresh = jax.eval_shape(env.reset, jax.random.key(0))
    after = jax.eval_shape(env.step, fresh, jnp.zeros(6))
    assert kinds(fresh) == kinds(after)
    assert (fresh.obs.shape, fresh.reward.shape, fresh.done.shape) == ((38,), (), ())
    assert (fresh.obs.dtype, fresh.done.dtype) == (jnp.float32, jnp.bool_)
    assert (env.obs_size, env.action_size) == (38, 6)

    def body(state, action):
        state = env.step(state, action)
        return state, state.reward

    _, rewards = jax.eval_shape(lambda s: jax.lax.scan(body, s, jnp.zeros((7, 6))), fresh)
    assert rewards.shape == (7,)


def test_same_key_same_episode(env, reset, keys, first):
    again, other = reset(env, keys[0]), reset(env, keys[1])
    for x, y in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(x, y)
    assert int(other.track.start_a) != int(first.track.start_a)
    assert not np.allclose(other.goal_m, first.goal_m)


def test_vmap_equals_a_loop(env, reset, step, keys, starts):
    actions = np.random.default_rng(3).uniform(-0.3, 0.3, (6, 3)).astype(np.float32)
    few = column(starts, np.arange(3))
    stepped = jax.jit(jax.vmap(env.step, in_axes=-1, out_axes=-1))(few, jnp.asarray(actions))
    for i in range(3):
        alone = reset(env, keys[i])
        # Other fusions, other roundings: 6e-8 of 3 rad in the references times the servo's kp / kv
        # of 100/s is 2e-5 rad/s; poses to 1e-6.
        assert_states_close(column(starts, i), alone, atol=2e-5)
        assert_states_close(
            column(stepped, i), step(env, alone, jnp.asarray(actions[:, i])), atol=1e-4
        )


def test_done_exactly_at_the_last_step(episode):
    states, _ = episode
    assert [bool(s.done) for s in states] == [False] * STEPS + [True]
    assert [int(s.step) for s in states] == list(range(STEPS + 1))


# --- reset --------------------------------------------------------------------------------------


def test_goals_fill_their_box(starts):
    goals = np.asarray(starts.goal_m)
    low, high = np.array([-0.1, -0.1, 0.1]), np.array([0.1, 0.1, 0.3])  # paper
    assert np.all(goals >= low[:, None]) and np.all(goals <= high[:, None])
    # 128 uniform draws: a gap of more than 10 % at an end has a chance of 0.9^128 = 1e-6.
    assert np.all(goals.min(1) < low + 0.02) and np.all(goals.max(1) > high - 0.02)
    assert np.abs(np.corrcoef(goals)[np.triu_indices(3, 1)]).max() < 0.3  # drawn separately


def test_an_episode_begins_on_its_goal(starts):
    """Gravity alone remains: 0.3 mm typically, always below a millimetre."""
    assert np.all(np.asarray(starts.metrics.valid))
    dp, da = np.asarray(starts.metrics.pos_error_m), np.asarray(starts.metrics.ang_error_rad)
    assert dp.max() < 1e-3 and da.max() < 2e-3
    assert np.median(dp) > 1e-4, "the paper's arm has no gravity compensation: it sags"
    # 100 steps of 2 ms settle the quiet integrator.
    assert np.abs(starts.arm.qd).max() < 5e-3
    np.testing.assert_array_equal(starts.step, 0)
    assert not np.any(starts.done)


def test_the_vessels_are_still_while_the_arm_settles(env, batch_reset, keys, starts):
    """Episodes that begin on a knot: the same poses with other velocities, and nothing changes."""
    on_knot = (starts.track.start_a % KNOT_STEPS == 0) & (starts.track.start_b % KNOT_STEPS == 0)
    assert on_knot.sum() >= 2
    knots = env.motion.knots_a.at[..., 6:].multiply(3.0)
    faster = env.replace(motion=env.motion.replace(knots_a=knots, knots_b=knots))
    moved = batch_reset(faster, keys)
    np.testing.assert_array_equal(moved.arm.q[:, on_knot], starts.arm.q[:, on_knot])
    np.testing.assert_array_equal(moved.arm.qd[:, on_knot], starts.arm.qd[:, on_knot])


def test_still_is_a_constant_base(env):
    seg = vessels.segment(env.motion.knots_a, jnp.int32(0), jnp.int32(1230))
    rotation = Rotation.from_euler("ZYX", np.asarray(seg.at(0)[0])[[5, 4, 3]]).as_matrix()
    for i in (0, 57, SETTLE_STEPS):
        w, al, a = vessels.base_state(vessels.still(seg), i)
        np.testing.assert_array_equal(np.array([w, al]), np.zeros((2, 3)))
        np.testing.assert_allclose(a, rotation.T @ [0, 0, 9.81], rtol=0, atol=1e-5)


# --- vessels and goal ---------------------------------------------------------------------------


def constant_segment(pose):
    row = jnp.concatenate([jnp.asarray(pose, jnp.float32), jnp.zeros(6)])
    return vessels.Segment(row0=row, row1=row, first=jnp.int32(0))


def test_goal_in_base_by_hand():
    goal = jnp.array([0.1, 0.05, 0.2])
    level = constant_segment(np.zeros(6))
    moved = constant_segment([0.02, 0.03, -0.01, 0, 0, 0])
    # Vb's translation is NOT turned by its half turn about z, its goal is:
    # (0.65 + 0.02 - 0.1, 0.03 - 0.05, -0.01 + 0.2).
    r, p = vessels.goal_in_base(level, moved, goal, 0)
    np.testing.assert_allclose(p, [0.57, -0.02, 0.19], rtol=0, atol=POSE_F32)
    # diag(-1, -1, 1) times the goal's ((0, 1, 0), (1, 0, 0), (0, 0, -1)).
    np.testing.assert_allclose(r, [[0, -1, 0], [-1, 0, 0], [0, 0, -1]], rtol=0, atol=POSE_F32)
    # Va yawed by +90 deg and 0.1 m ahead: p = Rz(-90) (0.57 - 0.1, -0.02, 0.19) = (y, -x, z).
    turned = constant_segment([0.1, 0, 0, 0, 0, np.pi / 2])
    r, p = vessels.goal_in_base(turned, moved, goal, 0)
    np.testing.assert_allclose(p, [-0.02, -0.47, 0.19], rtol=0, atol=POSE_F32)
    np.testing.assert_allclose(r, [[-1, 0, 0], [0, 1, 0], [0, 0, -1]], rtol=0, atol=POSE_F32)
    # Vb rolls by +90 deg in its own axes: its y is world -y, so roll turns the goal's offset
    # (0.1, 0.05, 0.2) to (0.1, -0.2, 0.05), then the half turn to (-0.1, 0.2, 0.05).
    rolled = constant_segment([0, 0, 0, np.pi / 2, 0, 0])
    _, p = vessels.goal_in_base(level, rolled, goal, 0)
    np.testing.assert_allclose(p, [0.55, 0.2, 0.05], rtol=0, atol=POSE_F32)


def test_goal_rotation_is_the_papers_half_turn():
    axis = np.array([np.cos(np.pi / 4), np.sin(np.pi / 4), 0.0])
    want = Rotation.from_rotvec(np.pi * axis).as_matrix()
    np.testing.assert_allclose(vessels.GOAL_ROTATION, want, rtol=0, atol=1e-15)


def test_base_state_is_the_derivative_of_the_pose(env):
    """Angular velocity and acceleration in body axes; acceleration plus gravity in body axes."""
    h = 0.25  # physics steps: truncation (0.5 ms)^2 / 6 of a third derivative of 10: 4e-7
    dt = h * PHYSICS_DT_S
    with jax.enable_x64(True):
        knots = jnp.asarray(np.asarray(env.motion.knots_a, np.float64))
        # Angles five times those of the table, so that products of rates count.
        knots = knots * jnp.array([1, 1, 1, 5, 5, 5] * 2)

        def pose(seg, i):
            x = np.asarray(seg.at(i)[0])
            return Rotation.from_euler("ZYX", x[[5, 4, 3]]).as_matrix(), x[:3]

        def spin(seg, i):
            (before, _), (after, _) = pose(seg, i - h), pose(seg, i + h)
            return Rotation.from_matrix(before.T @ after).as_rotvec() / (2 * dt)

        for start in np.random.default_rng(4).integers(0, 1_700_000, 5):
            seg = vessels.segment(knots, jnp.int32(0), jnp.int32(start // KNOT_STEPS * KNOT_STEPS))
            for i in (5, 40):
                w, al, a = (np.array(v) for v in vessels.base_state(seg, i))
                (r, p), p_before, p_after = pose(seg, i), pose(seg, i - h)[1], pose(seg, i + h)[1]
                acc = (p_after - 2 * p + p_before) / dt**2
                alpha = (spin(seg, i + h) - spin(seg, i - h)) / (2 * dt)
                np.testing.assert_allclose(w, spin(seg, i), rtol=0, atol=2e-6)
                # 1e-16 / (2 dt)^2 = 1e-10 of rounding; truncation as above times 2 pi.
                np.testing.assert_allclose(al, alpha, rtol=0, atol=2e-5)
                # 1e-16 / dt^2 = 4e-10; a cubic has no truncation here.
                np.testing.assert_allclose(a, r.T @ (acc + [0, 0, 9.81]), rtol=0, atol=1e-7)
                assert np.abs(al).max() > 1e-2


# --- control step -------------------------------------------------------------------------------


def test_correct_by_hand():
    # The goal's x is B's z, its y is B's x, its z is B's y.
    r = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    goal = unpack_matrix(jnp.asarray(r, jnp.float32)), unpack(jnp.array([0.6, 0.1, 0.2]), 3)
    got_r, got_p = correct(goal, jnp.array([1.0, 0, 0, 0, 0, 0]))
    np.testing.assert_allclose(got_p, [0.6, 0.1, 0.21], rtol=0, atol=1e-7)  # 1 cm along its x
    np.testing.assert_array_equal(np.array(got_r), r)
    got_r, got_p = correct(goal, jnp.array([0, 0, 0, 0, 0, 1.0]))
    np.testing.assert_allclose(got_p, [0.6, 0.1, 0.2], rtol=0, atol=1e-7)
    # 1 crad about its z: R Rz(0.01); columns c x + s y and c y - s x of the goal's axes.
    c, s = np.cos(0.01), np.sin(0.01)
    want = np.stack([c * r[:, 0] + s * r[:, 1], c * r[:, 1] - s * r[:, 0], r[:, 2]], axis=1)
    np.testing.assert_allclose(np.array(got_r), want, rtol=0, atol=1e-7)


def test_the_velocity_reference_is_zero_at_the_first_step(env, step, first):
    zero = jnp.zeros(6)
    shifted = first.replace(reference=first.reference + 0.05)
    normal, same = step(env, first, zero), step(env, shifted, zero)
    np.testing.assert_array_equal(normal.arm.qd, same.arm.qd)
    later = dataclasses.replace(first, step=jnp.int32(1))
    other = step(env, later.replace(reference=first.reference + 0.05), zero)
    # -0.05 / 0.02 = -2.5 rad/s of velocity reference at kv = 1e3: at its force limit.
    assert np.abs(other.arm.qd - step(env, later, zero).arm.qd).max() > 0.01


def test_order_of_a_control_step_with_two_steps_of_delay(env, episode):
    """IK from the measured angles to the corrected goal, two steps late, then ten physics steps
    with the velocity reference, while vessel A moves; all written out again here."""
    states, actions = episode
    for i in (0, 1):  # the queue holds the first solution twice
        np.testing.assert_array_equal(states[i + 1].reference, states[0].reference)

    @jax.jit
    def expected(before, two_before, action):
        target = correct(goal_of(two_before), action)
        found = ik.solve(env.model, two_before.arm.q, target, ik.WARM_ITERATIONS)
        rate = (found.q - before.reference) / CONTROL_DT_S
        now = before.track.start_a + SUBSTEPS * before.step
        seg = vessels.segment(env.motion.knots_a, before.track.table, now)
        return found.q, chain.substeps(
            env.model,
            env.integrator,
            before.arm.q,
            before.arm.qd,
            servo.commands(env.model, found.q, rate),
            lambda k: vessels.base_state(seg, k),
            SUBSTEPS,
        )

    for i in (2, 3, 7):
        reference, (q, qd) = expected(states[i], states[i - 2], jnp.asarray(actions[i - 2]))
        # As vmap against a loop: roundings of other fusions.
        np.testing.assert_allclose(states[i + 1].reference, reference, rtol=0, atol=2e-6)
        np.testing.assert_allclose(states[i + 1].arm.q, q, rtol=0, atol=2e-6)
        np.testing.assert_allclose(states[i + 1].arm.qd, qd, rtol=0, atol=2e-4)
        assert np.abs(reference - states[i].reference).max() > 1e-4


def test_errors_observation_and_reward_agree_with_c(env, episode):
    """At the end of a step: tool by C MuJoCo, goal by scipy from the vessels' tables."""
    mj = load_mujoco("paper")
    where = observe.slices()
    for i in (0, 1, 5, STEPS):
        state = episode[0][i]
        d = mujoco.MjData(mj)
        d.qpos[:] = state.arm.q
        mujoco.mj_kinematics(mj, d)
        site = mj.site("tool").id
        tool_r, tool_p = d.site_xmat[site].reshape(3, 3), d.site_xpos[site]
        goal_r, goal_p = np_goal(env, state, SUBSTEPS * i)
        np.testing.assert_allclose(state.measured.rotation, goal_r, rtol=0, atol=POSE_F32)
        np.testing.assert_allclose(state.measured.position, goal_p, rtol=0, atol=POSE_F32)
        dp = np.linalg.norm(goal_p - tool_p)
        da = Rotation.from_matrix(goal_r.T @ tool_r).magnitude()
        # Differences of poses that float32 carries to 1e-6.
        assert float(state.metrics.pos_error_m) == pytest.approx(dp, abs=3e-6)
        assert float(state.metrics.ang_error_rad) == pytest.approx(da, abs=3e-6)
        assert float(state.reward) == pytest.approx(-(dp + da), abs=6e-6)
        obs = np.asarray(state.obs)
        np.testing.assert_allclose(obs[where["p_B_E"]], tool_p, rtol=0, atol=3e-6)
        np.testing.assert_allclose(obs[where["R_B_G"]], goal_r.ravel(), rtol=0, atol=POSE_F32)
        np.testing.assert_allclose(obs[where["p_EG_B"]], goal_p - tool_p, rtol=0, atol=3e-6)
        assert obs[where["dp"]][0] == state.metrics.pos_error_m


def np_goal(env, state, physics_step):
    """T_G^B from the table's knots: scipy's Hermite spline and rotations, float64."""
    from scipy.interpolate import CubicHermiteSpline

    table = np.asarray(env.motion.knots_a[int(state.track.table)], np.float64)

    def pose(start):
        row, rest = divmod(int(start) + physics_step, KNOT_STEPS)
        rows = table[row : row + 2]
        x = CubicHermiteSpline([0, 0.1], rows[:, :6], rows[:, 6:])(rest * PHYSICS_DT_S)
        return Rotation.from_euler("ZYX", x[[5, 4, 3]]).as_matrix(), x[:3]

    (r_a, p_a), (r_b, p_b) = pose(state.track.start_a), pose(state.track.start_b)
    r_b = np.diag([-1.0, -1.0, 1.0]) @ r_b
    p = p_b + [0.65, 0, 0] + r_b @ np.asarray(state.goal_m, np.float64)
    return r_a.T @ r_b @ np.array(vessels.GOAL_ROTATION), r_a.T @ (p - p_a)


def test_validity_is_sticky(env, step, first):
    good = step(env, first, jnp.zeros(6))
    assert bool(good.metrics.valid)
    far = first.measured.replace(position=first.measured.position + 3.0)  # no IK solution
    lost = step(env, first.replace(measured=far), jnp.zeros(6))
    assert not bool(lost.metrics.valid) and np.isfinite(float(lost.reward))
    back = first.replace(metrics=first.metrics.replace(valid=jnp.asarray(False)))
    after = step(env, back, jnp.zeros(6))
    assert not bool(after.metrics.valid)
    assert float(after.metrics.ik_error) < ik.TOLERANCE


def test_nan_and_divergence_are_invalid(env, step, first):
    broken = step(env, first, jnp.asarray(np.full(6, np.nan, np.float32)))
    assert not bool(broken.metrics.valid)
    arm = first.arm.replace(qd=first.arm.qd.at[0].set(jnp.nan))
    assert not bool(step(env, first.replace(arm=arm), jnp.zeros(6)).metrics.valid)
    # The IK succeeds, but the arm stands elsewhere: its shoulder turned by 1.5 rad, 0.6 m off.
    arm = first.arm.replace(q=first.arm.q.at[0].add(1.5))
    away = step(env, first.replace(arm=arm), jnp.zeros(6))
    assert float(away.metrics.pos_error_m) > MAX_ERROR_M and not bool(away.metrics.valid)


# --- derivative ---------------------------------------------------------------------------------


def in_float64(tree):
    def convert(x):
        if isinstance(x, jax.Array) and x.dtype == jnp.float32:
            return jnp.asarray(np.asarray(x, np.float64))
        return x

    return jax.tree.map(convert, tree)


def test_whole_batches_are_the_same_task(env):
    """The faster way of tracing under vmap; its derivative: tests/test_batch_last.py."""
    keys = jax.random.split(jax.random.key(8), 3)

    @jax.jit
    def run(env, keys, action):
        state = jax.vmap(env.reset, out_axes=-1)(keys)
        step = jax.vmap(env.step, in_axes=(-1, -1), out_axes=-1)
        return step(state, action)

    env = env.replace(integrator="quiet")  # no chatter, which magnifies rounding
    action = 0.01 * jax.random.normal(jax.random.key(1), (6, 3))
    plain, whole = (run(env.replace(whole_batches=w), keys, action) for w in (False, True))
    # The same operations in another program: rounding of poses of 1 m.
    for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(whole), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=2e-6)


def test_gradient_of_the_reward_by_the_action(env, first):
    """Reverse mode through correction, IK, servo and ten physics steps against differences."""
    # The first step of an episode starts settled: with corrections of 0.1 mm no servo saturates
    # (the weakest: 56 N m / 1e5 N m/rad = 0.56 mrad). No delay, or the reward would not answer.
    with jax.enable_x64(True):
        env64 = in_float64(env.with_delay("E0"))
        state = in_float64(first)
        state = state.replace(lag=lag.init_all(env64.delays, state.reference))

        def reward(action):
            return env64.step(state, action).reward

        slope = jax.jit(jax.value_and_grad(reward))
        action = jnp.array([0.01, -0.005, 0.008, 0.006, -0.01, 0.004])
        got = slope(action)[1]
        h = 1e-4
        want = [(slope(action + h * e)[0] - slope(action - h * e)[0]) / (2 * h) for e in jnp.eye(6)]
    # Rewards per cm are 1e-3 to 1e-2; truncation h^2 (1e-6 m)^2 over errors of 1e-3 m: 1e-9;
    # rounding 1e-15 / h = 1e-11, the IK's 1e-12 rad the same.
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-8)
    assert np.all(np.abs(want) > 1e-5), want


# --- controllers --------------------------------------------------------------------------------


def assert_aims_at(state, action, want):
    r, p = correct(goal_of(state), action)
    # Through a correction in centimetres and back.
    np.testing.assert_allclose(np.array(p), np.array(want[1]), rtol=0, atol=2e-6)
    np.testing.assert_allclose(np.array(r), np.array(want[0]), rtol=0, atol=2e-6)


def test_preview_aims_at_the_true_future(env, episode):
    states, _ = episode
    for i in (0, 3):
        _, action = Preview(lead_s=0.020).act(env, states[i], ())
        assert_aims_at(states[i], action, goal_of(states[i + 1]))
        # By default two steps of delay and half of the hold: 50 ms, 25 physics steps.
        _, action = Preview().act(env, states[i], ())
        assert_aims_at(states[i], action, np_goal(env, states[i], SUBSTEPS * i + 25))
        assert np.abs(action).max() > 0.01


def test_extrapolation_of_a_steady_motion(env, first):
    memory = Extrapolate().init(env, first)
    np.testing.assert_array_equal(Extrapolate().act(env, first, memory)[1], np.zeros(6))
    # The goal has moved by (1, 2, -1) mm and turned by 2 mrad about B's z within 20 ms: 50 ms
    # ahead it has gone on by 2.5 times that.
    r, p = np.asarray(first.measured.rotation), np.asarray(first.measured.position)
    move, turn = np.array([1e-3, 2e-3, -1e-3]), np.array([0, 0, 2e-3])
    measured = first.measured.replace(
        rotation=jnp.asarray(np.float32(Rotation.from_rotvec(turn).as_matrix() @ r)),
        position=jnp.asarray(np.float32(p + move)),
    )
    now = first.replace(measured=measured)
    memory, action = Extrapolate().act(env, now, memory)
    ahead = Rotation.from_rotvec(3.5 * turn).as_matrix() @ r, p + 3.5 * move
    assert_aims_at(now, action, ahead)
    np.testing.assert_array_equal(memory[1], now.measured.position)


def test_ik_controller_does_nothing(env, first):
    assert IK().act(env, first, ()) == ((), pytest.approx(np.zeros(6)))


# --- kinds of motion ----------------------------------------------------------------------------


def track(motion, uniform, sea=None):
    return draw_track(motion, jnp.asarray(uniform, jnp.float32), sea)


def test_windows_stay_within_the_table(env):
    """With the look-ahead, from the smallest to the largest uniform number of float32."""
    top = 1 - 2.0**-24
    early, late = track(env.motion, [0.0] * 4), track(env.motion, [top] * 4)
    assert (int(early.start_a), int(early.table)) == (0, 0)
    rows = env.motion.knots_a.shape[1]
    last_step = int(late.start_a) + SUBSTEPS * (STEPS + LOOK_AHEAD_STEPS)
    assert last_step // KNOT_STEPS + 1 <= rows - 1  # the segment's second knot
    assert last_step > (rows - 2) * KNOT_STEPS - 2 * SUBSTEPS  # and nothing is left unused
    assert int(late.start_a) % SUBSTEPS == 0
    apart = track(env.motion, [0.5, 0.5, 0.2, 0.7])
    assert int(apart.start_a) != int(apart.start_b)


@pytest.mark.parametrize("split", ["train", "test"])
def test_paper_split_uses_one_hour(split):
    motion = load_motion(MotionConfig(sea="Wa", split="paper"), 100, split)
    assert (motion.seas, motion.seeds, motion.knots_a.shape[0]) == (("Wa",), 1, 1)
    # Two thirds of 36,000 knots; or one third less 20 s (200 knots) at both ends.
    assert motion.knots_a.shape[1] - 1 == {"train": 24_000, "test": 11_600}[split]


def test_coupled_vessels_share_one_window():
    motion = load_motion(MotionConfig(sea="Wd", coupled=True), 100, "test")
    both = track(motion, [0.1, 0.2, 0.3, 0.9])
    assert int(both.start_a) == int(both.start_b)
    assert motion.knots_b is not motion.knots_a
    r, p = vessels.goal_pose(motion, both, jnp.array([0.0, 0.0, 0.2]), jnp.int32(0))
    assert np.all(np.isfinite(np.array(p))) and np.all(np.isfinite(np.array(r)))
    # One wave field at 0.65 m: the vessels' heave is alike, yet not the same.
    a, b = np.asarray(motion.knots_a[0, :, 2]), np.asarray(motion.knots_b[0, :, 2])
    assert 0.1 < np.corrcoef(a, b)[0, 1] < 0.999


def test_coupled_seas_among_others():
    """Only they share a window, and a wave field that vessel B meets later."""
    mixed = load_motion(MotionConfig(sea="Wd,Wd-coupled"), 100, "test")
    alone = load_motion(MotionConfig(sea="Wd", coupled=True), 100, "test")
    assert mixed.seas == ("Wd", "Wd-coupled") and mixed.coupled == (False, True)
    np.testing.assert_array_equal(mixed.knots_b[0], mixed.knots_a[0])
    np.testing.assert_array_equal(mixed.knots_b[1], alone.knots_b[0])
    np.testing.assert_array_equal(mixed.knots_a[1], alone.knots_a[0])
    starts = [track(mixed, [sea, 0.2, 0.3, 0.9]) for sea in (0.1, 0.6)]
    assert [int(t.table) for t in starts] == [0, 1]
    assert [int(t.start_a) == int(t.start_b) for t in starts] == [False, True]
    assert int(starts[0].start_a) == int(starts[1].start_a)


def test_literal_sea_and_sea_of_all():
    literal = load_motion(MotionConfig(sea="1.5:8"), 100, "test")
    named = load_motion(MotionConfig(sea="all"), 100, "test")
    assert named.seas == ("Wa", "Wb", "Wc", "Wd") and len(literal.seas) == 1
    # Wb is 1.5 m, 8 s.
    np.testing.assert_array_equal(literal.knots_a[0], named.knots_a[1])
    # Sea and seed of a window: uniform numbers times four seas; a given sea is kept.
    assert [int(track(named, [u, 0, 0, 0]).table) for u in (0.0, 0.3, 0.6, 0.99)] == [0, 1, 2, 3]
    assert int(track(named, [0.0, 0, 0, 0], sea=2).table) == 2


def test_tables_are_ordered_by_sea_then_seed():
    motion = load_motion(MotionConfig(sea="all"), 100, "train")
    assert motion.knots_a.shape[0] == 4 * motion.seeds == 32
    # Sea 2, seed floor(0.4 * 8) = 3: row 2 * 8 + 3.
    assert int(track(motion, [0.5, 0.4, 0, 0]).table) == 19
    heave = np.asarray(motion.knots_a[:, :, 2]).std(axis=1).reshape(4, 8)
    assert np.all(np.diff(heave.mean(1)) > 0)  # Wa is the calmest
    assert heave.std(1).max() < 0.2 * heave.mean()


@pytest.mark.parametrize("sea", ["We", "", "1.5", "1.5:", "0:8", "-1:8", "1.5:nan"])
def test_unknown_seas_are_refused(sea):
    with pytest.raises(UserError, match="sea"):
        load_motion(MotionConfig(sea=sea), 100, "test")


def test_an_episode_longer_than_the_motion_is_refused(tmp_path):
    t = np.arange(0, 130, 0.05)
    path = tmp_path / "short.npy"
    np.save(path, np.column_stack([t, *(0.01 * np.sin(t + k) for k in range(6))]))
    with pytest.raises(UserError, match="--episode-steps 5000: an episode of 100 s and 2 s of"):
        load_motion(MotionConfig(motion=str(path)), 5000, "test")


def test_a_recording_drives_the_task(tmp_path):
    """A vessel that heaves by 20 mm in 4 s and nothing else, in the authors' units."""
    t = np.arange(0, 200, 0.01)
    data = np.zeros((len(t), 7))
    data[:, 0], data[:, 3] = t, 20.0 * np.sin(2 * np.pi * t / 4)
    path = tmp_path / "heave.npy"
    np.save(path, data)
    config = MotionConfig(motion=str(path), motion_length_unit="mm", motion_angle_unit="deg")
    env = make_env(QUIET, config, split="train")
    assert env.motion.seas == ("motion",)
    # An hour's window: A at its crest (t = 1 s), B in its trough (3 s): 40 mm apart.
    window = dataclasses.replace(
        track(env.motion, [0.0] * 4), start_a=jnp.int32(500), start_b=jnp.int32(1500)
    )
    r, p = vessels.goal_pose(env.motion, window, jnp.array([0.0, 0.0, 0.2]), jnp.int32(0))
    np.testing.assert_allclose(p, [0.65, 0.0, 0.16], rtol=0, atol=5e-6)
    np.testing.assert_allclose(r, [[0, -1, 0], [-1, 0, 0], [0, 0, -1]], rtol=0, atol=1e-6)


# --- arms that cannot do the task ---------------------------------------------------------------

ARM = """<mujoco><compiler angle="radian"/><option timestep="{dt}" gravity="{gravity}"/>
<worldbody>{bodies}<site name="tool"/>{close}</worldbody>
<actuator>{actuators}</actuator></mujoco>"""


def arm_file(
    tmp_path, joints=6, dt="0.002", servo="position", count=None, gravity="0 0 -9.81", more=""
):
    body = "<body pos='0 0 .2'><joint name='j{}' axis='{}'/><geom size='.03' contype='0'"
    bodies = "".join(
        (body + " conaffinity='0'/>").format(i, "0 0 1" if i % 2 else "0 1 0")
        for i in range(joints)
    )
    count = joints if count is None else count
    path = tmp_path / "arm.xml"
    path.write_text(
        ARM.format(
            dt=dt,
            gravity=gravity,
            bodies=bodies,
            close="</body>" * joints,
            actuators="".join(f"<{servo} joint='j{i}' {more}/>" for i in range(count)),
        )
    )
    return str(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"joints": 5}, "it has 5 joints; a full pose needs at least 6"),
        (
            {"dt": "0.001"},
            'its timestep is 0.001 s; set <option timestep="0.002"/> (500 Hz physics)',
        ),
        ({"count": 5}, "every joint needs exactly one position servo actuator"),
        ({"servo": "motor"}, "every joint needs exactly one position servo actuator"),
        (
            {"more": "gear='2'"},
            "a servo would not settle where it is told; use <position> and <velocity> actuators "
            "without gear",
        ),
        (
            {"servo": "general", "more": "gainprm='1' biastype='affine' biasprm='0 -9 0'"},
            "a servo would not settle where it is told; use <position> and <velocity> actuators "
            "without gear",
        ),
        (
            {"gravity": "0 0 -1.62"},
            "its gravity is 0 0 -1.62; at sea it is 0 0 -9.81 in the frame of the base, leave it "
            "out of the file",
        ),
    ],
)
def test_arms_that_cannot_do_the_task_are_refused(tmp_path, change, message):
    path = arm_file(tmp_path, **change)
    with pytest.raises(UserError) as error:
        make_env(EnvConfig(arm=path), ROUGH)
    assert str(error.value) == f"--arm {path}: {message}"


def test_an_arm_without_the_tool_site_is_refused(tmp_path):
    with pytest.raises(UserError, match="--tool-site flange: the arm model's sites are: tool"):
        make_env(EnvConfig(arm=arm_file(tmp_path), tool_site="flange"), ROUGH)


def test_what_the_arm_cannot_do_is_seen(env, first):
    """120 deg/s, 2.09 rad/s, is what the shoulder's servo takes, 42 mrad in a control step."""

    def strain(shift_rad, ik_error, before=first):
        reference = before.reference.at[1].add(shift_rad)
        metrics = dataclasses.replace(before.metrics, ik_error=jnp.float32(ik_error))
        after = dataclasses.replace(before, reference=reference, metrics=metrics)
        return tuple(bool(x) for x in env.strain(before, after))

    moving = dataclasses.replace(first, step=jnp.int32(1))
    assert strain(0.0, 1e-6, moving) == (False, False)
    assert strain(0.041, 0.9e-4, moving) == (False, False)
    assert strain(-0.043, 1.1e-4, moving) == (True, True)
    assert strain(0.0, np.nan, moving) == (True, False)
    assert strain(0.043, 0.0) == (False, False)  # the first step has no rate (authors' code)
