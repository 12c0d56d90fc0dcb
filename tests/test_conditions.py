"""What is not as model or sensor say: payload, wrist, integrator, delay, noise, age, path."""

import dataclasses

import jax
import jax.numpy as jnp
import moving_base
import mujoco
import numpy as np
import pytest

from mcx_jax.arm import chain
from mcx_jax.arm.model import chain_model
from mcx_jax.arm.plant import Plant
from mcx_jax.config.task import ConditionsConfig, EnvConfig, MotionConfig, Range
from mcx_jax.envs import conditions
from mcx_jax.envs.goal_path import PERIOD_S, RADIUS_M, load_goal_path
from mcx_jax.envs.v2v import make_env
from mcx_jax.errors import UserError

PAYLOAD_KG, WRIST = 3.0, 0.05
LEVEL = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 9.81))
"""A base at rest, as `chain.BaseState`."""
ALL = EnvConfig(
    delay="E0,E2",
    integrator="mixed",
    episode_steps=40,
    goal="circle",
    conditions=ConditionsConfig("1:3", "2", "1:3", "0:5", "0.02:1"),
)
SEA = MotionConfig(sea="Wd")


def carrying(arm: str) -> mujoco.MjModel:
    """The arm with a point mass at its tool and another inertia of its last link, for C MuJoCo."""
    spec = mujoco.MjSpec.from_file(moving_base.arm_path(arm))
    site = next(s for s in spec.sites if s.name == "tool")
    wrist = site.parent
    wrist.inertia = WRIST * np.asarray(wrist.inertia)
    load = wrist.add_body(name="load", pos=site.pos)
    load.mass, load.inertia, load.explicitinertial = PAYLOAD_KG, [1e-12] * 3, True
    load.ipos = [0, 0, 0]
    return spec.compile()


@pytest.mark.parametrize("integrator", ["euler", "implicitfast"])
def test_a_load_and_another_wrist_are_those_of_c_mujoco(integrator):
    plain = chain_model(mujoco.MjModel.from_xml_path(moving_base.arm_path("paper")), "tool")
    heavy = carrying("paper")
    heavy.opt.integrator = {"euler": 0, "implicitfast": 3}[integrator]
    rng = np.random.default_rng(0)
    q, qd = rng.uniform(-2, 2, 6), rng.uniform(-1, 1, 6)
    ctrl = np.concatenate([q + 2e-4 * rng.uniform(-1, 1, 6), qd + 0.01 * rng.uniform(-1, 1, 6)])
    data = mujoco.MjData(heavy)
    data.qpos[:], data.qvel[:], data.ctrl[:] = q, qd, ctrl
    mujoco.mj_step(heavy, data)
    with jax.enable_x64(True):
        plant = Plant(
            jnp.float64(PAYLOAD_KG), jnp.float64(WRIST), jnp.float64(integrator != "euler")
        )
        quiet = (
            ("quiet",) if integrator == "implicitfast" else ()
        )  # the same: no servo at its limit
        for name in (integrator, *quiet, "mixed"):
            step = jax.jit(
                lambda q, qd, ctrl, plant, name=name: chain.substeps(
                    plain, name, q, qd, ctrl, lambda _: LEVEL, 1, None, plant
                )
            )
            new_q, new_qd = step(jnp.asarray(q), jnp.asarray(qd), jnp.asarray(ctrl), plant)
            # As in test_physics: float64 of two different orders of summation.
            np.testing.assert_allclose(new_qd, data.qvel, rtol=0, atol=1e-9)
            np.testing.assert_allclose(new_q, data.qpos, rtol=0, atol=1e-11)
        alone = chain.substeps(
            plain, integrator, *map(jnp.asarray, (q, qd, ctrl)), lambda _: LEVEL, 1
        )
        assert np.abs(np.asarray(alone[1]) - data.qvel).max() > 1e-3


@pytest.fixture(scope="module")
def env():
    return make_env(ALL, SEA, split="test")


@pytest.fixture(scope="module")
def run(env):
    """States of 6 episodes, the reset first: leaves (41, ..., 6)."""

    def episode(env, keys):
        state = jax.vmap(env.reset, out_axes=-1)(keys)
        step = jax.vmap(env.step, in_axes=(-1, -1), out_axes=-1)

        def body(state, _):
            state = step(state, jnp.zeros((6, 6)))
            return state, state

        _, states = jax.lax.scan(body, state, None, 40)
        return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), state, states)

    return jax.jit(episode)(env, jax.random.split(jax.random.key(3), 6))


