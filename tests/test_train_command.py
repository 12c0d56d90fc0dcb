"""`python -m mcx_jax.train`: mistakes before anything is written, and exact resuming.

Training runs on a probe environment here; the whole path with the real one is the smoke test.
"""

import functools
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from probe_envs import make_probe
from test_output import LOST, REASONS

from mcx_jax.compute import startup
from mcx_jax.config import command_line
from mcx_jax.config.task import EnvConfig
from mcx_jax.config.training import TrainConfig, preset_config
from mcx_jax.console import command
from mcx_jax.console.streams import Guarded
from mcx_jax.errors import UserError
from mcx_jax.policy.file import load_policy
from mcx_jax.runs import checkpoint
from mcx_jax.runs.loop import first_policy, rest, rounded_up, table_line, train
from mcx_jax.runs.programs import prepare
from mcx_jax.runs.progress import Progress, short_time
from mcx_jax.runs.run_dir import RunDir, default_path, open_existing, open_new
from mcx_jax.runs.stop import StopRequest
from mcx_jax.train import compile_quickly, main, read_command

CONFIG = replace(
    preset_config("fast"),
    num_envs=8,
    total_steps=8 * 8 * 4,
    env=EnvConfig(episode_steps=16),
    ppo=replace(
        preset_config("fast").ppo, window_steps=8, sequence_steps=4, minibatches=2, hidden=8
    ),
)


def _make_env(env_config, motion_config, split):
    assert split == "train"
    return make_probe(scale=0.01)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run of four iterations that was not interrupted."""
    path = tmp_path_factory.mktemp("finished") / "run"
    train(open_new(path, CONFIG), _make_env)
    return path


def _contents(path):
    return {p: p.read_bytes() for p in sorted(path.rglob("*")) if p.is_file()}


@functools.cache
def _like(config):
    return prepare(config, make_probe(scale=0.01)).like


def _state(path, config):
    return checkpoint.restore(path, _like(config))


def _assert_same_run(one, other, config):
    rows = [
        [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
        for path in (one, other)
    ]
    for row in rows[0] + rows[1]:
        row.pop("wall_s")
    assert rows[0] == rows[1]
    a, b = _state(one, config), _state(other, config)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        if jax.numpy.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        np.testing.assert_array_equal(x, y)


def test_what_a_run_writes(finished, capsys):
    names = sorted(p.name for p in finished.iterdir())
    assert names == [".lock", "checkpoints", "config.json", "metrics.jsonl", "policy.npz"]
    stored = command_line.config_from_json(TrainConfig, (finished / "config.json").read_text())
    assert stored == CONFIG
    rows = [json.loads(line) for line in (finished / "metrics.jsonl").read_text().splitlines()]
    assert [row["iteration"] for row in rows] == [1, 2, 3, 4]
    assert [row["steps"] for row in rows] == [64, 128, 192, 256]
    assert {"seed", "pos_error_mm", "ang_error_mrad", "kl", "sigma", "wall_s"} <= set(rows[0])
    assert load_policy(finished / "policy.npz").meta.iteration == 4


def test_stopped_and_resumed_is_never_stopped(finished, tmp_path, monkeypatch, capsys):
    show = Progress.show

    def show_and_interrupt(self, rows):
        show(self, rows)
        if rows[0]["iteration"] == 2:
            os.kill(os.getpid(), signal.SIGTERM)

    path = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(Progress, "show", show_and_interrupt)
        with pytest.raises(SystemExit) as stop:
            train(open_new(path, CONFIG), _make_env)
    assert stop.value.code == 128 + signal.SIGTERM
    assert checkpoint.latest(path) == 2
    assert f"--run-dir {path} --resume" in capsys.readouterr().out
    # A row after the checkpoint, and one cut short, as a killed process leaves them.
    with (path / "metrics.jsonl").open("a") as file:
        file.write('{"iteration": 3, "wall_s": 0.0}\n{"iterat')
    train(open_existing(path, CONFIG), _make_env)
    _assert_same_run(path, finished, CONFIG)


def _at_iterations(monkeypatch, *actions):
    """Call an action with the run's progress after iteration 1, 2, ..."""
    show = Progress.show

    def show_and_act(self, rows):
        show(self, rows)
        actions[rows[0]["iteration"] - 1]()

    monkeypatch.setattr(Progress, "show", show_and_act)


