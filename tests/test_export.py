"""Exported policies: four forms that agree, one that runs without JAX, and what is refused."""

import functools
import json
import os
import re
import shutil
import subprocess
import sys

import arms
import c_loop
import jax
import jax.numpy as jnp
import moving_base
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mcx_jax import extras
from mcx_jax.config import command_line
from mcx_jax.config.task import EnvConfig, MotionConfig
from mcx_jax.config.training import TrainConfig
from mcx_jax.envs import observe
from mcx_jax.envs.motion import draw_track
from mcx_jax.envs.v2v import correct, make_env
from mcx_jax.envs.vessels import draw_goal
from mcx_jax.evaluation.episodes import run_episodes
from mcx_jax.evaluation.statistics import WARM_UP_STEPS
from mcx_jax.export import main
from mcx_jax.policy import numpy_policy
from mcx_jax.policy.file import (
    Policy,
    PolicyController,
    PolicyMeta,
    act,
    init_carry,
    load_policy,
    save_policy,
)
from mcx_jax.policy.networks import init_params
from mcx_jax.policy.normalise import RunningStats
from mcx_jax.spatial import unpack, unpack_matrix

HIDDEN, STEPS, ROWS = 16, 50, 3
DOWN = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""R_B_G with both vessels level."""
MEAN = np.concatenate([DOWN.ravel(), [0.65, 0.0, 0.2]] * 2 + [np.eye(3).ravel(), np.zeros(5)])
STD = np.repeat([0.03, 0.05, 0.03, 0.05, 0.01, 0.01], [9, 3, 9, 3, 9, 5])
GAIN = 0.6
"""Of the hand-made policy: it moves the goal by this times the tool's error (stable below 1)."""


def steering_params(net):
    """Weights that act: GAIN times the error p_EG_B through units 0 to 2, past the cell, and what
    random other units remember on top."""
    params = jax.tree.map(np.array, init_params(net, jax.random.key(0), observe.OBS_SIZE))
    weights = params["params"]["net"]
    first, second, head = (weights[name]["kernel"] for name in ("dense_0", "dense_1", "head"))
    error = observe.slices()["p_EG_B"]
    first[:, :3], second[:, :3], head[:3] = 0.0, 0.0, 0.0
    first[error, :3], second[:3, :3] = 0.3 * np.eye(3), np.eye(3)
    head[:3, :3] = GAIN / 0.3 * DOWN
    head[3:] *= 8.0
    weights["cell"]["input_kernel"].reshape(HIDDEN, 4, HIDDEN)[:, 2, :3] = 0.0
    weights["cell"]["recurrent_kernel"].reshape(HIDDEN, 4, HIDDEN)[:, 2, :3] = 0.0
    return params


@pytest.fixture(scope="module")
def policy():
    config = command_line.config_to_json(TrainConfig(env=EnvConfig(delay="E1", episode_steps=1024)))
    meta = PolicyMeta(obs_size=observe.OBS_SIZE, action_size=6, hidden=HIDDEN, config=config)
    stats = RunningStats(jnp.ones(()), jnp.float32(MEAN), jnp.float32(STD**2))
    return Policy(steering_params(meta.net), stats, meta)


@pytest.fixture(scope="module")
def run_dir(policy, tmp_path_factory):
    path = tmp_path_factory.mktemp("run")
    save_policy(path / "policy.npz", policy)
    return path


@pytest.fixture(scope="module")
def exported(run_dir, tmp_path_factory):
    """The three files, as the command writes them."""
    folder = tmp_path_factory.mktemp("out")
    files = {form: folder / f"policy.{form}" for form in ("npz", "onnx", "stablehlo")}
    for path in files.values():
        main([str(run_dir), "--out", str(path)])
    return files


