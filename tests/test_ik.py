"""Kinematics against C MuJoCo and dm_control; failure as data; the implicit derivative."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from dm_control import mujoco as dm_mujoco
from dm_control.utils.inverse_kinematics import qpos_from_site_pose
from moving_base import arm_path
from scipy.spatial.transform import Rotation

from mcx_jax.arm import ik
from mcx_jax.arm.load import START_POSE_RAD
from mcx_jax.arm.model import chain_model, load_mujoco
from mcx_jax.envs import vessels
from mcx_jax.spatial import exp_rotation, matmul, unpack, unpack_matrix, vadd

START = np.array(START_POSE_RAD)
REST = np.array(vessels.REST_B) @ np.array(vessels.GOAL_ROTATION)
# Two float64 evaluations of the same pose differ by some roundings of 1 m.
F64 = 1e-12
# float32: six rotations and 1 m of arm, each rounded at 6e-8.
F32 = 2e-6
ROWS = 64
# The mission's promise; both stop at errors below 1e-9 here.
DM_CONTROL_RAD = 1e-5


def random_goals(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3, 3), (n, 3) goals in B as the roughest sea gives them: the goal's box, 0.1 m of
    relative motion and 0.15 rad about each axis."""
    rng = np.random.default_rng(seed)
    box = rng.uniform(vessels.GOAL_LOW_M, vessels.GOAL_HIGH_M, (count, 3)) * [-1, -1, 1]
    p = np.array(vessels.REST_B_M) + box + rng.uniform(-0.1, 0.1, (count, 3))
    tilt = Rotation.from_euler("ZYX", rng.uniform(-0.15, 0.15, (count, 3))).as_matrix()
    return tilt @ REST, p


@pytest.fixture(scope="module")
def model():
    return chain_model(load_mujoco("paper"), "tool")


@functools.cache
def compiled(arm_model, iterations):
    def one(q, r, p):
        return ik.solve(arm_model, q, (unpack_matrix(r), unpack(p, 3)), iterations)

    return jax.jit(jax.vmap(one))


@functools.cache
def compiled_pose(arm_model):
    def one(q):
        r, p = ik.tool_pose(arm_model, unpack(q, arm_model.nq))
        return jnp.stack([jnp.stack(row) for row in r]), jnp.stack(p)

    return jax.jit(jax.vmap(one))


def solve(arm_model, q, r, p, iterations=ik.COLD_ITERATIONS):
    """Solutions of n goals; padded to ROWS, so that all tests share a compilation."""
    n = len(p)
    q = np.broadcast_to(q, (n, arm_model.nq))
    rows = [jnp.asarray(x)[np.arange(ROWS) * (np.arange(ROWS) < n)] for x in (q, r, p)]
    found = compiled(arm_model, iterations)(*rows)
    return jax.tree.map(lambda x: np.asarray(x)[:n], found)


def c_pose(mj, q):
    """Tool pose by C MuJoCo."""
    d = mujoco.MjData(mj)
    d.qpos[:] = q
    mujoco.mj_kinematics(mj, d)
    site = mj.site("tool").id
    return d.site_xmat[site].reshape(3, 3), d.site_xpos[site].copy()


@pytest.mark.parametrize("arm", ["paper", "ur10e"])
def test_forward_kinematics_equals_c(arm):
    mj = load_mujoco(arm)
    q = np.random.default_rng(1).uniform(-np.pi, np.pi, (40, 6))
    pose = compiled_pose(chain_model(mj, "tool"))
    with jax.enable_x64(True):
        r64, p64 = pose(jnp.asarray(q))
    r32, p32 = pose(jnp.asarray(np.float32(q)))
    for i in range(len(q)):
        r, p = c_pose(mj, q[i])
        np.testing.assert_allclose(r64[i], r, rtol=0, atol=F64)
        np.testing.assert_allclose(p64[i], p, rtol=0, atol=F64)
        np.testing.assert_allclose(r32[i], r, rtol=0, atol=F32)
        np.testing.assert_allclose(p32[i], p, rtol=0, atol=F32)


def dm_control_solution(physics, q_start, r, p):
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(r).ravel())
    physics.data.qpos[:] = q_start
    return qpos_from_site_pose(physics, "tool", target_pos=p, target_quat=quat)


