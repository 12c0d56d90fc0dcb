"""Process set-up: XLA flags by version, cores, cache, other systems, the one-line errors."""

import math
import os
import subprocess
import sys

import pytest

from mcx_jax import extras
from mcx_jax.compute import machine, startup
from mcx_jax.compute.startup import (
    DEVICES_FLAG,
    FUSION_FLAG,
    PASSES_FLAG,
    SPLIT_PASS,
    run_command,
    xla_flags_for,
)
from mcx_jax.config import command_line
from mcx_jax.config.training import TrainConfig
from mcx_jax.errors import UserError
from mcx_jax.runs.run_dir import RunDir


@pytest.mark.parametrize(
    ("version", "current", "want"),
    [
        ("0.7.2", "", ""),
        ("0.8.0", "", f"{FUSION_FLAG}=false"),
        ("0.10.2", "--xla_a=1", f"--xla_a=1 {FUSION_FLAG}=false"),
        ("0.11.1", "", f"{FUSION_FLAG}=false"),
        ("0.11.2", "", ""),  # from here on the flag aborts the process
        ("0.12.0.dev20261101", "", ""),
        ("0.10.2", f"{FUSION_FLAG}=true", f"{FUSION_FLAG}=true"),  # the user's word stands
    ],
)
def test_the_fusion_flag_goes_by_version(version, current, want):
    assert xla_flags_for(version, current, mjx=True) == want
    assert xla_flags_for(version, current) == current


def test_threads_share_two_heaps_unless_the_user_has_said(monkeypatch):
    class Library:
        def __init__(self, calls):
            self.mallopt = lambda *words: calls.append(words)

    for user, want in ((None, [(startup.M_ARENA_MAX, 2)]), ("8", [])):
        monkeypatch.delenv("MALLOC_ARENA_MAX", raising=False)
        if user:
            monkeypatch.setenv("MALLOC_ARENA_MAX", user)
        calls = []
        monkeypatch.setattr(startup.ctypes, "CDLL", lambda _, calls=calls: Library(calls))
        startup.limit_heaps()
        assert calls == want
    monkeypatch.delenv("MALLOC_ARENA_MAX")
    monkeypatch.setattr(startup.ctypes, "CDLL", lambda _: object())  # not glibc
    startup.limit_heaps()


def test_a_device_per_core_unless_the_user_has_set_it():
    want = f"{DEVICES_FLAG}=4 {PASSES_FLAG}={SPLIT_PASS}"
    assert xla_flags_for("0.10.2", "", cores=4) == want
    assert xla_flags_for("0.10.2", "--xla_a=1", cores=4) == f"--xla_a=1 {want}"
    for users in (f"{DEVICES_FLAG}=8", f"{PASSES_FLAG}=some-pass"):
        assert xla_flags_for("0.10.2", users, cores=4) == users
    assert xla_flags_for("0.10.2", "", cores=1) == ""


def test_a_users_mistake_is_one_line_and_code_2(capsys):
    def main():
        raise UserError("what, allowed, do")

    with pytest.raises(SystemExit) as stop:
        run_command(main)
    assert stop.value.code == 2
    assert capsys.readouterr().err == "error: what, allowed, do\n"


def test_ctrl_c_is_one_line_and_code_130(capsys):
    def main():
        raise KeyboardInterrupt

    with pytest.raises(SystemExit) as stop:
        run_command(main)
    assert stop.value.code == 130
    assert capsys.readouterr().err == "\nstopped\n"


def test_import_sets_no_flag():
    code = (
        "import os, mcx_jax.train, mcx_jax.evaluate; "
        "assert 'fusion' not in os.environ.get('XLA_FLAGS', '')"
    )
    clean = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    subprocess.run([sys.executable, "-c", code], check=True, env=clean)


def test_processes_meet_before_jax_looks_for_devices(monkeypatch):
    """Else `train --device gpu --distributed auto` would be too late for JAX."""
    order = []
    monkeypatch.setattr(startup.processes, "join", lambda text: order.append(text))
    monkeypatch.setattr(startup, "_check_device", lambda *_: order.append("devices"))
    monkeypatch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", ""))
    startup.configure("gpu", cores=1, distributed="auto")
    assert order == ["auto", "devices"]


class NoGpu:
    """A JAX that has a CPU alone."""

    def devices(self, kind):
        if kind == "gpu" or os.environ.get("JAX_PLATFORM_NAME") == "gpu":
            raise RuntimeError("Unknown backend")


