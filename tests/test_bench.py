"""The bench's arithmetic and its contract; its speeds are nobody's test."""

import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mcx_jax.bench import __main__ as bench
from mcx_jax.bench import physics, program, startup_time, timing
from mcx_jax.config.training import preset_config
from mcx_jax.policy.networks import init_carry, init_params, unroll
from mcx_jax.ppo import trainer

CONTRACT = {
    "device",
    "versions",
    "physics",
    "ratio",
    "ratio_range",
    "xla_flags",
    "environment_steps_per_s",
    "rollout_steps_per_s",
    "training_steps_per_s",
    "learner_matmul_share",
    "compile_s",
}
ROWS = [
    {"engine": "c-rollout", "envs": 64, "steps_per_s": 3e5},
    {"engine": "c-batch", "envs": 2048, "steps_per_s": 4e5},
    {"engine": "mjx", "envs": 2048, "steps_per_s": 1e5},
    {"engine": "chain", "envs": 2048, "steps_per_s": 6e6},
    {"engine": "chain", "envs": 16384, "steps_per_s": 8e6},
]


def test_rivals_are_the_best_batches_of_chain_and_c_and_the_same_batch_of_mjx():
    assert bench.rivals(ROWS) == {
        "chain_over_c": (("chain", 16384), ("c-batch", 2048)),
        "chain_over_mjx": (("chain", 2048), ("mjx", 2048)),
    }


def test_a_ratio_is_measured_in_turn_and_as_often_as_asked(monkeypatch):
    """Ours takes 10 steps a call and theirs 1; seconds as listed."""
    seconds, order = iter([1.0, 2.0, 1.0, 5.0, 2.0, 1.0]), []

    def timed(call, repeats):
        order.append(call())
        return next(seconds)

    monkeypatch.setattr(physics, "median_s", timed)
    ours, theirs = physics.Work(lambda: "ours", 10), physics.Work(lambda: "theirs", 1)
    assert physics.ratios(ours, theirs, 3) == [20.0, 50.0, 5.0]
    assert order == ["ours", "theirs"] * 3


def test_the_matrix_rate_is_the_best_of_all_repeats_shapes_and_devices(monkeypatch):
    """Of 2 s and 1 s, and of the larger product, of 2 * 8^3 operations."""
    monkeypatch.setattr(program, "SHAPES", ((4, 4, 4), (8, 8, 8)))
    monkeypatch.setattr(program, "samples_s", lambda call, repeats: [2.0, 1.0])
    assert program.matmul_gflops() == pytest.approx(1e-9 * 2 * 8**3)


def test_learner_flops_are_those_that_xla_counts():
    """The formula against the compiler's own count of a gradient, which has the elementwise work
    too: a few percent at this width."""
    hidden, inputs, steps, rows = 256, 38, 4, 8
    net = trainer.networks_of(preset_config("fast").ppo, 6).policy.clone(hidden=hidden)
    params = init_params(net, jax.random.key(0), inputs)
    carry, obs = init_carry(net, (rows,)), jnp.ones((steps, rows, inputs))

    def loss(params):
        return jnp.sum(unroll(net, params, carry, obs)[1] ** 2)

    # One iteration of a loop counts once: take the sum over the steps by hand.
    counted = jax.jit(jax.grad(loss)).lower(params).compile().cost_analysis()["flops"]
    wanted = steps * rows * program.learner_flops(inputs, hidden, (6,))
    looped = 2 * steps * rows * 2 * 2 * hidden * 4 * hidden  # forward and back, inside the scans
    unlooped = wanted - looped + looped / steps
    assert counted == pytest.approx(unlooped, rel=0.1)


def test_every_engine_takes_the_same_start():
    model = physics.load_mujoco("paper")
    q, ctrl = physics.start(model, 3)
    assert q.shape == (3, 6) and ctrl.shape == (3, 12)
    np.testing.assert_array_equal(ctrl[:, :6], q)
    np.testing.assert_array_equal(ctrl[:, 6:], 0.0)


@pytest.mark.parametrize("engine", ["c-rollout", "c-batch", "chain"])
def test_engines_run(engine, monkeypatch):
    monkeypatch.setattr(timing, "MIN_S", 0.0)
    monkeypatch.setattr(physics, "LARGE_STEPS", 1)
    assert physics.ENGINES[engine](2).steps_per_s(1) > 0


@pytest.mark.parametrize(("learner", "share"), [(50.0, 0.5), (125.0, 1.0)])
def test_quick_writes_the_contract(learner, share, monkeypatch, tmp_path):
    speed = program.TrainingSpeed(1.0, 2.0, 3.0, learner)
    monkeypatch.setattr(physics.Work, "steps_per_s", lambda self, _: self.steps)
    engines = {
        name: lambda _: physics.Work(print, 10) for name in ("c-rollout", "c-batch", "mjx", "chain")
    }
    monkeypatch.setattr(physics, "ENGINES", engines)
    monkeypatch.setattr(program, "environment_us", lambda *_: 5.0)
    monkeypatch.setattr(program, "training_speed", lambda *_: speed)
    monkeypatch.setattr(program, "matmul_gflops", lambda: 100.0)
    monkeypatch.setattr(program, "reset", lambda *_: None)
    out, plot = tmp_path / "bench.json", tmp_path / "bench.png"
    bench.main(["--quick", "--json", str(out), "--plot", str(plot)])
    figures = json.loads(out.read_text())
    assert set(figures) >= CONTRACT
    assert figures["environment_steps_per_s"] == 2e5
    assert figures["learner_matmul_share"] == share  # never above 1
    assert figures["ratio_range"]["chain_over_c"] == [1.0, 1.0]
    assert {row["engine"] for row in figures["physics"]} == set(engines)
    assert plot.stat().st_size > 10_000


@pytest.mark.parametrize(
    "words, message",
    [
        (["--json", "nowhere/b.json"], "--json nowhere/b.json: no such directory"),
        (["--json", "."], "--json .: is a directory; name a file"),
        (["--plot", "b.gif"], "--plot b.gif: the name must end in .png or .svg"),
    ],
)
def test_refusals_come_before_any_work(words, message, monkeypatch):
    monkeypatch.setattr(bench, "run", None)
    with pytest.raises(bench.UserError, match=message):
        bench.main(words)


def test_a_training_command_that_fails_is_reported(monkeypatch, tmp_path):
    real = subprocess.Popen

    def broken(command, **options):
        return real(
            [sys.executable, "-c", "print('error: no luck'); raise SystemExit(2)"], **options
        )

    monkeypatch.setattr(startup_time.subprocess, "Popen", broken)
    with pytest.raises(bench.UserError, match="gave no metrics: error: no luck"):
        startup_time.first_metrics_s()
