"""`mcx_jax.integrations.mjx_step.step` in programs written for `mjx.step`."""

import functools

import arms
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from mcx_jax.errors import UserError
from mcx_jax.integrations.mjx_step import step

ROWS, STEPS = 8, 25
# float64, one step: two orders of summing the same terms, as in test_arms.
F64 = 1e-9
# ... and after 25 steps of arms whose servos are resolved by the time step: nothing is amplified.
LOOP_F64 = 1e-9
# float32: rounding of velocities of 10 rad/s and angles of 3 rad, of 25 steps.
LOOP_F32 = 2e-4
FILLED = (
    *("time", "qpos", "qvel", "qacc", "qacc_smooth", "qacc_warmstart", "qfrc_bias"),
    *("qfrc_passive", "qfrc_actuator", "qfrc_smooth", "actuator_force", "actuator_length"),
)


def model(arm: str, integrator: str) -> mujoco.MjModel:
    """A test arm; under implicitfast without force limits, where MJX is not C MuJoCo."""
    mj = arms.load(arm, integrator)
    mj.jnt_stiffness[:] = 3.0
    mj.qpos_spring[:] = 0.2
    if integrator == "implicitfast":
        mj.actuator_forcelimited[:] = False
    return mj


def loop(step):
    """Somebody's program: states and all results of STEPS steps of a batch, batch axis first."""

    def run(m, d):
        def body(d, _):
            d = jax.vmap(step, in_axes=(None, 0))(m, d)
            return d, {name: getattr(d, name) for name in FILLED}

        return jax.lax.scan(body, d, None, STEPS)

    return run


def start(m: mjx.Model, mj: mujoco.MjModel) -> mjx.Data:
    """ROWS random states with forces applied to joints and bodies."""
    q, qd, ctrl = (jnp.asarray(x) for x in arms.states(mj, ROWS, seed=2))
    rng = np.random.default_rng(3)
    applied = jnp.asarray(rng.uniform(-5.0, 5.0, (ROWS, mj.nv)))
    wrench = jnp.asarray(rng.uniform(-5.0, 5.0, (ROWS, mj.nbody, 6)))
    d = jax.vmap(lambda q: mjx.make_data(m).replace(qpos=q))(q)
    return d.replace(qvel=qd, ctrl=ctrl, qfrc_applied=applied, xfrc_applied=wrench)


@pytest.mark.parametrize(
    "integrator",
    [pytest.param(x, marks=pytest.mark.slow if x != "euler" else ()) for x in arms.INTEGRATORS],
)
def test_a_loop_written_for_mjx_gives_the_same(integrator):
    mj = model("four", integrator)
    compiled = functools.partial(jax.jit, compiler_options=arms.QUICK)
    with jax.enable_x64(True):
        m = mjx.put_model(mj)
        d = start(m, mj)
        _, want = compiled(loop(mjx.step))(m, d)
        # Closed over the model is concrete; as an argument it is traced.
        end, got = compiled(lambda d: loop(step)(m, d))(d)
        check(got, want, LOOP_F64)
        if integrator == "implicitfast":
            check(compiled(loop(step))(m, d)[1], want, LOOP_F64)
        for name in ("ctrl", "qfrc_applied", "xfrc_applied", "site_xpos", "xpos"):
            np.testing.assert_array_equal(getattr(end, name), getattr(d, name))


def check(got: dict, want: dict, tolerance: float) -> None:
    """Every field within `tolerance` of its largest value."""
    for name in FILLED:
        scale = 1.0 + np.abs(want[name]).max()
        assert np.abs(got[name] - want[name]).max() < tolerance * scale, name


def test_a_loop_in_float32():
    mj = model("four", "euler")
    m = mjx.put_model(mj)
    d = start(m, mj)
    _, got = jax.jit(lambda d: loop(step)(m, d), compiler_options=arms.QUICK)(d)
    assert got["qpos"].dtype == jnp.float32
    c = mujoco.MjData(mj)
    for i in range(ROWS):
        c.qfrc_applied[:], c.xfrc_applied[:] = d.qfrc_applied[i], d.xfrc_applied[i]
        c.qpos[:], c.qvel[:], c.ctrl[:] = d.qpos[i], d.qvel[i], d.ctrl[i]
        mujoco.mj_step(mj, c, STEPS)
        np.testing.assert_allclose(got["qpos"][-1, i], c.qpos, rtol=0, atol=LOOP_F32)