@pytest.fixture(scope="module")
def expected(policy):
    """Observations (STEPS, ROWS, 38), some beyond the clip, and JAX's actions (STEPS, ROWS, 6)."""
    noise = np.random.default_rng(0).normal(size=(STEPS, ROWS, observe.OBS_SIZE))
    noise[::7, :, ::5] *= 20.0
    observations = np.float32(MEAN + STD * noise)
    step = jax.jit(act)
    carry, actions = init_carry(policy, (ROWS,)), []
    for x in observations:
        carry, action = step(policy, carry, x)
        actions.append(np.asarray(action))
    assert np.abs(actions).max() > 0.5
    return observations, np.stack(actions)


def test_a_gru_is_the_same_in_all_forms(tmp_path, expected):
    observations, _ = expected
    meta = PolicyMeta(obs_size=observe.OBS_SIZE, action_size=6, hidden=HIDDEN, cell="gru")
    stats = RunningStats(jnp.ones(()), jnp.float32(MEAN), jnp.float32(STD**2))
    policy = Policy(init_params(meta.net, jax.random.key(4), observe.OBS_SIZE), stats, meta)
    save_policy(tmp_path / "gru.npz", policy)
    for form in ("onnx", "stablehlo"):
        main([str(tmp_path / "gru.npz"), "--out", str(tmp_path / f"gru.{form}")])
    runner = numpy_policy.Policy(tmp_path / "gru.npz")
    import onnxruntime

    session = onnxruntime.InferenceSession(tmp_path / "gru.onnx")
    hlo = jax.export.deserialize(bytearray((tmp_path / "gru.stablehlo").read_bytes())).call
    carry, step, h = init_carry(policy, (1,)), jax.jit(act), np.zeros((1, HIDDEN), np.float32)
    h_hlo = h
    for x in observations[:10, :1]:
        carry, want = step(policy, carry, x)
        action, h = session.run(["action", "h_next"], {"observation": x, "h": h})
        out = hlo(observation=x, h=h_hlo)
        h_hlo = out["h_next"]
        for got in (runner.step(x[0])[None], action, out["action"]):
            np.testing.assert_allclose(got, want, atol=1e-5)
    assert np.abs(h).max() > 0.1


def check_against(expected, step):
    """`step(observation, c, h)`, by name, gives JAX's actions with its own memory carried."""
    observations, actions = expected
    memory = {name: np.zeros((ROWS, HIDDEN), np.float32) for name in ("c", "h")}
    worst = 0.0
    for x, want in zip(observations, actions, strict=True):
        out = step(observation=x, **memory)
        assert set(out) == {"action", "c_next", "h_next"}
        memory = {name: out[f"{name}_next"] for name in memory}
        worst = max(worst, np.abs(np.asarray(out["action"]) - want).max())
    print(f"largest difference over {STEPS} steps: {worst:.1e}")
    assert worst < 1e-5


def test_npz_in_numpy_agrees(exported, expected):
    runners = [numpy_policy.Policy(exported["npz"]) for _ in range(ROWS)]

    def step(observation, c, h):
        for k, runner in enumerate(runners):
            np.testing.assert_array_equal(runner.state["c"], c[k])
            np.testing.assert_array_equal(runner.state["h"], h[k])
        actions = [runner.step(x) for runner, x in zip(runners, observation, strict=True)]
        after = {f"{s}_next": np.stack([r.state[s] for r in runners]) for s in ("c", "h")}
        return {"action": np.stack(actions), **after}

    check_against(expected, step)
    runners[0].reset()
    assert not any(x.any() for x in runners[0].state.values())