def true_poses(env, run):
    """(41, 6, 3, 3), (41, 6, 3): the goal's pose at the end of every control step."""

    def at(state):
        r, p = env.goal_ahead(state, 0)
        return conditions.stack_matrix(r), jnp.stack(p)

    per_step = jax.vmap(at, in_axes=-1, out_axes=0)
    return jax.jit(jax.vmap(per_step))(run)


def test_draws_are_in_their_ranges_and_differ(run):
    drawn = jax.tree.map(
        lambda x: np.asarray(x[0]), dataclasses.replace(run.conditions, noise=None)
    )
    assert np.all((drawn.plant.payload_kg >= 0) & (drawn.plant.payload_kg <= 5))
    assert np.all((drawn.plant.wrist_inertia >= 0.02) & (drawn.plant.wrist_inertia <= 1))
    assert set(drawn.plant.quiet) == {0, 1} and set(drawn.delay) == {0, 1}
    assert set(drawn.latency) <= {1, 2, 3} and len(set(drawn.latency)) > 1
    noise_m = np.asarray(run.conditions.noise.position_m[0])
    assert np.all((noise_m >= 1e-3) & (noise_m <= 3e-3)) and len(set(noise_m)) == 6
    np.testing.assert_allclose(run.conditions.noise.angle_rad[0], 2e-3, rtol=1e-6)


def test_a_third_of_noise_up_to_3_mm_is_below_a_third_of_a_mm():
    config = EnvConfig(conditions=ConditionsConfig(noise_mm="0:3", noise_mrad="1:4"))
    keys = jax.random.split(jax.random.key(0), 4000)
    noise = jax.vmap(lambda key: conditions.draw(config, key, 0).noise)(keys)
    assert noise is not None
    # Quantiles of a number whose root is even: 3 u^2, (1 + u)^2; 4000 draws scatter by 0.008 of u.
    for u in (0.1, 1 / 3, 0.5, 0.9):
        position_mm, angle_mrad = 1e3 * noise.position_m, 1e3 * noise.angle_rad
        assert float(jnp.mean(position_mm < 3 * u**2)) == pytest.approx(u, abs=0.03)
        assert float(jnp.mean(angle_mrad < (1 + u) ** 2)) == pytest.approx(u, abs=0.03)


def test_the_measurement_is_late_and_noisy_and_the_errors_are_true(env, run):
    rotations, positions = (np.asarray(x) for x in true_poses(env, run))
    latency = np.asarray(run.conditions.latency[0])
    measured = np.moveaxis(np.asarray(run.measured.position), -1, 1)
    tool = np.moveaxis(np.asarray(run.obs[:, 21:24]), -1, 1)
    np.testing.assert_allclose(
        run.metrics.pos_error_m, np.linalg.norm(positions - tool, axis=2), rtol=0, atol=2e-6
    )
    np.testing.assert_array_equal(run.obs[:, 9:12], run.measured.position)
    np.testing.assert_allclose(run.obs[0, 38], 0.02 * latency, rtol=1e-6)
    for k in range(6):
        late = positions[np.maximum(np.arange(41) - latency[k], 0), k]
        noise = (measured[:, k] - late) / float(run.conditions.noise.position_m[0, k])
        # 123 draws of a unit normal: deviation of their deviation 0.064; four of those.
        assert noise.std() == pytest.approx(1.0, abs=0.26) and abs(noise.mean()) < 0.36
        assert len(np.unique(np.round(noise, 5))) == noise.size
        turned = np.asarray(run.measured.rotation[:, :, :, k])
        late_r = rotations[np.maximum(np.arange(41) - latency[k], 0), k]
        angle = np.arccos(np.clip((np.einsum("tij,tij->t", turned, late_r) - 1) / 2, -1, 1))
        # A rotation vector of three normals of 2 mrad each; arccos in float32 resolves 0.3 mrad.
        assert np.sqrt((angle**2).mean()) == pytest.approx(2e-3 * np.sqrt(3), rel=0.3)