@pytest.mark.parametrize("arm", ["four", "seven"])
def test_one_step_equals_c(arm):
    """With force limits, implicitfast, forces on joints and bodies."""
    mj = arms.load(arm, "implicitfast")
    with jax.enable_x64(True):
        m = mjx.put_model(mj)
        d = start(m, mj)
        got = jax.jit(jax.vmap(lambda d: step(m, d)), compiler_options=arms.QUICK)(d)
    for i in range(ROWS):
        c = mujoco.MjData(mj)
        c.qfrc_applied[:], c.xfrc_applied[:] = d.qfrc_applied[i], d.xfrc_applied[i]
        arms.c_step(mj, d.qpos[i], d.qvel[i], d.ctrl[i], c)
        np.testing.assert_allclose(got.qvel[i], c.qvel, rtol=0, atol=F64)
        np.testing.assert_allclose(got.qacc[i], c.qacc, rtol=F64, atol=F64)
        np.testing.assert_allclose(got.actuator_force[i], c.actuator_force, rtol=0, atol=F64)


def test_randomised_masses_and_gradient():
    """A vmap over the model's masses; the gradient by mass, state and command, by differences."""
    mj = arms.load("four", "implicitfast")
    quick = functools.partial(jax.jit, compiler_options=arms.QUICK)
    with jax.enable_x64(True):
        m = mjx.put_model(mj)
        d = jax.tree.map(lambda x: x[1], start(m, mj))
        point = jnp.concatenate([m.body_mass, d.qpos, d.qvel, d.ctrl])
        cuts = np.cumsum([mj.nbody, mj.nq, mj.nv])

        def velocity(x):
            mass, q, qd, ctrl = jnp.split(x, cuts)
            return step(m.replace(body_mass=mass), d.replace(qpos=q, qvel=qd, ctrl=ctrl)).qvel

        def speed(x):
            return velocity(x) @ jnp.arange(1.0, 5.0)

        # 1e-6: truncation 1e-12 times a third derivative of 1e3, rounding 1e-15 / 1e-6.
        h = 1e-6
        slope = quick(jax.grad(speed))(point)
        axes = jnp.eye(len(point))
        heavy = point.at[: mj.nbody].multiply(1.3)
        rows = jnp.concatenate([point + h * axes, point - h * axes, heavy[None]])
        moved = quick(jax.vmap(velocity))(rows)
        high, low = jnp.split(moved[:-1] @ jnp.arange(1.0, 5.0), 2)
        np.testing.assert_allclose(slope, (high - low) / (2 * h), rtol=1e-6, atol=1e-6)
    mj.body_mass[:] = heavy[: mj.nbody]
    c = mujoco.MjData(mj)
    c.qfrc_applied[:], c.xfrc_applied[:] = d.qfrc_applied, d.xfrc_applied
    want = arms.c_step(mj, d.qpos, d.qvel, d.ctrl, c).qvel
    np.testing.assert_allclose(moved[-1], want, rtol=0, atol=F64)


REFUSED = {
    "contacts": "<geom size='.1' contype='1'/>",
    "active joint limits": "<joint limited='true' range='-1 1'/><geom size='.1'/>",
    "dry joint friction": "<joint frictionloss='1'/><geom size='.1'/>",
    "gravity compensation": "<joint/><geom size='.1'/><body gravcomp='1'><geom size='.1'/></body>",
    "joints that are not hinges": "<freejoint/><geom size='.1'/>",
}


@pytest.mark.parametrize("fault", REFUSED)
@pytest.mark.parametrize("traced", [False, True])
def test_what_the_chain_engine_cannot_take_is_refused(fault, traced):
    inside = REFUSED[fault]
    flag = "" if fault == "contacts" else "<option><flag contact='disable'/></option>"
    mj = mujoco.MjModel.from_xml_string(
        f"<mujoco>{flag}<worldbody><geom size='.1'/><body>"
        f"{inside if 'joint' in inside else '<joint/>' + inside}</body></worldbody></mujoco>"
    )
    m = mjx.put_model(mj)
    d = mjx.make_data(m)
    with pytest.raises(UserError, match=f"chain engine cannot take this arm model: it has {fault}"):
        jax.eval_shape(step, m, d) if traced else step(m, d)
