"""Settings of JAX that a user's shell may hold: none changes a number or ends in a traceback."""

import os
import subprocess
import sys

import jax
import jax.experimental.pallas  # which defines some more options
import jax.numpy as jnp
import pytest

from mcx_jax.compute import jax_settings, startup
from mcx_jax.compute.jax_settings import LEFT, OURS, REFUSED, clean, names
from mcx_jax.errors import UserError

KNOWN = startup.known_flags("0.10.2")


@pytest.fixture
def environment(monkeypatch):
    """os.environ without anything that the tables name, put back afterwards."""
    for name in (*names(OURS), *names(REFUSED), "XLA_FLAGS"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    return monkeypatch


def test_every_option_of_jax_is_in_exactly_one_table():
    """A new release of JAX brings new options: say here what a command does about each."""
    listed = [*names(OURS), *names(REFUSED), *names(LEFT)]
    assert len(listed) == len(set(listed))
    assert {name.upper() for name in jax.config.values} <= set(listed)


def test_what_changes_numbers_is_taken_out_and_named(environment):
    environment.setenv("JAX_ENABLE_X64", "1")
    environment.setenv("JAX_NUMPY_RANK_PROMOTION", "raise")
    environment.setenv("JAX_PLATFORMS", "cpu")
    (line,) = clean(KNOWN)
    assert line.endswith(": JAX_ENABLE_X64, JAX_NUMPY_RANK_PROMOTION")
    assert os.environ["JAX_PLATFORMS"] == "cpu" and "JAX_ENABLE_X64" not in os.environ
    assert clean(KNOWN) == []


@pytest.mark.parametrize("name", names(REFUSED))
def test_what_would_stop_the_program_is_refused_by_name(name, environment):
    environment.setenv(name, "disallow")
    with pytest.raises(UserError, match=f"{name}=disallow cannot be used here: .*; unset {name}"):
        clean(KNOWN)
    for off in ("0", "False", "allow"):
        environment.setenv(name, off)
        assert clean(KNOWN) == []


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ("--xla_of_another_release=1", "Unknown flag in XLA_FLAGS: --xla_of_another_release=1"),
        ("--xla_backend_optimization_level=high", "Couldn't interpret value high for flag"),
        ("no_such_file", 'Could not open file "no_such_file" to read flags'),
    ],
)
def test_xla_flags_that_would_abort_the_process_are_one_line(flags, said, environment):
    environment.setenv("XLA_FLAGS", flags)
    with pytest.raises(UserError) as error:
        clean(KNOWN)
    assert str(error.value).startswith(f"XLA_FLAGS={flags}: jaxlib does not take this ({said}")


def test_flags_that_the_commands_set_cost_no_other_process(environment):
    environment.setattr(jax_settings.subprocess, "run", None)
    flags = startup.xla_flags_for("0.10.2", "--xla_backend_optimization_level=0", cores=4, mjx=True)
    environment.setenv("XLA_FLAGS", flags)
    assert clean(KNOWN) == []
    # From 0.11.2 the flag is gone: exported for an older jaxlib, it has to be asked about.
    with pytest.raises(TypeError, match="not callable"):
        clean(startup.known_flags("0.11.2"))


COMMANDS = ("train", "evaluate", "export", "sea", "bench", "play", "report")


def test_no_command_imports_jax_before_it_has_read_its_line():
    """JAX reads the variables on import; and a mistake is told at once."""
    code = "import importlib, sys\n" + "".join(
        f"importlib.import_module('mcx_jax.{name}{'.__main__' if inner else ''}')\n"
        for name, inner in zip(COMMANDS, (0, 0, 0, 1, 1, 1, 1), strict=True)
    )
    code += "assert not {'jax', 'flax', 'mujoco', 'matplotlib'} & set(sys.modules), sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


WHERE = {
    "JAX_PLATFORMS": ("cuda", "JAX_PLATFORMS=cuda: JAX finds no such device here"),
    "JAX_LOG_COMPILES": ("maybe", "JAX does not start: invalid truth value 'maybe'"),
}


@pytest.mark.parametrize("name", WHERE)
def test_a_setting_that_jax_cannot_follow_is_one_line(name, tmp_path):
    value, said = WHERE[name]
    variables = {**os.environ, "JAX_PLATFORMS": "", name: value, "MCX_JAX_CACHE": ""}
    code = "from mcx_jax.compute import startup; startup.run_command(startup.configure)"
    done = subprocess.run(
        [sys.executable, "-c", code], env=variables, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith(f"error: {said}") and done.stderr.count("\n") == 1


def test_a_users_settings_do_not_reach_the_numbers():
    """The samples of the fault; what this process, without them, computes is right."""
    x = jax.random.normal(jax.random.key(0), (3, 1)) + jnp.ones(3)
    code = (
        "from mcx_jax.compute import startup; startup.configure('cpu', cores=1)\n"
        "import jax, jax.numpy as jnp\n"
        "x = jax.random.normal(jax.random.key(0), (3, 1)) + jnp.ones(3)\n"
        "print(x.dtype, x.tolist())"
    )
    settings = {
        "JAX_ENABLE_X64": "1",
        "JAX_NUMPY_RANK_PROMOTION": "raise",
        "JAX_NUMPY_DTYPE_PROMOTION": "strict",
        "JAX_DEFAULT_PRNG_IMPL": "rbg",
    }
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, **settings},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout == f"float32 {x.tolist()}\n"