def _same_policy(one, other):
    return (one / "policy.npz").read_bytes() == (other / "policy.npz").read_bytes()


def test_no_state_of_the_output_changes_a_run(finished, tmp_path, monkeypatch):
    """All kinds of a lost standard output in one run, another one in every iteration."""
    path, show = tmp_path / "run", Progress.show
    lost = [Guarded(kind(), "standard output") for kind in LOST.values()]

    def lose_and_show(self, rows):
        self.out = lost[rows[0]["iteration"] - 1]
        self.printed = -1e9  # whatever the interval
        monkeypatch.setattr(sys, "stdout", self.out)
        show(self, rows)

    monkeypatch.setattr(Progress, "show", lose_and_show)
    train(open_new(path, CONFIG), _make_env)
    _assert_same_run(path, finished, CONFIG)
    assert _same_policy(path, finished)
    said = (path / "messages.log").read_text().splitlines()
    assert [line.split(" ", 2)[2] for line in said] == [
        f"standard output cannot be written ({why}); the work goes on" for why in REASONS
    ]


def test_a_directory_that_is_renamed_moved_and_deleted(finished, tmp_path, monkeypatch, capsys):
    """The run follows it, from a relative name, and saves all that it has; Ctrl-C in the last
    iteration leaves the table out, and says so."""
    monkeypatch.chdir(tmp_path)
    first, second = tmp_path / "run", tmp_path / "deep" / "new name"

    def rename():
        second.parent.mkdir()
        first.rename(second)

    def delete():
        # Saved because it had moved, long before the interval is over.
        assert {"metrics.jsonl", "policy.npz", "checkpoints"} <= set(os.listdir(second))
        shutil.rmtree(second.parent)

    (tmp_path / "other").mkdir()
    leave = functools.partial(os.chdir, tmp_path / "other")
    stop = functools.partial(os.kill, os.getpid(), signal.SIGTERM)
    with monkeypatch.context() as patch:
        _at_iterations(patch, rename, leave, delete, stop)
        with pytest.raises(SystemExit) as stopped:
            train(open_new(Path("run"), CONFIG), _make_env)
    assert stopped.value.code == 128 + signal.SIGTERM
    _assert_same_run(second, finished, CONFIG)
    assert _same_policy(second, finished)
    out = capsys.readouterr().out.splitlines()
    said = [
        f"{first} is now {second}: the run goes on there",
        f"{second} is gone: the run goes on in {second}, and is saved there at once",
    ]
    assert [line for line in out if line in said] == said
    assert (second / "messages.log").read_text().rstrip().endswith(said[1])
    assert out[-2:] == [
        "saved after iteration 4 of 4; make the table with:",
        shlex.join([*_python(), "-m", "mcx_jax.evaluate", str(second)]),
    ]
    assert open_existing(second, CONFIG).start_iteration == 4


def test_another_directory_in_the_place_of_the_deleted_one(tmp_path):
    run = open_new(tmp_path / "run", CONFIG)
    with run.held():
        run.create()
        run.append([{"iteration": 1}])
        shutil.rmtree(run.path)
        run.path.mkdir()
        assert run.append([{"iteration": 2}]) and run.path == tmp_path / "run-2"
        assert [row["iteration"] for row in run.last_rows(9)] == [1, 2]
        with pytest.raises(UserError, match="another process"), RunDir(run.path, CONFIG).held():
            pass


def _python():
    """The interpreter in a printed command: `python` where that is this one."""
    return shlex.split(command.line("train"))[:1]


def test_a_printed_command_works_as_printed(tmp_path, monkeypatch):
    """Where `python` is another one or none (`make train`), and for names of several words."""
    ours = tmp_path / "python"
    ours.touch(mode=0o755)
    monkeypatch.setattr(sys, "executable", str(ours))
    for path, python in ((tmp_path, "python"), (tmp_path / "none", str(ours))):
        monkeypatch.setenv("PATH", str(path))
        assert command.line("train", "--run-dir", "a b") == (
            f"{python} -m mcx_jax.train --run-dir 'a b'"
        )