def test_onnx_agrees(exported, expected):
    runtime = pytest.importorskip("onnxruntime", reason="of the dev extra")
    session = runtime.InferenceSession(exported["onnx"], providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    assert [x.name for x in session.get_inputs()] == ["observation", "c", "h"]
    assert [x.shape for x in session.get_inputs()] == [["N", 38], ["N", HIDDEN], ["N", HIDDEN]]
    check_against(expected, lambda **given: dict(zip(names, session.run(None, given), strict=True)))
    said = json.loads(session.get_modelmeta().custom_metadata_map["interface"])
    assert said == numpy_policy.Policy(exported["npz"]).interface


def test_stablehlo_agrees(exported, expected):
    content = bytearray(exported["stablehlo"].read_bytes())
    program = jax.export.deserialize(content)
    check_against(expected, jax.jit(program.call))
    assert set(program.platforms) == {"cpu", "cuda", "rocm", "tpu"}


def test_exported_npz_is_a_policy_file_and_says_what_it_is(policy, exported):
    jax.tree.map(np.testing.assert_array_equal, load_policy(exported["npz"]), policy)
    said = numpy_policy.Policy(exported["npz"]).interface
    assert said["trained_for"] == {
        "arm": "paper",
        "delay": "E1: explicit delay of 1 control steps = 20 ms",
    }
    assert said["rate_hz"] == 50 and said["state"] == {"c": HIDDEN, "h": HIDDEN}
    assert [row["name"] for row in said["observation"]] == list(observe.slices())
    last = [said[block][-1] for block in ("observation", "action")]
    assert [(row["index"], row["unit"]) for row in last] == [([37, 37], "rad"), ([3, 5], "crad")]
    assert "R_B_G exp(0.01 turn_G)" in said["action_use"]


def test_the_command_prints_the_interface(run_dir, tmp_path, capsys):
    main([str(run_dir / "policy.npz"), "--out", str(tmp_path / "p.npz")])
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("one step every 20 ms; I inertial, B arm base")
    assert "observation[33..35]  p_EG_B   m     vector from the tool E to the goal G, in B" in lines
    assert lines[-1] == f"done: {tmp_path}/p.npz"
    assert [p.name for p in tmp_path.iterdir()] == ["p.npz"]


def poses(rng):
    """Goal and tool (4, 4) some centimetres and centiradians apart."""
    found = []
    for size in (1.0, 0.05):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(size * rng.normal(size=3)).as_matrix()
        pose[:3, 3] = size * rng.normal(size=3)
        found.append(pose)
    return found[0], found[0] @ found[1]


def pair(pose):
    return unpack_matrix(jnp.asarray(pose[:3, :3])), unpack(jnp.asarray(pose[:3, 3]), 3)


def test_observation_and_correction_are_the_environments(rng):
    for k in range(20):
        goal, tool = poses(rng)
        action = rng.normal(size=6) * (0.0 if k == 0 else 1.0)
        with jax.enable_x64(True):
            g, e = pair(goal), pair(tool)
            want = observe.observe(g, e, observe.tracking_error(g, e))
            rotation, position = correct(g, jnp.asarray(action))
        np.testing.assert_allclose(numpy_policy.observation(goal, tool), want, atol=1e-12)
        aim = numpy_policy.corrected_goal(goal, action)
        np.testing.assert_allclose(aim[:3, :3], np.array(rotation), atol=1e-9)
        np.testing.assert_allclose(aim[:3, 3], np.array(position), atol=1e-12)
        np.testing.assert_array_equal(aim[3], [0.0, 0.0, 0.0, 1.0])


def test_numpy_runner_is_one_short_file_without_jax(exported, tmp_path):
    source = numpy_policy.__file__
    with open(source) as file:
        assert len(file.readlines()) < 100
    shutil.copy(source, tmp_path)
    code = (
        "import sys, numpy_policy as n; p = n.Policy(sys.argv[1]); print(p.step(p._mean).shape, "
        "sorted({'jax', 'flax', 'mcx_jax', 'scipy'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, exported["npz"]],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout == "(6,) []\n", done.stderr


def test_numpy_runner_refuses_what_would_spoil_its_memory(exported, run_dir, tmp_path):
    runner = numpy_policy.Policy(exported["npz"])
    runner.step(MEAN)
    before = runner.state
    for bad in (MEAN[:37], np.where(np.arange(38) == 5, np.nan, MEAN)):
        with pytest.raises(ValueError, match="observation: 38 finite numbers are needed"):
            runner.step(bad)
    assert runner.state is before
    with np.load(exported["npz"]) as file:
        arrays = dict(file)
    said = json.loads(str(arrays.pop("interface")))
    old = tmp_path / "old.npz"
    np.savez(old, **arrays)
    with pytest.raises(ValueError, match="not an exported policy; use python -m mcx_jax.export"):
        numpy_policy.Policy(old)
    np.savez(old, interface=json.dumps({**said, "cell": "mlp"}), **arrays)
    with pytest.raises(ValueError, match="this runs lstm, gru, not mlp"):
        numpy_policy.Policy(old)


def test_the_pages_example_runs(repo_root, exported, tmp_path, monkeypatch, rng):
    page = (repo_root / "docs" / "export.md").read_text()
    blocks = re.findall(r"```py\n(.*?)```", page, re.DOTALL)
    (code,) = [block for block in blocks if "numpy_policy" in block]
    assert len(code.splitlines()) <= 10
    shutil.copy(exported["npz"], tmp_path / "policy.npz")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "numpy_policy", numpy_policy)
    sent, turns = [], iter([True, True, False])
    names = {"tracking": lambda: next(turns), "measure": lambda: poses(rng), "move_to": sent.append}
    exec(code, names)
    assert [x.shape for x in sent] == [(4, 4)] * 2


REFUSED = {
    "--out p.txt": "--out p.txt: the ending says the form: use one of .npz, .onnx, .stablehlo",
    "--out p": "--out p: the ending says the form: use one of .npz, .onnx, .stablehlo",
    "--out nowhere/p.npz": "--out nowhere/p.npz: no such directory",
    "--out taken.onnx": "--out taken.onnx: exists already; name another file, or remove it",
    "": (
        "--out is missing: File to write; its ending says the form: .npz, .onnx or .stablehlo. "
        "Must not exist."
    ),
}


def command(cwd, root, *arguments):
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(root)}
    return subprocess.run(
        [sys.executable, "-m", "mcx_jax.export", *arguments],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize("options", REFUSED)
def test_mistakes_are_told(options, run_dir, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken.onnx").write_text("precious")
    with pytest.raises(Exception) as error:
        main([str(run_dir), *options.split()])
    assert (type(error.value).__name__, str(error.value)) == ("UserError", REFUSED[options])
    assert [p.name for p in tmp_path.iterdir()] == ["taken.onnx"]
    assert (tmp_path / "taken.onnx").read_text() == "precious"


def test_no_such_run_is_one_line_and_exit_code_2(tmp_path, repo_root):
    done = command(tmp_path, repo_root, "nobody", "--out", "p.npz")
    assert done.returncode == 2 and not list(tmp_path.iterdir())
    assert done.stderr == (
        "error: no policy at nobody: train one (python -m mcx_jax.train), or name a policy .npz\n"
    )


def test_without_onnx_is_told(run_dir, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(Exception) as error:
        main([str(run_dir), "--out", str(tmp_path / "p.onnx")])
    assert str(error.value) == (f"--out {tmp_path}/p.onnx needs onnx: {extras.install('export')}")


@pytest.mark.parametrize("form", ["npz", "onnx", "stablehlo"])
def test_a_directory_that_cannot_be_written(form, run_dir, tmp_path, monkeypatch):
    def full(self, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.replace", full)
    with pytest.raises(Exception) as error:
        main([str(run_dir), "--out", f"{tmp_path}/p.{form}"])
    assert str(error.value) == (
        f"--out {tmp_path}/p.{form}: cannot be written: No space left on device"
    )
    assert not list(tmp_path.iterdir())


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, 0))
def drawn(motion, key):
    """Windows and goal of an episode in sea 0, as `V2VEnv.reset` draws them (calling that here
    would compile 10 s of settling)."""
    uniform = jax.random.uniform(key, (7,))
    return draw_track(motion, uniform[:4], 0), draw_goal(uniform[4:])


def both_worlds(policy, arm, delay, runner, count, steps):
    """Errors (2, steps, count) in m and rad of: the IK baseline in JAX, the policy in JAX, the
    NumPy runner on C MuJoCo."""
    config = EnvConfig(delay=delay, arm=arm, episode_steps=steps)
    env = make_env(config, MotionConfig(sea="Wd"), split="test")
    keys = jax.random.split(jax.random.key(3), count)
    compiled = jax.jit(run_episodes, compiler_options=arms.QUICK)
    seas, gain = jnp.zeros(2 * count, jnp.int32), jnp.repeat(jnp.array([0.0, 1.0]), count)
    found = compiled(env, PolicyController(policy), jnp.concatenate([keys, keys]), seas, gain)
    (dp, da, valid, *_), (track, goal_m) = jax.device_get((found, drawn(env.motion, keys)))
    assert valid.all()
    table_a, table_b = np.asarray(env.motion.knots_a), np.asarray(env.motion.knots_b)
    path = arm if arm.endswith(".xml") else moving_base.arm_path(arm)
    machine, errors = c_loop.Arm(path), []
    steer = lambda goal, tool: runner.step(numpy_policy.observation(goal, tool))  # noqa: E731
    for k in range(count):
        row, goal = track.table[k], goal_m[k].astype(np.float64)
        window = c_loop.Window(
            table_a[row], int(track.start_a[k]), table_b[row], int(track.start_b[k]), goal
        )
        runner.reset()
        aim = numpy_policy.corrected_goal
        errors.append(c_loop.episode(machine, config.delays[0], window, steer, aim, steps))
    in_jax = np.stack([dp, da])
    return in_jax[..., :count], in_jax[..., count:], np.stack(errors, axis=-1).swapaxes(0, 1)


def means(errors):
    """(2,) mm and mrad, as `evaluate` averages."""
    return 1e3 * errors[:, WARM_UP_STEPS:].mean(axis=(1, 2))


@pytest.fixture(scope="module")
def strong_arm(tmp_path_factory):
    """ur10e without force limits: at its limits the servo amplifies 1e-9 m to millimetres in 25
    steps, in C alone too; without them trajectories can be compared."""
    spec = mujoco.MjSpec.from_file(moving_base.arm_path("ur10e"))
    for actuator in spec.actuators:
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_FALSE
    path = tmp_path_factory.mktemp("arm") / "strong.xml"
    path.write_text(spec.to_xml())
    return str(path)


def test_steers_c_mujoco_along_the_same_trajectory(policy, exported, strong_arm):
    runner = numpy_policy.Policy(exported["npz"])
    ik, in_jax, in_c = both_worlds(policy, strong_arm, "B4_4", runner, count=2, steps=150)
    apart = np.abs(in_c - in_jax).max(axis=(1, 2))
    print(f"apart {apart[0]:.1e} m, {apart[1]:.1e} rad; mm, mrad: {means(in_jax)} of {means(ik)}")
    assert means(in_jax)[0] < 0.85 * means(ik)[0]
    assert apart[0] < 2e-5 and apart[1] < 2e-5


@pytest.mark.slow
def test_steers_the_papers_arm_in_c_mujoco_as_well_as_evaluate_says(policy, exported):
    """Its servo chatters under Euler, which is chaotic: means."""
    runner = numpy_policy.Policy(exported["npz"])
    ik, in_jax, in_c = both_worlds(policy, "paper", "E1", runner, count=3, steps=200)
    print(f"mm, mrad: ik {means(ik)}, evaluate {means(in_jax)}, C {means(in_c)}")
    assert means(in_jax)[0] < 0.85 * means(ik)[0]
    np.testing.assert_allclose(means(in_c), means(in_jax), rtol=0.05)
