"""A run that is killed and gone on with ends as one that never was; nobody disturbs a run."""

import errno
import json
import os
import random
import signal
import subprocess
import sys

import numpy as np
import pytest
from test_train_command import CONFIG, _contents, _make_env

from mcx_jax.compute import startup
from mcx_jax.errors import UserError
from mcx_jax.runs import checkpoint
from mcx_jax.runs.loop import train
from mcx_jax.runs.run_dir import RunDir, open_existing, open_new


@pytest.fixture(scope="module")
def lives(repo_root, tmp_path_factory):
    """Lives of a run: (name, cores, kinds of lives) -> what `lives.py` prints. The programs are
    compiled once, by the first process."""
    folder = tmp_path_factory.mktemp("lives")
    path = os.pathsep.join([str(repo_root), str(repo_root / "tests")])
    cache = {"MCX_JAX_CACHE": str(folder / "cache"), "XLA_FLAGS": "", "PYTHONPATH": path}

    def run(name, cores, kinds):
        command = [sys.executable, str(repo_root / "tests" / "lives.py"), str(folder / name)]
        done = subprocess.run(
            [*command, str(cores), *kinds],
            env={**os.environ, **cache},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return [json.loads(line) for line in done.stdout.splitlines()]

    return run


@pytest.fixture(scope="module")
def whole(lives):
    """The end of a run that was never killed."""
    life, end = lives("whole", 1, ["end"])
    assert life["code"] == 0 and end["iteration"] == len(end["rows"]) == 100
    return end


@pytest.mark.slow
def test_killed_twenty_times(lives, whole):
    """12 kills at operations on files (a checkpoint is 50 to 70 of them), 12 at random times (an
    iteration and its checkpoint take 0.1 to 0.2 s; the run is long enough for a machine four times
    as fast)."""
    draw = random.Random(20230207)
    kinds = [f"event:{draw.randint(1, 100)}" for _ in range(12)]
    kinds += [f"after:{draw.uniform(0.0, 0.5):.3f}" for _ in range(12)]
    draw.shuffle(kinds)
    *killed, last, end = lives("killed", 1, [*kinds, "end"])
    codes = [life["code"] for life in killed]
    assert codes.count(-signal.SIGKILL) >= 20, codes
    done = [life["checkpoint"] or 0 for life in killed]
    assert done == sorted(done) and done[-1] > 5, done  # every life stands on the one before
    assert last["code"] == 0
    assert end == whole


@pytest.mark.slow
def test_gone_on_with_on_another_number_of_devices(lives, whole):
    """The same but for the order of sums: 1e-7 at first, which the Adam steps amplify."""
    stopped, _ = lives("both", 1, ["term:3"])
    finished, both = lives("both", 2, ["end"])
    assert stopped == {"code": 128 + signal.SIGTERM, "checkpoint": 3}
    assert finished["code"] == 0 and (whole["devices"], both["devices"]) == (1, 2)
    assert [row["iteration"] for row in both["rows"]] == list(range(1, 101))
    assert both["rows"][:3] == whole["rows"][:3]
    for ours, theirs in zip(both["rows"][3:8], whole["rows"][3:8], strict=True):
        for name, value in theirs.items():
            if name != "first_ratio_deviation":  # itself a rounding
                np.testing.assert_allclose(ours[name], value, rtol=2e-3, atol=1e-4, err_msg=name)


def test_one_process_a_run(tmp_path, capsys):
    path = tmp_path / "run"
    first, second = open_new(path, CONFIG), open_new(path, CONFIG)
    message = f"{path}: another process is training here; wait for it, or name another --run-dir"
    with first.held():
        with pytest.raises(UserError) as error, second.held():
            pass
        assert str(error.value) == message
        first.create()
        # A process of its own, as a user would start it; it is refused before it compiles.
        done = subprocess.run(
            [sys.executable, "-m", "mcx_jax.train", "--run-dir", str(path), "--resume"],
            capture_output=True,
            text=True,
            check=False,
        )
        assert (done.returncode, done.stderr) == (2, f"error: {message}\n")
    with second.held():
        pass


def test_a_file_system_without_locks(tmp_path, monkeypatch):
    def refuse(*args):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr("fcntl.flock", refuse)
    with pytest.raises(UserError, match=r"cannot lock files \(No locks available\); name a"):
        train(open_new(tmp_path / "run", CONFIG), _make_env)


def test_started_twice_at_the_same_time(tmp_path):
    """Both saw an empty directory; the second comes when the first has been there and gone."""
    path = tmp_path / "run"
    slow = open_new(path, CONFIG)
    train(open_new(path, CONFIG), _make_env)
    before = _contents(path)
    with pytest.raises(UserError, match="another process has trained here meanwhile"), slow.held():
        pass
    assert _contents(path) == before


def test_killed_before_there_was_a_configuration(tmp_path):
    path = tmp_path / "run"
    with open_new(path, CONFIG).held():
        (path / ".config.json.partial").write_text("{")
    assert open_new(path, CONFIG).start_iteration == 0


@pytest.mark.parametrize("what", ["append", "policy", "create"])
def test_disk_full_while_training(what, tmp_path, monkeypatch, capsys):
    """One line, exit 2; the checkpoint before is whole, and the run goes on from it."""
    path = tmp_path / "run"
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def fails(*args, **kwargs):
        raise full

    append = RunDir.append
    with monkeypatch.context() as patch:

        def append_until(self, rows):
            if rows[0]["iteration"] == 3:
                patch.setattr(os, "fsync", fails)
            append(self, rows)

        if what == "create":
            patch.setattr("mcx_jax.runs.run_dir._write_whole", fails)
        elif what == "policy":
            patch.setattr("mcx_jax.policy.file.write_whole", fails)
        else:
            patch.setattr(RunDir, "append", append_until)
        with pytest.raises(SystemExit) as stop:
            startup.run_command(
                lambda: train(open_new(path, CONFIG), _make_env, checkpoint_interval_s=0.0)
            )
    assert stop.value.code == 2
    assert capsys.readouterr().err == (
        f"error: {path}: cannot be written (No space left on device); fix this, then continue with "
        "--resume\n"
    )
    assert checkpoint.latest(path) == (2 if what == "append" else None)
    if what == "append":
        train(open_existing(path, CONFIG), _make_env)
        assert checkpoint.latest(path) == CONFIG.iterations


def test_read_only_directory(tmp_path, monkeypatch):
    """As root every directory can be written: the refusal of the system is played."""
    path = tmp_path / "run"
    train(open_new(path, CONFIG), _make_env)
    before = _contents(path)
    run = open_existing(path, CONFIG)

    def refuse(self, *args, **kwargs):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(type(path), "open", refuse)
    with pytest.raises(UserError) as error:
        train(run, _make_env)
    monkeypatch.undo()
    assert str(error.value) == (
        f"{path}: cannot be written (Read-only file system); fix this, then continue with --resume"
    )
    assert _contents(path) == before
