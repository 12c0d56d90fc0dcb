"""Both physics engines against C MuJoCo: random states, moving base, saturated servo."""

import jax
import jax.numpy as jnp
import moving_base
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mcx_jax.envs import chain, mjx_engine
from mcx_jax.envs.model import chain_model, load_mujoco
from mcx_jax.errors import UserError

H_S = 0.002
# Tolerances of one step's joint velocity, rad/s.
# float64: both solve the same equations; the mass matrix's condition (1e3) times 1e-16 times
# torque/inertia of up to 1e3 rad/s2 leaves 1e-12; 1e-9 is what the project promises.
TOLERANCE_F64 = 1e-9
# float32: kp (q_ref - q) alone carries 1e5 * 2e-7 rad = 0.02 N m of rounding, over inertias of
# 1 kg m2 and one step of 2 ms: 4e-5 rad/s.
# MJX forms kp q_ref - kp q from two rounded products of 3e5 N m: three times as much.
TOLERANCE_F32 = {"chain": 1e-4, "mjx": 3e-4}
STILL = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 9.81))


def random_state(rng, *, near_target: bool):
    """Every joint drawn separately; the servo either within or far beyond its force limits."""
    q, qd = rng.uniform(-np.pi, np.pi, 6), rng.uniform(-2.0, 2.0, 6)
    reach = 3e-4 if near_target else 0.3
    ctrl = np.concatenate([q + rng.uniform(-reach, reach, 6), qd + rng.uniform(-0.02, 0.02, 6)])
    return q, qd, ctrl


def c_step(mj, q, qd, ctrl):
    d = mujoco.MjData(mj)
    d.qpos[:], d.qvel[:], d.ctrl[:] = q, qd, ctrl
    mujoco.mj_step(mj, d)
    return d.qpos.copy(), d.qvel.copy()


def engine_step(engine: str, mj, integrator: str):
    model = chain_model(mj, "tool")
    if engine == "chain":

        def step(q, qd, ctrl, base):
            return chain.substeps(model, integrator, q, qd, ctrl, lambda i: base, 1)
    else:
        device = mjx_engine.put_model(mj, integrator)

        def step(q, qd, ctrl, base):
            return mjx_engine.substeps(device, q, qd, ctrl, lambda i: base, 1)

    return jax.jit(step)


@pytest.mark.parametrize(
    ("engine", "integrator", "arm"),
    [
        ("chain", "euler", "paper"),
        ("chain", "implicitfast", "paper"),
        ("chain", "euler", "ur10e"),
        ("chain", "implicitfast", "ur10e"),
        # MJX compiles for 10 s each; each arm with its own integrator.
        ("mjx", "euler", "paper"),
        ("mjx", "implicitfast", "ur10e"),
    ],
)
def test_one_step_equals_c(engine, integrator, arm):
    mj = load_mujoco(arm)
    mj.opt.integrator = mjx_engine.INTEGRATORS[integrator]
    rng = np.random.default_rng(1)
    states = [random_state(rng, near_target=k % 2 == 0) for k in range(24)]
    with jax.enable_x64(True):
        step = engine_step(engine, mj, integrator)
        for q, qd, ctrl in states:
            got_q, got_qd = step(q, qd, ctrl, STILL)
            want_q, want_qd = c_step(mj, q, qd, ctrl)
            np.testing.assert_allclose(got_qd, want_qd, rtol=0, atol=TOLERANCE_F64)
            np.testing.assert_allclose(got_q, want_q, rtol=0, atol=TOLERANCE_F64)


@pytest.mark.parametrize("engine", ["chain", "mjx"])
def test_one_step_equals_c_in_float32(engine):
    mj = load_mujoco("paper")
    rng = np.random.default_rng(2)
    step = engine_step(engine, mj, "euler")
    for k in range(24):
        # C gets the float32-rounded state, so that only the arithmetic differs.
        state = random_state(rng, near_target=k % 2 == 0)
        q, qd, ctrl = (np.float32(x) for x in state)
        got = step(jnp.asarray(q), jnp.asarray(qd), jnp.asarray(ctrl), STILL)[1]
        want = c_step(mj, q, qd, ctrl)[1]
        np.testing.assert_allclose(got, want, rtol=0, atol=TOLERANCE_F32[engine])


@pytest.mark.parametrize("engine", ["chain", "mjx"])
def test_moving_base_equals_c_with_prescribed_base(engine):
    mj = load_mujoco("paper")
    free = moving_base.free_base_model(moving_base.arm_path("paper"))
    rng = np.random.default_rng(3)
    with jax.enable_x64(True):
        step = engine_step(engine, mj, "euler")
        for k in range(12):
            q, qd, ctrl = random_state(rng, near_target=k % 2 == 0)
            w, al, acc = (rng.uniform(-s, s, 3) for s in (1.0, 3.0, 3.0))
            rotation = Rotation.random(random_state=k).as_matrix()
            a = rotation.T @ (acc + [0.0, 0.0, 9.81])
            got = step(q, qd, ctrl, (tuple(w), tuple(al), tuple(a)))[1]
            qdd = moving_base.acceleration(free, q, qd, ctrl, rotation, w, al, acc)
            np.testing.assert_allclose(got, qd + H_S * qdd, rtol=0, atol=TOLERANCE_F64)


def test_saturation_really_occurs_in_the_random_states():
    mj = load_mujoco("paper")
    rng = np.random.default_rng(1)
    saturated = []
    for k in range(24):
        d = mujoco.MjData(mj)
        q, qd, ctrl = random_state(rng, near_target=k % 2 == 0)
        d.qpos[:], d.qvel[:], d.ctrl[:] = q, qd, ctrl
        mujoco.mj_forward(mj, d)
        saturated.append(np.abs(d.actuator_force) >= mj.actuator_forcerange[:, 1] - 1e-9)
    share = np.mean(saturated)
    assert 0.1 < share < 0.9, share


UNSUPPORTED = {
    "joints that are not hinges": '<joint type="slide"/>',
    "joint springs": '<joint stiffness="3"/>',
    "dry joint friction": '<joint frictionloss="1"/>',
    "active joint limits": '<joint limited="true" range="-1 1"/>',
    "more than one joint on a body": '<joint axis="1 0 0"/><joint axis="0 1 0"/>',
}


@pytest.mark.parametrize("fault", UNSUPPORTED)
def test_models_that_the_chain_engine_cannot_take_are_refused(fault):
    xml = (
        "<mujoco><compiler angle='radian'/><worldbody><body>"
        f"{UNSUPPORTED[fault]}<geom size='.1' contype='0' conaffinity='0'/>"
        "</body></worldbody></mujoco>"
    )
    with pytest.raises(UserError, match=f"chain engine cannot take this arm model: it has {fault}"):
        chain_model(mujoco.MjModel.from_xml_string(xml))


def test_unknown_arm_is_refused_with_the_valid_names():
    with pytest.raises(UserError, match="--arm ur5: not one of paper, ur10e and no such file"):
        load_mujoco("ur5")
