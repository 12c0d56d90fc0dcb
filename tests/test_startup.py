"""Process set-up: the XLA flag by version, never over the user's own, and the one-line errors."""

import os
import subprocess
import sys

import pytest

from mcx_jax import startup
from mcx_jax.errors import UserError
from mcx_jax.startup import (
    DEVICES_FLAG,
    FUSION_FLAG,
    PASSES_FLAG,
    SPLIT_PASS,
    run_command,
    xla_flags_for,
)


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
    monkeypatch.setattr(startup.hosts, "join", lambda text: order.append(text))
    monkeypatch.setattr(startup, "_require_gpu", lambda jax: order.append("devices"))
    monkeypatch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", ""))
    startup.configure("gpu", cores=1, distributed="auto")
    assert order == ["auto", "devices"]