def test_a_device_that_is_not_there_is_one_line_and_the_cpu_is_not_asked_for(monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    monkeypatch.delenv("JAX_PLATFORM_NAME", raising=False)
    startup._check_device(None, "cpu")  # JAX would look for its devices, too early for `hosts.join`
    startup._check_device(None, "auto")
    install = extras.install("cuda")
    with pytest.raises(UserError) as error:
        startup._check_device(NoGpu(), "gpu")
    assert str(error.value) == (
        "--device gpu: JAX finds no GPU here (JAX_PLATFORMS=cpu is set); use --device cpu, or on "
        f"a machine with one: {install}"
    )
    monkeypatch.setenv("JAX_PLATFORMS", "")
    monkeypatch.setenv("JAX_PLATFORM_NAME", "gpu")
    with pytest.raises(UserError, match="^JAX_PLATFORM_NAME=gpu: JAX finds no such device here"):
        startup._check_device(NoGpu(), "auto")


def files(root, **contents):
    """Write {path with __ for /: text} below a root."""
    for name, text in contents.items():
        path = root.joinpath(*name.split("__"))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


@pytest.mark.parametrize(
    ("group", "quotas", "want"),
    [
        # Version 2: a container with a namespace of its own, then without: its name is the host's.
        ("0::/\n", {"cpu.max": "200000 100000\n"}, 2.0),
        ("0::/docker/1f\n", {"cpu.max": "150000 100000\n"}, 1.5),
        # A group is bound by those around it.
        ("0::/a/b\n", {"a/cpu.max": "50000 100000\n", "a/b/cpu.max": "max 100000\n"}, 0.5),
        # Version 1, under either name of the mount.
        (
            "3:memory:/x\n2:cpu,cpuacct:/x\n",
            {"cpu,cpuacct/x/cpu.cfs_quota_us": "300000", "cpu,cpuacct/x/cpu.cfs_period_us": "1e5"},
            3.0,
        ),
        (
            "2:cpu,cpuacct:/host\n",
            {"cpu/cpu.cfs_quota_us": "400000", "cpu/cpu.cfs_period_us": "100000"},
            4.0,
        ),
        # No limit.
        ("0::/\n", {"cpu.max": "max 100000\n"}, math.inf),
        ("1:cpu:/\n", {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, math.inf),
        ("nonsense\n", {"cpu.max": "?"}, math.inf),
    ],
)
def test_a_quota_of_the_control_group_counts(group, quotas, want, tmp_path, monkeypatch):
    files(tmp_path, proc__self__cgroup=group)
    for name, text in quotas.items():
        path = tmp_path / "sys" / "fs" / "cgroup" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    assert machine.cpu_quota(tmp_path) == want
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(64), raising=False)
    assert machine.cores(tmp_path) == (64 if want == math.inf else max(1, math.floor(want)))


def test_affinity_counts_where_it_is_less_than_the_quota(tmp_path, monkeypatch):
    files(tmp_path, proc__self__cgroup="0::/\n", sys__fs__cgroup__cpu="")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {3}, raising=False)
    assert machine.cores(tmp_path) == 1
    assert machine.cpu_quota(tmp_path / "nowhere") == math.inf  # not Linux


def test_the_set_up_does_without_what_only_linux_has(monkeypatch):
    """macOS and Windows have no affinity, Windows no library None."""

    def no_library(_):
        raise TypeError("bad argument type for built-in operation")

    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    assert machine.cores() == max(1, math.floor(min(os.cpu_count() or 1, machine.cpu_quota())))
    monkeypatch.setattr(startup.ctypes, "CDLL", no_library)
    monkeypatch.setattr(sys, "platform", "win32")
    startup.limit_heaps()


def test_a_run_without_file_locks_is_refused_before_anything_is_written(tmp_path, monkeypatch):
    """Windows has no fcntl."""
    monkeypatch.setitem(sys.modules, "fcntl", None)
    run = RunDir(tmp_path / "run", TrainConfig())
    with (
        pytest.raises(UserError, match="cannot lock a run's directory; train on Linux"),
        run.held(),
    ):
        pass
    assert not list(tmp_path.iterdir())


def test_a_cache_that_cannot_be_used_is_one_line(tmp_path, monkeypatch):
    class Jax:
        config = None  # nothing is set

    (tmp_path / "file").write_text("")
    monkeypatch.setenv("MCX_JAX_CACHE", str(tmp_path / "file" / "cache"))
    (line,) = startup._use_cache(Jax)
    assert line.startswith(f"the cache of compiled programs {tmp_path}/file/cache cannot be used (")

    def read_only(**_):
        raise OSError(30, "Read-only file system")

    monkeypatch.setenv("MCX_JAX_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(startup.tempfile, "TemporaryFile", read_only)
    (line,) = startup._use_cache(Jax)
    assert "(Read-only file system): every start compiles; MCX_JAX_CACHE=DIR names" in line
    monkeypatch.setenv("MCX_JAX_CACHE", "")
    assert startup._use_cache(Jax) == []


def test_set_up_says_nothing_where_all_is_usual(monkeypatch, tmp_path):
    monkeypatch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", ""))
    assert startup.configure("cpu") == []


def test_names_that_are_not_text_are_one_line():
    with pytest.raises(UserError, match="not UTF-8; use a name that is") as error:
        command_line.parse(startup.UserError, ["--run-dir", "r\udcff"], prog="train")
    assert "\udcff" not in str(error.value)


def test_a_working_directory_that_is_gone_is_one_line(tmp_path, repo_root):
    gone = tmp_path / "gone"
    code = f"import os; os.mkdir({str(gone)!r}); os.chdir({str(gone)!r}); os.rmdir({str(gone)!r})\n"
    code += "from mcx_jax import train; from mcx_jax.compute import startup; "
    code += "startup.run_command(lambda: train.main([]))"
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(repo_root)},
    )
    assert done.returncode == 2
    assert done.stderr == ("error: the working directory has been deleted; change to another one\n")


def test_nothing_is_printed_on_the_way_to_mjx():
    """MJX prints that warp is missing, in front of what `--json -` writes."""
    code = "import mcx_jax.integrations.mjx_step, mcx_jax.arm.mjx_engine"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout == ""