FLAGS = ["--smoke", "--device", "cpu", "--tensorboard", "--checkpoint-interval-s", "5.0"]


def test_the_command_that_resumes_has_the_flags_of_the_run(tmp_path):
    """Without --smoke it would compile at another optimisation level."""
    command, run = read_command([*FLAGS, "--run-dir", str(tmp_path / "a b")])
    with run.held():
        run.create()
    words = shlex.split(run.resume_line)
    assert words[1:3] == ["-m", "mcx_jax.train"]
    again, resumed = read_command(words[3:])
    assert again == replace(command, resume=True) and resumed.options == run.options
    assert rest(resumed) == f"there is no checkpoint yet; begin again with:\n{run.resume_line}"
    (run.path / "checkpoints" / "7").mkdir(parents=True)
    assert rest(run) == f"go on from iteration 7 with:\n{run.resume_line}"
    assert rest(RunDir(tmp_path, CONFIG)) == "the run had not begun, nothing is saved"


def test_the_command_that_makes_the_table_is_of_the_runs_task(tmp_path):
    """Its delay, seas and conditions, which `evaluate` does not read from a run."""
    from mcx_jax.evaluate import EvaluateConfig

    flags = ["--smoke", "--delay", "E1", "--noise-mm", "0:3", "--sea", "Wd", "--coupled"]
    _, run = read_command([*flags, "--run-dir", str(tmp_path / "run")])
    asked = command_line.parse(EvaluateConfig, shlex.split(table_line(run))[3:], prog="evaluate")
    assert asked.who == str(run.path)
    assert asked.env == replace(run.config.env, episode_steps=1000)
    assert asked.motion == replace(run.config.motion, sea="all")


def test_steps_that_are_no_whole_number_of_iterations_are_rounded_up_aloud():
    config = replace(preset_config("fast"), num_envs=2048, total_steps=300_000)
    assert rounded_up(config) == (
        "--total-steps 300,000 is rounded up to 327,680: 5 iterations of 65,536 steps"
    )


