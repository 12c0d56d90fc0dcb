"""What a training run shows: the line of progress beside table 3, and TensorBoard's event files."""

import io
import json
import os
import signal
import struct
import time
from dataclasses import replace

import pytest
from probe_envs import make_probe
from tensorboardX.proto.event_pb2 import Event, SessionLog

from mcx_jax import extras
from mcx_jax.compute import startup
from mcx_jax.config.task import ConditionsConfig, EnvConfig, MotionConfig
from mcx_jax.config.training import preset_config
from mcx_jax.evaluation.statistics import paper_means
from mcx_jax.runs.loop import train
from mcx_jax.runs.progress import Progress, references
from mcx_jax.runs.run_dir import open_existing, open_new
from mcx_jax.train import main

FAST = preset_config("fast")
TINY = replace(
    FAST,
    num_envs=8,
    total_steps=8 * 8 * 4,
    env=EnvConfig(episode_steps=16),
    ppo=replace(FAST.ppo, window_steps=8, sequence_steps=4, minibatches=2, hidden=8),
)
ROW = {"iteration": 3, "steps": 196608, "pos_error_mm": 2.3456, "ang_error_mrad": 1.2345}


def _config(delay="B4_4", sea="all", **motion):
    return replace(
        FAST, env=EnvConfig(delay, episode_steps=1024), motion=MotionConfig(sea=sea, **motion)
    )


def test_means_over_the_seas():
    # Table 3, E0: (0.93 + 1.40 + 1.82 + 2.18) / 4 and so on, by hand.
    assert paper_means("ik", "E0", "all") == pytest.approx((1.5825, 1.695))
    assert paper_means("paper", "E0", "all") == pytest.approx((0.4825, 0.645))
    assert paper_means("paper", "E0", "Wb") == (0.42, 0.57)
    assert paper_means("ik", "E3", "all") is None and paper_means("ik", "E0", "3:11") is None


@pytest.mark.parametrize(
    "config",
    [
        _config("E3"),
        _config(sea="3.0:11"),
        _config(coupled=True),
        _config(motion="waves.npy"),
        replace(FAST, env=EnvConfig(arm="ur10e", episode_steps=1024)),
        replace(FAST, env=EnvConfig(integrator="mixed", episode_steps=1024)),
        replace(FAST, env=EnvConfig(episode_steps=1024, conditions=ConditionsConfig("0:3"))),
    ],
)
def test_no_reference_where_table_3_has_none(config):
    assert references(config) == ""


def test_errors_of_training_and_the_papers_are_named_for_what_they_are():
    out = io.StringIO()
    Progress(_config(), 0, out).begin()
    said = " ".join(out.getvalue().split())
    assert "dp, da: errors of training episodes, with exploration" in said
    # Table 3, B4_4, means over the four seas.
    assert said.endswith(
        "its trained agents 0.71 mm 0.73 mrad, the baseline that they imply 5.88 mm 4.72 mrad"
    )
    Progress(_config("E3"), 0, out := io.StringIO()).begin()
    assert "table 3" not in out.getvalue()


def test_line_says_how_far_and_how_good():
    line = Progress(_config(), start_iteration=0, out=io.StringIO()).line([ROW])
    assert line.startswith("3/306 | ETA ")
    assert " | training dp 2.35 mm | da 1.23 mrad | 0.20 M steps | " in line
    assert "\n" not in line and "sigma" not in line
    assert line.endswith("/s") and "IK" not in line
    assert Progress(_config(), 0).line([{**ROW, "sigma": 0.3}]).endswith(" | sigma 0.300")
    several = [{**ROW, "pos_error_mm": x} for x in (3.0, 2.0, 4.0)]
    line = Progress(replace(_config("E3"), seeds=3), 0).line(several)
    assert " | training dp 2.00 to 4.00 mm | da 1.23 mrad | " in line


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize("columns", [20, 40, 80, 120])
def test_line_fits_the_terminal_and_keeps_its_end_of_time(columns, monkeypatch):
    """At 80 columns the ETA used to be cut off; what does not fit is left out whole."""
    monkeypatch.setenv("COLUMNS", str(columns))
    worst = {**ROW, "pos_error_mm": 123.456, "ang_error_mrad": 1234.5, "sigma": 0.3}
    best = {**worst, "pos_error_mm": 2.0, "ang_error_mrad": 3.0}
    rows = [{**row, "rejected_share": 0.0} for row in (worst, *7 * [best])]
    config, out = replace(_config(), seeds=8), Terminal()
    Progress(config, 0, out, begun=time.monotonic() - 9000).show(rows)
    line = out.getvalue().removeprefix("\r\x1b[K")
    assert len(line) < columns
    parts = line.split(" | ")
    assert parts[0] == "3/306"
    whole = ["da 3.00 to 1234.50 mrad", " M steps", "/s", "sigma 0.300"]  # what may come at the end
    assert all(part.endswith(end) for part, end in zip(parts[3:], whole, strict=False))
    if columns >= 40:
        assert parts[1].startswith("ETA ") and parts[1].endswith(" min")
    if columns >= 80:
        assert parts[2] == "training dp 2.00 to 123.46 mm"
    if columns >= 120:
        assert len(parts) == 7