def test_equals_dm_control_from_the_start_pose(model):
    r, p = random_goals(2, 60)
    physics = dm_mujoco.Physics.from_xml_path(arm_path("paper"))
    with jax.enable_x64(True):
        got = solve(model, START, r, p)
    both = 0
    for i in range(len(p)):
        theirs = dm_control_solution(physics, START, r[i], p[i])
        if theirs.success and bool(got.ok[i]):
            np.testing.assert_allclose(got.q[i], theirs.qpos, rtol=0, atol=DM_CONTROL_RAD)
            both += 1
    assert both >= 58, both


def test_equals_dm_control_warm_started(model):
    """Along a path with 5 mm and 10 mrad a step, more than the roughest sea's 20 ms."""
    (r0, r1), (p0, p1) = random_goals(3, 2)
    turn = Rotation.from_matrix(r1 @ r0.T).as_rotvec()
    steps = int(max(np.linalg.norm(p1 - p0) / 0.005, np.linalg.norm(turn) / 0.01)) + 1
    physics = dm_mujoco.Physics.from_xml_path(arm_path("paper"))
    ours = theirs = dm_control_solution(physics, START, r0, p0).qpos.copy()
    with jax.enable_x64(True):
        for k in range(1, steps + 1):
            r = Rotation.from_rotvec(k / steps * turn).as_matrix() @ r0
            p = p0 + k / steps * (p1 - p0)
            found = solve(model, ours, r[None], p[None], ik.WARM_ITERATIONS)
            result = dm_control_solution(physics, theirs, r, p)
            assert bool(found.ok[0]) and result.success
            ours, theirs = np.asarray(found.q[0]), result.qpos.copy()
            np.testing.assert_allclose(ours, theirs, rtol=0, atol=DM_CONTROL_RAD)
    assert steps > 20


def test_the_solution_reaches_the_goal(model):
    mj = load_mujoco("paper")
    r, p = random_goals(4, 50)
    with jax.enable_x64(True):
        found = solve(model, START, r, p)
    assert np.all(found.ok)
    for i in range(len(p)):
        got_r, got_p = c_pose(mj, found.q[i])
        np.testing.assert_allclose(got_r, r[i], rtol=0, atol=1e-9)
        np.testing.assert_allclose(got_p, p[i], rtol=0, atol=1e-9)


def test_the_solution_reaches_the_goal_in_float32(model):
    mj = load_mujoco("paper")
    r, p = random_goals(5, ROWS)
    found = solve(model, START, np.float32(r), np.float32(p))
    assert np.all(found.ok)
    q = np.asarray(found.q, np.float64)
    error = [np.linalg.norm(c_pose(mj, q[i])[1] - p[i]) for i in range(len(p))]
    # The last Newton step rounds each angle (up to 3 rad) at 1e-7; 1 m of arm: some 1e-6 m.
    assert max(error) < 5e-6


def test_inverse_after_forward_is_the_identity(model):
    """From a start within 0.05 rad a joint, away from singular postures."""
    rng = np.random.default_rng(6)
    q = START + rng.uniform(-0.4, 0.4, (40, 6))
    with jax.enable_x64(True):
        r, p = compiled_pose(model)(jnp.asarray(q))
        start = q + rng.uniform(-0.05, 0.05, q.shape)
        found = solve(model, start, np.asarray(r), np.asarray(p))
    assert np.all(found.ok)
    np.testing.assert_allclose(found.q, q, rtol=0, atol=1e-9)


def moved(target, v):
    """The target shifted by v[:3] m and turned by the rotation vector v[3:], in B axes."""
    r, p = target
    return matmul(exp_rotation(unpack(v[3:], 3)), r), vadd(p, unpack(v[:3], 3))


WEIGHTS = np.random.default_rng(14).normal(size=6)


@pytest.fixture(scope="module")
def derivative(model):
    """For moves v of a target: h and (q, d(weights . q)/d start, d(weights . q)/dv), float64.

    Rows 0 to 12: no move, +h and -h along each of six axes; 13: a target out of reach.
    """
    h = 1e-5
    v = np.concatenate([np.zeros((1, 6)), h * np.eye(6), -h * np.eye(6), np.zeros((1, 6))])
    r, p = random_goals(7, 1)
    p = np.repeat(p, 14, axis=0)
    p[13, 0] = 5.0

    def weighted(q, v, p):
        target = unpack_matrix(jnp.asarray(r[0])), unpack(p, 3)
        q = ik.solve(model, q, moved(target, v), ik.COLD_ITERATIONS).q
        return WEIGHTS @ q, q

    slopes = jax.vmap(jax.grad(weighted, argnums=(0, 1), has_aux=True), in_axes=(None, 0, 0))
    with jax.enable_x64(True):
        (by_start, by_move), q = jax.jit(slopes)(*(jnp.asarray(x) for x in (START, v, p)))
    return h, *(np.asarray(x) for x in (q, by_start, by_move))