@pytest.mark.parametrize("name", ["lost", "reward", "seed"])
def test_a_row_without_a_number_that_is_needed(name, finished, tmp_path, capsys):
    path = tmp_path / "run"
    shutil.copytree(finished, path)
    rows = [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
    del rows[2][name]
    (path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert _refused(["--run-dir", str(path), "--resume"], capsys) == (
        f"{path / 'metrics.jsonl'}: the row of iteration 3 has no number {name!r}; put it back, or "
        "take the line out"
    )


@pytest.mark.parametrize("seeds", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_start_from_a_policy(finished, tmp_path, seeds):
    """Its weights and statistics in every seed; the rest of the state is a new run's."""
    config = replace(CONFIG, start_from=str(finished), seeds=seeds)
    begun = load_policy(finished / "policy.npz")
    training = prepare(config, make_probe(scale=0.01))
    state, new = training.start(first_policy(config, training.env)), training.start()
    got = state.learner.policy.params, state.obs_stats
    for x, y in zip(
        jax.tree.leaves(got), jax.tree.leaves((begun.params, begun.obs_stats)), strict=True
    ):
        np.testing.assert_array_equal(x, np.broadcast_to(y, x.shape))
    value = state.learner.value.params, new.learner.value.params
    for x, y in zip(jax.tree.leaves(value[0]), jax.tree.leaves(value[1]), strict=True):
        np.testing.assert_array_equal(x, y)
    train(open_new(tmp_path / "run", config), _make_env)
    stored = json.loads((tmp_path / "run" / "config.json").read_text())
    assert stored["start_from"] == str(finished)


def test_start_from_a_policy_of_another_shape(finished, tmp_path):
    config = replace(CONFIG, start_from=str(finished), ppo=replace(CONFIG.ppo, hidden=16))
    with pytest.raises(UserError) as error:
        train(open_new(tmp_path / "run", config), _make_env)
    assert str(error.value) == (
        f"--start-from {finished}: that policy has 8 --hidden units, this run 16; "
        "change this run's settings, or start from another policy"
    )


def test_killed_before_the_first_checkpoint_starts_again(finished, tmp_path):
    path = tmp_path / "run"
    run = open_new(path, CONFIG)
    with run.held():
        run.create()
        run.append([{"iteration": 1}])
    train(open_existing(path, CONFIG), _make_env)
    _assert_same_run(path, finished, CONFIG)


def test_going_on_from_the_checkpoint_before(finished, tmp_path, capsys):
    """The last one is damaged: refused with the flag that helps, which repeats what is lost."""
    path = tmp_path / "run"
    train(open_new(path, CONFIG), _make_env, checkpoint_interval_s=0.0)
    folder = path / "checkpoints"
    assert sorted(p.name for p in folder.iterdir()) == ["3", "4"]
    (folder / "4" / "state" / "_METADATA").write_text("{}")
    flags = ["--run-dir", str(path)]
    before = _contents(path)
    assert _refused([*flags, "--resume"], capsys) == (
        f"{folder / '4'}: damaged: state/_METADATA is not what was written; go on from the one "
        "before it with --resume-from 3"
    )
    assert _refused([*flags, "--resume-from", "2"], capsys) == (
        f"{path}: no checkpoint of iteration 2; there are: 3, 4"
    )
    assert _contents(path) == before
    command, run = read_command([*flags, "--resume-from", "3"])
    assert command.train == CONFIG and run.start_iteration == 3
    train(run, _make_env)
    _assert_same_run(path, finished, CONFIG)
    assert sorted(p.name for p in folder.iterdir()) == ["3", "4", "4.set-aside"]
    assert (folder / "4.set-aside" / "state" / "_METADATA").read_text() == "{}"


def test_several_seeds(tmp_path, capsys):
    path, config = tmp_path / "run", replace(CONFIG, seeds=2, seed=5)
    policy = train(open_new(path, config), _make_env)
    rows = [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()]
    assert [(row["iteration"], row["seed"]) for row in rows] == [
        (i, s) for i in range(1, 5) for s in (5, 6)
    ]
    best = max(rows[-2:], key=lambda row: row["reward"])["seed"]
    assert policy.meta.seed == best
    assert load_policy(path / "policy.npz").meta.seed == best
    assert {load_policy(path / f"policy_s{s}.npz").meta.seed for s in (5, 6)} == {5, 6}
    assert f"seed {best}, the best of 2 by training reward" in capsys.readouterr().out
    before = _contents(path)
    train(open_existing(path, config), _make_env)  # finished: nothing left to do
    assert set(_contents(path)) == set(before)


@pytest.mark.parametrize(
    ("argv", "flag"),
    [
        (["--algo", "first-order", "--policy-lr", "0.01"], "--policy-lr 0.01"),
        (["--learning-rate", "0.01"], "--learning-rate 0.01"),
        (["--algo", "first-order", "--smoke", "--minibatches", "1"], "--minibatches 1"),
    ],
)
def test_a_setting_of_the_other_algorithm_is_refused(argv, flag, tmp_path, capsys):
    algo = "first-order" if "--algo" in argv else "ppo"
    run = tmp_path / "run"
    assert _refused([*argv, "--run-dir", str(run)], capsys) == (
        f"{flag} has no meaning with --algo {algo}; leave it out"
    )
    assert not run.exists()
    shared = ["--algo", "first-order", "--hidden", "32", "--cell", "gru", "--num-envs", "100"]
    assert read_command([*shared, "--run-dir", str(run)])[0].train.ppo.hidden == 32


def _refused(argv, capsys):
    """Exit code 2 and one line on stderr; returns the line."""
    with pytest.raises(SystemExit) as stop:
        startup.run_command(lambda: main(argv))
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1
    return error.removeprefix("error: ").strip()


@pytest.fixture
def finished_default(tmp_path):
    """A directory that looks like a finished run of `--num-envs 64 --total-steps 4096`."""
    path = tmp_path / "done"
    config = replace(preset_config("fast"), num_envs=64, total_steps=4096)
    run = open_new(path, config)
    with run.held():
        run.create()
    state = {"x": jax.numpy.ones(3)}
    checkpoint.save(path, config.iterations, state, command_line.config_to_json(config))
    return path


SAME = ["--num-envs", "64", "--total-steps", "4096"]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (SAME, "{path}: holds a finished run; name another directory with --run-dir"),
        (
            [*SAME, "--seed", "1"],
            "{path}: holds a run with --seed 0, not 1; name another directory with --run-dir",
        ),
        (
            [*SAME, "--delay", "E2"],
            "{path}: holds a run with --delay B4_4, not E2; name another directory with --run-dir",
        ),
        (
            ["--resume", "--delay", "E2"],
            "{path}: holds a run with --delay B4_4, not E2; name another directory with --run-dir",
        ),
    ],
)
def test_nothing_is_written_over(flags, message, finished_default, capsys):
    before = _contents(finished_default)
    said = _refused([*flags, "--run-dir", str(finished_default)], capsys)
    assert said == message.format(path=finished_default)
    assert _contents(finished_default) == before


def test_unfinished_run_asks_for_resume(finished_default, capsys):
    (finished_default / "checkpoints" / "2").rename(finished_default / "checkpoints" / "1")
    said = _refused([*SAME, "--run-dir", str(finished_default)], capsys)
    assert said == (
        f"{finished_default}: holds an unfinished run; go on with --resume, or name another "
        "--run-dir"
    )


def test_strange_directories(tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("mine")
    flags = ["--run-dir", str(tmp_path)]
    assert _refused(flags, capsys) == (
        f"--run-dir {tmp_path}: holds other files; name an empty or a new directory"
    )
    assert _refused([*flags, "--resume"], capsys) == (
        f"{tmp_path}: no run to go on with here (config.json is missing)"
    )
    file = tmp_path / "notes.txt"
    assert _refused(["--run-dir", str(file)], capsys) == (
        f"--run-dir {file}: is a file; name a directory"
    )
    (tmp_path / "config.json").write_text("{")
    assert _refused(flags, capsys) == (f"{tmp_path / 'config.json'}: not a JSON file, or cut short")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["config.json", "notes.txt"]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--preset slow", "unknown preset 'slow': use fast or paper"),
        ("--total-steps 0", "--total-steps 0: must be a positive integer"),
        ("--algo sac", "--algo sac: use one of ppo, first-order"),
        ("--device tpu", "--device tpu: use one of auto, cpu, gpu"),
        ("--resum", "unknown option --resum: did you mean --resume? --help lists all"),
        ("--num-envs 2.5", "--num-envs 2.5: must be a whole number"),
        (
            "--start-from ik",
            "--start-from ik: no policy there; name a run directory, a policy .npz or "
            "shipped:DELAY",
        ),
        ("--resume-from -1", "--resume-from -1: must be 0 or a positive number"),
        (
            "--checkpoint-interval-s nan",
            "--checkpoint-interval-s nan: must be 0 or a positive number",
        ),
    ],
)
def test_mistakes_in_flags(flags, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert _refused(flags.split(), capsys) == message
    assert not list(tmp_path.iterdir())


def test_preset_and_smoke_change_the_defaults(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command, run = read_command(["--preset", "paper", "--gamma", "0.98"])
    assert command.train.ppo.epochs == 80 and command.train.ppo.gamma == 0.98
    assert command.train.num_envs == 8 and str(run.path) == "runs/B4_4-paper-s0"
    command, run = read_command(["--smoke", "--num-envs", "8", "--physics", "mjx"])
    assert command.train.num_envs == 8 and command.train.env.physics == "mjx"
    assert command.train.iterations <= 6 and not run.path.is_relative_to(tmp_path)
    command, _ = read_command(["--smoke", "--preset", "paper"])
    assert command.train.ppo.window_steps == command.train.env.episode_steps == 96
    assert not list(tmp_path.iterdir())


def test_resume_reads_the_stored_configuration(finished_default):
    command, run = read_command(["--resume", "--run-dir", str(finished_default)])
    assert command.train.num_envs == 64 and run.start_iteration == 2


def test_a_signal_while_the_processes_agree_is_kept(tmp_path, monkeypatch):
    """It comes after this process has said that it has none."""
    asked = []

    def agree(*numbers):
        asked.append(numbers)  # the first time: the files are ready
        if len(asked) == 2:
            os.kill(os.getpid(), signal.SIGTERM)
        return numbers

    monkeypatch.setattr("mcx_jax.runs.loop.processes.agree", agree)
    with pytest.raises(SystemExit) as stop:
        train(open_new(tmp_path / "run", CONFIG), _make_env)
    assert stop.value.code == 128 + signal.SIGTERM
    assert checkpoint.latest(tmp_path / "run") == len(asked) - 1 == 2


def test_default_directory():
    config = preset_config("fast")
    assert str(default_path(replace(config, seed=3))) == "runs/B4_4-fast-s3"
    assert str(default_path(replace(config, seed=3, seeds=4))) == "runs/B4_4-fast-s3-6"
    literal = replace(config, env=replace(config.env, delay="butter:4:7.5Hz"))
    assert str(default_path(literal)) == "runs/butter_4_7.5Hz-fast-s0"


def test_second_signal_acts_as_usual():
    with StopRequest() as stop:
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.signum == signal.SIGINT
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_smoke_compiles_quickly_unless_told_otherwise(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--one")
    assert "without optimisation" in compile_quickly()
    assert os.environ["XLA_FLAGS"] == "--one --xla_backend_optimization_level=0"
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=2")
    compile_quickly()
    assert os.environ["XLA_FLAGS"] == "--xla_backend_optimization_level=2"


def test_short_time():
    assert [short_time(s) for s in (12.4, 200, 3900)] == ["12 s", "3 min 20 s", "1 h 05 min"]


@pytest.mark.slow
def test_restored_checkpoint_of_another_size_is_refused(finished):
    like = _like(replace(CONFIG, num_envs=16))
    with pytest.raises(UserError, match="cannot be restored"):
        checkpoint.restore(finished, like)


def test_smoke_runs_the_whole_path(tmp_path):
    """Train, checkpoint, evaluate, with the real environment."""
    command = [sys.executable, "-m", "mcx_jax.train", "--smoke", "--delay", "E1"]
    done = subprocess.run(
        [*command, "--run-dir", str(tmp_path / "run")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    names = {p.name for p in (tmp_path / "run").iterdir()}
    assert names == {".lock", "checkpoints", "config.json", "metrics.jsonl", "policy.npz"}
    assert "E1: explicit delay of 1 control steps = 20 ms" in done.stdout
    seas = ("Wa", "Wb", "Wc", "Wd")
    lines = [line.split() for line in done.stdout.splitlines()]
    # In two tables where COLUMNS is small (pytest imports readline, which sets it for children).
    rows = list(dict.fromkeys(tuple(w[:2]) for w in lines if w[1:] and w[1] in seas))
    assert rows == [(who, sea) for who in ("ik", "policy") for sea in seas]
    assert done.stdout.splitlines()[-1] == f"done: {tmp_path / 'run' / 'policy.npz'}"


@pytest.mark.slow
def test_the_command_without_its_output(tmp_path):
    """Exit code 0, the table left out of nothing but sight, and bit for bit the same policy."""
    smoke = [sys.executable, "-m", "mcx_jax.train", "--smoke", "--delay", "E1", "--run-dir"]
    subprocess.run([*smoke, str(tmp_path / "whole")], check=True, capture_output=True)
    for (kind, make), why in zip(LOST.items(), REASONS, strict=True):
        stream, path = make(), tmp_path / kind
        run = [*smoke, str(path)]
        if stream is None:
            run = ["sh", "-c", 'exec "$@" >&- 2>&-', "sh", *run]
        done = subprocess.run(run, stdout=stream, stderr=stream, check=False)
        assert done.returncode == 0, kind
        assert _same_policy(path, tmp_path / "whole")
        said = (path / "messages.log").read_text()
        assert f"standard output cannot be written ({why}); the work goes on" in said


def test_nothing_is_traced_after_the_first_checkpoint(tmp_path, monkeypatch, caplog):
    """Neither iterations nor checkpoints: what is traced time and again is kept, and grows."""
    seen, append = [], RunDir.append

    def count(self, rows):
        if rows[0]["iteration"] == 2:
            caplog.clear()
        seen.append(rows[0]["iteration"])
        append(self, rows)

    monkeypatch.setattr(RunDir, "append", count)
    with jax.log_compiles():
        train(open_new(tmp_path / "run", CONFIG), _make_env, checkpoint_interval_s=0.0)
    assert seen[-1] > 2
    words = ("Finished tracing", "Compiling")
    assert [r.getMessage() for r in caplog.records if r.getMessage().startswith(words)] == []