def test_a_warning_does_not_stick_to_the_line_of_progress(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    progress = Progress(_config(), 0, out := Terminal())
    for share in (0.0, 0.9):
        progress.show([{**ROW, "rejected_share": share}])
    assert "\r\x1b[Kwarning: 90 % of the windows" in out.getvalue()


def test_a_terminal_is_not_empty_during_the_first_iteration(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    Progress(_config(), 4, out := Terminal()).begin()
    assert out.getvalue().splitlines()[-1] == "4/306 | first iteration"
    assert max(map(len, out.getvalue().splitlines())) <= 80
    Progress(_config(), 306, out := Terminal()).begin()
    assert out.getvalue() == ""  # nothing left to do


def _make_env(env_config, motion_config, split):
    return make_probe(scale=0.01)


def _events(path):
    """Events of a file: records of length (8 bytes), its checksum (4), data, checksum (4)."""
    content, at = path.read_bytes(), 0
    while at < len(content):
        (size,) = struct.unpack_from("<Q", content, at)
        yield Event.FromString(content[at + 12 : at + 12 + size])
        at += size + 16


def _curves(run):
    """{tag: [(step, value)]} as TensorBoard shows them: a start hides what is at or after it."""
    curves = {}
    for file in sorted(run.glob("events.out.tfevents.*")):
        for event in _events(file):
            if event.session_log.status == SessionLog.START:
                for points in curves.values():
                    points[:] = [point for point in points if point[0] < event.step]
            for value in event.summary.value:
                curves.setdefault(value.tag, []).append((event.step, value.simple_value))
    return curves


def _stop_at(monkeypatch, iteration):
    show = Progress.show

    def show_and_stop(self, rows):
        show(self, rows)
        if rows[0]["iteration"] == iteration:
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(Progress, "show", show_and_stop)


def test_event_files_hold_every_point_once(tmp_path, monkeypatch):
    path = tmp_path / "run"
    with monkeypatch.context() as patch, pytest.raises(SystemExit):
        _stop_at(patch, 2)
        train(open_new(path, TINY), _make_env, events=True)
    assert [step for step, _ in _curves(path)["reward"]] == [64, 128]
    # As if killed after an iteration beyond the checkpoint: that one will be written again.
    with monkeypatch.context() as patch:
        patch.setattr("mcx_jax.runs.loop.save", lambda run, state, rows: _no_save())
        with pytest.raises(RuntimeError, match="killed"):
            train(open_existing(path, TINY), _make_env, events=True)
    train(open_existing(path, TINY), _make_env, events=True)
    rows = [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
    curves = _curves(path)
    assert {*curves, "iteration", "steps", "seed", "wall_s"} == set(rows[0])
    for tag, points in curves.items():
        assert [step for step, _ in points] == [64, 128, 192, 256], tag
        assert [value for _, value in points] == pytest.approx(
            [row[tag] for row in rows], rel=1e-6, nan_ok=True
        ), tag


def _no_save():
    raise RuntimeError("killed")


@pytest.mark.slow
def test_several_seeds_have_curves_of_their_own(tmp_path):
    train(open_new(tmp_path / "run", replace(TINY, seeds=2, seed=5)), _make_env, events=True)
    curves = _curves(tmp_path / "run")
    assert {"seed5/reward", "seed6/reward"} <= set(curves)
    assert [step for step, _ in curves["seed6/reward"]] == [64, 128, 192, 256]


def test_no_event_file_unless_asked(tmp_path):
    train(open_new(tmp_path / "run", TINY), _make_env)
    assert not list((tmp_path / "run").glob("events*"))


def test_missing_package_is_told_at_once(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(SystemExit) as stop:
        startup.run_command(lambda: main(["--tensorboard"]))
    assert stop.value.code == 2
    assert capsys.readouterr().err == (
        f"error: --tensorboard needs tensorboardX: {extras.install('viz')}\n"
    )
    assert not list(tmp_path.iterdir())