def test_gradient_by_the_target(derivative):
    """Reverse mode against central differences of the converged solution."""
    h, q, _, by_move = derivative
    differences = (q[1:7] - q[7:13]) @ WEIGHTS / (2 * h)
    # Truncation h^2 / 6 times a third derivative of about 100: 2e-9; rounding 1e-15 / h = 1e-10.
    np.testing.assert_allclose(by_move[0], differences, rtol=0, atol=1e-7)
    assert np.abs(differences).min() > 0.01


def test_gradient_by_the_start_is_zero(derivative):
    _, _, by_start, _ = derivative
    np.testing.assert_array_equal(by_start, np.zeros((14, 6)))


def test_gradients_are_finite_out_of_reach(derivative):
    _, q, _, by_move = derivative
    assert np.all(np.isfinite(q))
    assert np.all(np.isfinite(by_move))


def test_failure_is_data(model):
    r, p = random_goals(9, 4)
    # 1: 3 m away, twice the arm's reach; 2: NaN position; 3: infinite; 0: fine.
    p[1], p[2, 0], p[3, 1] = [3.0, 0.0, 0.3], np.nan, np.inf
    found = solve(model, START, np.float32(r), np.float32(p))
    np.testing.assert_array_equal(found.ok, [True, False, False, False])
    assert np.all(np.isfinite(found.q))
    assert float(found.error[1]) > 1.0
    # Nothing was found at all: where the search started.
    np.testing.assert_array_equal(found.q[2:], np.float32(np.stack([START, START])))


def test_joint_limits_are_respected(model):
    """Starts near the elbow's limit and far targets: the elbow (+-pi) stops at its limit."""
    rng = np.random.default_rng(11)
    q = START + rng.uniform(-0.5, 0.5, (60, 6))
    q[:, 2] = np.pi - 0.05
    r, p = random_goals(12, 60)
    p[:, :2] *= rng.uniform(-0.3, 0.6, (60, 1))  # close to the base: fold the elbow
    found = solve(model, np.float32(q), np.float32(r), np.float32(p))
    limits = np.array([link.q_range for link in model.links], np.float32)
    np.testing.assert_allclose(limits[2], [-np.pi, np.pi], rtol=1e-7)
    assert np.all(found.q >= limits[:, 0]) and np.all(found.q <= limits[:, 1])
    assert np.any(np.asarray(found.q)[:, 2] == limits[2, 1])


SEVEN = "<mujoco><compiler angle='radian'/><worldbody>{}</worldbody></mujoco>".format(
    "".join(
        f"<body pos='0 0 {z}'><joint axis='{axis}'/>"
        "<geom type='sphere' size='.04' contype='0' conaffinity='0'/>"
        for z, axis in (
            *((0.15, "0 0 1"), (0.19, "0 1 0"), (0.21, "0 0 1"), (0.19, "0 -1 0")),
            *((0.21, "0 0 1"), (0.19, "0 1 0"), (0.08, "0 0 1")),
        )
    )
    + "<site name='tool' pos='0.03 0 .1' quat='0.8 0.6 0 0'/>"
    + "</body>" * 7
)


def test_an_arm_of_seven_joints_converges():
    mj = mujoco.MjModel.from_xml_string(SEVEN)
    arm = chain_model(mj, "tool")
    assert arm.nq == 7
    rng = np.random.default_rng(13)
    posture = np.array([0.3, 0.8, -0.2, 1.2, 0.4, 0.7, -0.5])
    goals = [c_pose(mj, posture + rng.uniform(-0.3, 0.3, 7)) for _ in range(30)]
    r, p = (np.stack(x) for x in zip(*goals, strict=True))
    with jax.enable_x64(True):
        found = solve(arm, posture, r, p)
        pose_r, pose_p = compiled_pose(arm)(found.q)
    assert np.all(found.ok)
    np.testing.assert_allclose(pose_p, p, rtol=0, atol=1e-9)
    np.testing.assert_allclose(pose_r, r, rtol=0, atol=1e-9)