def test_the_goal_goes_round_its_circle(env, run):
    still = dataclasses.replace(env, goal_path=None)
    state = jax.tree.map(lambda x: x[20, ..., 0], run)
    _, moved = env.goal_ahead(state, 0)
    _, rest = still.goal_ahead(state, 0)
    distance = np.linalg.norm(np.asarray(moved) - np.asarray(rest))
    assert distance == pytest.approx(RADIUS_M, abs=1e-6)
    path = load_goal_path("circle")
    steps = round(PERIOD_S / 0.002)
    np.testing.assert_array_equal(path.at(jnp.int32(7)), path.at(jnp.int32(7 + steps)))
    quarter = np.asarray(path.at(jnp.int32(steps // 4)))
    np.testing.assert_allclose(quarter, [0, RADIUS_M, 0], atol=1e-7)
    assert load_goal_path("static") is None


@pytest.mark.slow
def test_one_of_several_delays_is_that_delay_alone(run):
    """Same key, same windows and goal: what is drawn besides does not change them."""
    quiet = EnvConfig(delay="E0,E2", integrator="implicitfast", episode_steps=40)
    key = jax.random.split(jax.random.key(3), 6)[0]
    both = make_env(quiet, SEA, split="test")
    drawn = both.draw(key)
    np.testing.assert_array_equal(drawn[1], run.goal_m[0, :, 0])
    assert int(drawn[0].start_a) == int(run.track.start_a[0, 0])

    def trajectory(env, given):
        state = env.reset(key, None, given)
        _, dp = jax.lax.scan(
            lambda s, _: (lambda n: (n, n.metrics.pos_error_m))(env.step(s, jnp.zeros(6))),
            state,
            None,
            40,
        )
        return dp

    for number, name in enumerate(("E0", "E2")):
        alone = make_env(dataclasses.replace(quiet, delay=name), SEA, split="test")
        given = dataclasses.replace(drawn[2], delay=jnp.int32(number))
        # The same operations in another program: float32 rounding of poses of 1 m.
        np.testing.assert_allclose(
            jax.jit(trajectory)(both, given),
            jax.jit(trajectory)(alone, alone.draw(key)[2]),
            atol=2e-6,
        )


def test_nothing_is_drawn_by_default():
    config = EnvConfig()
    drawn = conditions.draw(config, jax.random.key(0), 0)
    assert jax.tree.leaves(drawn) == [] and drawn.age_s == 0.0
    assert not config.conditions.imperfect_sensor


@pytest.mark.slow
def test_corrections_are_bounded(env):
    state = env.reset(jax.random.key(1))
    bound = env.config.max_correction
    wild = jnp.array([1e3, -1e3, 0.0, 1e4, 0.0, -1e4])
    step = jax.jit(env.step)
    got, want = step(state, wild), step(state, jnp.clip(wild, -bound, bound))
    np.testing.assert_array_equal(got.arm.q, want.arm.q)
    assert bool(got.metrics.valid)


@pytest.mark.parametrize(
    ("setting", "text"),
    [
        ("noise_mm", "-1"),
        ("noise_mm", "3:1"),
        ("noise_mrad", "a"),
        ("noise_mrad", "1:2:3"),
        ("latency_steps", "1.5"),
        ("latency_steps", "0:51"),
        ("payload_kg", "nan"),
        ("wrist_inertia", "0:1"),
    ],
)
def test_wrong_ranges_are_refused(setting, text):
    with pytest.raises(UserError, match=f"--{setting.replace('_', '-')}"):
        ConditionsConfig(**{setting: text})


def test_ranges():
    assert ConditionsConfig(noise_mm="0.3").ranges["noise_mm"] == Range(0.3, 0.3)
    assert ConditionsConfig(payload_kg="0:5").ranges["payload_kg"] == Range(0, 5)


def test_mjx_refuses_another_plant():
    with pytest.raises(UserError, match="--physics mjx"):
        EnvConfig(physics="mjx", conditions=ConditionsConfig(payload_kg="1"))


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "two rows"),
        ("t,x,y,z\n0,0,0,0\n", "two rows"),
        ("0,0,0\n1,0,0\n", "four"),
        ("0,0\n0.1,0.01\n0.2,0.02\n0.3,0.01\n", "four"),
        ("0,0,0,0\n0,0,0,0\n", "increase"),
        ("0,0,0,0\n1,nan,0,0\n", "finite"),
        ("\x00\x01\x02", "needs|table"),
    ],
)
def test_a_path_that_is_none_is_refused(tmp_path, text, what):
    file = tmp_path / "path.csv"
    file.write_text(text)
    with pytest.raises(UserError, match=what):
        load_goal_path(str(file))


def test_a_path_from_a_file(tmp_path):
    file = tmp_path / "path.csv"
    file.write_text("t,x,y,z\n0,0,0,0\n1,0.1,0,0\n2,0.1,0.2,0\n")
    path = load_goal_path(str(file))
    assert not path.closed and path.period_steps == 0
    np.testing.assert_allclose(path.at(jnp.int32(250)), [0.05, 0, 0], atol=1e-7)
    np.testing.assert_allclose(path.at(jnp.int32(10_000)), [0.1, 0.2, 0], atol=1e-7)
    with pytest.raises(UserError, match="no such file"):
        load_goal_path(str(tmp_path / "none.csv"))
