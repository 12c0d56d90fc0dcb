"""Command lines and configuration files: each mistake is one line with the flag and what to do."""

import importlib
import json
import os
import subprocess
import sys
from dataclasses import replace

import pytest

from mcx_jax.config import command_line
from mcx_jax.config.task import EnvConfig
from mcx_jax.config.training import TrainConfig, preset_config
from mcx_jax.errors import UserError


def _parse(*argv):
    return command_line.parse(TrainConfig, argv, prog="train", default=preset_config("fast"))


def test_flags_are_flat():
    config = _parse("--delay", "E2", "--num-envs", "64", "--gamma", "0.95", "--sea", "Wd")
    assert config.env.delay == "E2" and config.num_envs == 64
    assert config.ppo.gamma == 0.95 and config.motion.sea == "Wd"
    assert config.env.episode_steps == 1024  # the preset's, not the class's


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ("--num-envs x", "--num-envs x: must be a whole number"),
        ("--num-envs 1.5", "--num-envs 1.5: must be a whole number"),
        ("--num-envs -5", "--num-envs -5: must be a positive integer"),
        ("--gamma much", "--gamma much: must be a number"),
        ("--physics bullet", "--physics bullet: use one of chain, mjx"),
        ("--preset slow", "--preset slow: use one of fast, paper"),
        ("--num-envs", "--num-envs needs a value"),
        ("--num-env 5", "unknown option --num-env 5: did you mean --num-envs? --help lists all"),
        ("--qqq 3", "unknown option --qqq 3: --help lists all"),
        ("--sea Wa --sea Wb", "--sea is given twice; leave one of them out"),
        ("--coupled --no-coupled", "--coupled is given twice; leave one of them out"),
        ("--num_envs=64 --num-envs 64", "--num-envs is given twice; leave one of them out"),
        ("fast", "unknown option fast: --help lists all"),
        ("--seed -1", "--seed -1: must be 0 or a positive integer"),
        (
            "--num-envs 12",
            (
                "--num-envs 12 gives 12 sequences a window, which --minibatches 16 does not "
                "divide; use a multiple of 16"
            ),
        ),
        (
            "--delay butter:4:25Hz",
            (
                "--delay butter:4:25Hz: the cutoff must be at least 0.1 Hz and below the Nyquist "
                "frequency 25 Hz (control runs at 50 Hz)"
            ),
        ),
        (
            "--delay late",
            (
                "unknown delay 'late': use one of E0, E1, E2, B4_21, B4_4, E<k> for k control "
                "steps, or butter:<order>:<cutoff>Hz, e.g. butter:4:7.5Hz"
            ),
        ),
    ],
)
@pytest.mark.parametrize("columns", ["40", "120"])
def test_mistakes_are_one_line(argv, message, columns, monkeypatch):
    monkeypatch.setenv("COLUMNS", columns)
    with pytest.raises(UserError) as error:
        _parse(*argv.split())
    assert str(error.value) == message


def test_help_shows_the_defaults_and_ends_well(capsys):
    with pytest.raises(SystemExit) as stop:
        _parse("--help")
    assert stop.value.code == 0
    assert "--num-envs" in capsys.readouterr().out


def test_value_of_and_optional_value():
    argv = ["--preset", "fast", "--json", "--preset=paper"]
    assert command_line.value_of(argv, "--preset") == "paper"
    assert command_line.value_of(argv, "--seed") is None
    assert command_line.optional_value(argv, "--json", "-")[2] == "--json=-"
    assert command_line.optional_value(["--json", "a.json"], "--json", "-") == ["--json", "a.json"]
    assert command_line.optional_value(["--json"], "--json", "-") == ["--json=-"]


def test_configuration_survives_json():
    config = replace(preset_config("paper"), seed=3, env=EnvConfig(delay="butter:4:7.5Hz"))
    assert command_line.config_from_json(TrainConfig, command_line.config_to_json(config)) == config


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"wind": 3},
            "config.json: unknown setting 'wind'; it was written by another version of mcx_jax",
        ),
        (
            {"seed": None},
            "config.json: no setting 'seed'; it was written by another version of mcx_jax",
        ),
        ({"seed": "0"}, "config.json: seed is '0', must be of type int"),
        ({"seed": True}, "config.json: seed is True, must be of type int"),
        ({"preset": "slow"}, "config.json: preset is 'slow', must be one of fast, paper"),
        ({"env": 3}, "config.json: env: must hold settings, not 3"),
        ({"format": 99}, "config.json: not a configuration of this version (format 1)"),
    ],
)
def test_strange_configuration_files(change, message):
    values = json.loads(command_line.config_to_json(preset_config("fast")))
    values = {k: v for k, v in {**values, **change}.items() if v is not None}
    with pytest.raises(UserError) as error:
        command_line.config_from_json(TrainConfig, json.dumps(values))
    assert str(error.value) == message


def test_a_setting_added_later_has_its_default_in_older_files():
    values = json.loads(command_line.config_to_json(preset_config("fast")))
    del values["start_from"]
    assert command_line.config_from_json(TrainConfig, json.dumps(values)) == preset_config("fast")


def test_cut_short_configuration_file():
    text = command_line.config_to_json(preset_config("fast"))
    with pytest.raises(UserError, match="config.json: not a JSON file, or cut short"):
        command_line.config_from_json(TrainConfig, text[:40])


def test_difference_names_the_flag():
    config = preset_config("fast")
    assert command_line.difference(config, config) is None
    other = replace(config, env=replace(config.env, delay="E1"))
    assert command_line.difference(config, other) == "--delay B4_4, not E1"


OUTPUTS = {
    "evaluate": (["ik"], "--json", ".json"),
    "sea": ([], "--json", ".json"),
    "bench --json": (["--quick"], "--json", ".json"),
    "bench --plot": (["--quick"], "--plot", ".png"),
    "play --video": (["ik"], "--video", ".mp4"),
    "play --frame": (["ik"], "--frame", ".png"),
    "export": (["shipped:E2"], "--out", ".npz"),
}


@pytest.mark.parametrize("name", OUTPUTS)
def test_no_command_overwrites_a_file(tmp_path, name):
    options, flag, ending = OUTPUTS[name]
    file = tmp_path / f"mine{ending}"
    file.write_text("mine")
    module = name.split()[0]
    package = "mcx_jax." + module + (".__main__" if module in ("sea", "bench", "play") else "")
    with pytest.raises(UserError) as error:
        importlib.import_module(package).main([*options, flag, str(file)])
    said = f"{flag} {file}: exists already; name another file, or remove it"
    assert str(error.value) == said and file.read_text() == "mine"


def test_empty_files_and_devices_are_written_to(tmp_path):
    """mktemp makes an empty one; /dev/null and a pipe lose nothing."""
    (tmp_path / "empty").write_text("")
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "empty", tmp_path / "pipe", "/dev/null", tmp_path / "new"):
        command_line.check_output("--json", str(path))


def test_parsing_needs_no_jax():
    modules = "mcx_jax.config.command_line, mcx_jax.config.training"
    code = f"import sys, {modules}; sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
