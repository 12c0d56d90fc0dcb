"""Evaluation: the same episodes for everyone, the same numbers twice, the JSON's form."""

import dataclasses
import json
import os
import subprocess
import sys

import numpy as np
import pytest

from mcx_jax.config.task import EnvConfig, MotionConfig
from mcx_jax.controllers.by_name import load_controller
from mcx_jax.controllers.classical import CLASSICAL
from mcx_jax.errors import UserError
from mcx_jax.evaluate import EvaluateConfig, evaluate, evaluate_beside_ik
from mcx_jax.evaluation.statistics import GROUPS, WARM_UP_STEPS

# 20 steps count after the first second; implicitfast, so that rounding grows little.
SHORT = EnvConfig(delay="E2", integrator="implicitfast", episode_steps=70)
SEAS = MotionConfig(sea="all")
EPISODES = 3


def run(who, env=SHORT, **options):
    return evaluate(who, CLASSICAL[who], env, SEAS, episodes=EPISODES, **options)


@pytest.fixture(scope="module")
def ik_rows():
    return run("ik", seed=0)


@pytest.fixture(scope="module")
def with_preview():
    """(rows of ik, rows of preview) of one call."""
    preview = CLASSICAL["preview"]
    return evaluate_beside_ik("preview", preview, SHORT, SEAS, episodes=EPISODES, seed=0)


def test_one_row_a_sea_in_the_contracts_form(ik_rows):
    assert [row["sea"] for row in ik_rows] == ["Wa", "Wb", "Wc", "Wd"]
    for row in ik_rows:
        assert list(row) == [
            *("who", "delay", "sea", "episodes", "invalid_episodes", "pos_mm", "ang_mrad"),
            *("correction", "torque_share", "strain", "improvement"),
        ]
        assert (row["who"], row["delay"], row["episodes"]) == ("ik", "E2", EPISODES)
        assert row["invalid_episodes"] == 0
        assert row["strain"]["steps"] == EPISODES * (SHORT.episode_steps - WARM_UP_STEPS)
        assert row["strain"]["out_of_reach"] == 0
        for unit in ("pos_mm", "ang_mrad"):
            stats = row[unit]
            assert list(stats) == ["mean", "std", "top5", "top1", "max"]
            assert 0 < stats["mean"] < stats["top5"] <= stats["top1"] <= stats["max"]
        # 40 ms of delay in waves: millimetres, not metres and not micrometres (table 3: 4 to 10).
        assert 0.5 < row["pos_mm"]["mean"] < 30


def test_the_baseline_improves_on_itself_by_nothing(ik_rows):
    for row in ik_rows:
        nothing = dict.fromkeys(GROUPS, 0.0)
        assert row["improvement"] == {"pos": nothing, "ang": nothing}


def test_same_seed_same_json(ik_rows):
    assert json.dumps(run("ik", seed=0)) == json.dumps(ik_rows)
    other = run("ik", seed=1)
    assert [row["pos_mm"] for row in other] != [row["pos_mm"] for row in ik_rows]


def test_rough_seas_are_worse(ik_rows):
    """The same windows and goals in every sea: only the waves differ."""
    means = [row["pos_mm"]["mean"] for row in ik_rows]
    assert means[0] < means[3], means


def test_preview_beats_the_baseline_and_says_by_how_much(ik_rows, with_preview):
    for base, ours in zip(*with_preview, strict=True):
        gain = 1 - ours["pos_mm"]["mean"] / base["pos_mm"]["mean"]
        assert ours["improvement"]["pos"]["all"] == pytest.approx(gain, rel=1e-12)
        assert gain > 0.5, (ours["sea"], gain)
    assert all(row["improvement"]["pos"]["max"] == 0.0 for row in ik_rows), "baseline untouched"


@pytest.mark.slow
def test_a_command_in_its_own_process_gives_the_same_json(ik_rows, tmp_path):
    out = tmp_path / "rows.json"
    options = ["--delay", "E2", "--integrator", "implicitfast", "--episode-steps", "70"]
    done = command("ik", *options, "--episodes", str(EPISODES), "--json", str(out))
    assert done.returncode == 0, done.stderr
    assert "E2: explicit delay of 2 control steps = 40 ms" in done.stdout
    assert "compiling (up to 2 min the first time) and running 12 episodes\n" in done.stdout
    got = json.loads(out.read_text())
    assert [row["sea"] for row in got] == [row["sea"] for row in ik_rows]
    for a, b in zip(got, ik_rows, strict=True):
        for unit in ("pos_mm", "ang_mrad"):
            # Another process may have compiled other vector code: float32 of 1e-3 mm.
            np.testing.assert_allclose(
                list(a[unit].values()), list(b[unit].values()), rtol=0, atol=5e-3
            )


def command(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "mcx_jax.evaluate", *arguments],
        capture_output=True,
        text=True,
        env={**os.environ, "JAX_PLATFORMS": "cpu"},
        timeout=300,
        check=False,
    )


def test_a_wrong_who_is_one_line():
    done = command("nobody", "--delay", "E0")
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1] == (
        "error: unknown controller 'nobody': use ik, extrapolate, extrapolate-best, fir, preview, "
        "shipped:DELAY, a run directory or a policy .npz"
    )
    assert "Traceback" not in done.stderr


def test_named_controllers():
    assert [load_controller(who)[0] for who in ("ik", "extrapolate", "preview")] == list(CLASSICAL)
    with pytest.raises(UserError, match="unknown controller 'IK'"):
        load_controller("IK")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"episodes": 0}, "--episodes 0: must be a positive integer"),
        ({"seed": -1}, "--seed -1: must be 0 or a positive integer"),
    ],
)
def test_settings_that_are_refused(change, message):
    with pytest.raises(UserError) as error:
        dataclasses.replace(EvaluateConfig(who="ik"), **change)
    assert str(error.value) == message


def test_episodes_without_a_rate_after_the_warm_up_are_refused():
    with pytest.raises(UserError) as error:
        run("ik", dataclasses.replace(SHORT, episode_steps=51))
    assert str(error.value) == (
        "--episode-steps 51: the first 50 steps are not counted; evaluate at least 52"
    )


def test_shipped_policies_are_there_for_the_papers_delays():
    from mcx_jax.config.delay import NAMED_DELAYS
    from mcx_jax.policy.file import load_run

    for delay in NAMED_DELAYS:
        name, controller = load_controller(f"shipped:{delay}")
        assert name == f"shipped:{delay}" and controller.policy.meta.action_size == 6
        assert delay in load_run(f"shipped:{delay}").meta.interface["trained_for"]["delay"]
    with pytest.raises(UserError, match="shipped:E7: no such policy is shipped; use one of .*B4_4"):
        load_controller("shipped:E7")


def test_a_policy_sees_the_age_of_measurements_or_not():
    """`shipped:robust` has learnt with it (39 numbers); where it is not observed it is 0."""
    sizes = {name: load_controller(f"shipped:{name}")[1] for name in ("robust", "E1")}
    ideal, late = np.arange(1.0, 39.0), np.append(np.arange(1.0, 39.0), 0.06)
    for name, obs, want in (
        ("robust", late, late),
        ("robust", ideal, np.append(ideal, 0.0)),
        ("E1", late, ideal),
        ("E1", ideal, ideal),
    ):
        np.testing.assert_array_equal(sizes[name]._seen(obs), np.float32(want))
