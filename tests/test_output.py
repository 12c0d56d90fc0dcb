"""Output that cannot be written, and Ctrl-C, wherever a command is: one line, and nothing lost.

Whole runs with a lost output are in test_train_command.py.
"""

import errno
import os
import pkgutil
import pty
import re
import signal
import subprocess
import sys

import pytest

import mcx_jax
from mcx_jax.compute.startup import run_command
from mcx_jax.console import command
from mcx_jax.console.streams import CLOSED, Guarded


def _closed_pipe():
    read, write = os.pipe()
    os.close(read)
    return open(write, "w")


def _closed_terminal():
    """As under nohup, when the terminal has gone."""
    ours, theirs = pty.openpty()
    os.close(ours)
    return open(theirs, "w")


def _full_disk():
    return open("/dev/full", "w")


LOST = {
    "pipe": _closed_pipe,
    "terminal": _closed_terminal,
    "disk": _full_disk,
    "none": lambda: None,
}
"""Kinds of a lost stream: makes a file for a process's output; None = closed."""
REASONS = (*map(os.strerror, (errno.EPIPE, errno.EIO, errno.ENOSPC)), CLOSED)
KINDS = pytest.mark.parametrize(("kind", "why"), list(zip(LOST, REASONS, strict=True)))

WRITES_IN_EVERY_WAY = """
import logging, sys, warnings
from pathlib import Path
from mcx_jax.console import streams
streams.guard()
free = open(sys.argv[1])
assert free.fileno() > 2, "a file got the number of a closed stream"
from rich.console import Console
sys.stdout.isatty(), sys.stderr.isatty()
print("out", flush=True)
Console().print("[red]rich[/red]")
logging.basicConfig()
logging.warning("logged")
warnings.warn("warned")
sys.stderr.writelines(["a", "b"])
sys.stdout.flush()
Path(sys.argv[1]).write_text("\\n".join(streams.take_losses() + streams.take_losses()))
"""


@KINDS
def test_every_way_of_writing_goes_on(kind, why, tmp_path):
    """print, rich, logging, warnings: of a process that has lost both streams."""
    (tmp_path / "said").touch()
    stream = LOST[kind]()
    run = [sys.executable, "-c", WRITES_IN_EVERY_WAY, str(tmp_path / "said")]
    if stream is None:
        run = ["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", *run]
    done = subprocess.run(run, stdout=stream, stderr=stream, check=False)
    assert done.returncode == 0
    assert (tmp_path / "said").read_text().splitlines() == [
        f"standard {name} cannot be written ({why}); the work goes on"
        for name in ("output", "error")
    ]


def test_a_stream_that_recovers_is_written_again(tmp_path):
    """A disk that has room again: what was not written is, and nothing was raised."""

    class Disk:
        full, text = True, ""

        def write(self, text):
            if self.full:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            self.text += text

    stream = Guarded(disk := Disk(), "standard output")  # pyright: ignore[reportArgumentType]
    assert stream.write("one\n") == 4
    disk.full = False
    stream.write("two\n")
    assert (disk.text, stream.error) == ("two\n", os.strerror(errno.ENOSPC))


def test_a_character_that_the_stream_cannot_encode(tmp_path):
    with (tmp_path / "out").open("w", encoding="ascii") as file:
        Guarded(file, "standard output").write("run \udcff é\n")
    assert (tmp_path / "out").read_text() == "run \\udcff \\xe9\n"


@KINDS
def test_a_command_whose_output_is_lost_does_all_the_rest(kind, why, tmp_path, monkeypatch, capsys):
    """`evaluate ... --json FILE | head` ends quietly; where somebody wanted the output, a full disk
    is an error at the end."""
    stream = LOST[kind]()
    monkeypatch.setattr(sys, "stdout", stream)

    def main():
        print("table", flush=True)
        print("more", flush=True)
        (tmp_path / "result.json").write_text("{}")

    if kind in ("pipe", "none"):
        run_command(main)
        said = ""
    else:
        with pytest.raises(SystemExit) as stop:
            run_command(main)
        assert stop.value.code == 2
        said = (
            f"error: standard output cannot be written ({why}); all else was done; write to "
            "another place\n"
        )
    assert (tmp_path / "result.json").read_text() == "{}"
    assert capsys.readouterr().err == said


def test_an_error_gets_a_line_of_its_own(monkeypatch, capsys):
    """After progress that is drawn in place."""
    from mcx_jax.errors import UserError

    def main():
        print("3/5 | ETA", end="", flush=True)
        raise UserError("what")

    with pytest.raises(SystemExit):
        run_command(main)
    out, err = capsys.readouterr()
    assert (out, err) == ("3/5 | ETA\n", "error: what\n")


AT_AN_IMPORT = """
import os, runpy, signal, sys
module = sys.argv.pop()
def interrupt(event, args):
    if event == "import" and args[0] == module:
        os.kill(os.getpid(), signal.SIGINT)
sys.addaudithook(interrupt)
runpy.run_module("mcx_jax.train", run_name="__main__", alter_sys=True)
"""


@pytest.mark.parametrize("module", ["dataclasses", "tyro", "jax"])
def test_ctrl_c_during_the_imports(module, tmp_path):
    """One line and code 130, at the first import as at a later one."""
    done = subprocess.run(
        [sys.executable, "-c", AT_AN_IMPORT, "--smoke", module],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
    )
    assert (done.returncode, done.stderr) == (130, "\nstopped\n")


def test_every_command_takes_ctrl_c_before_its_imports(repo_root):
    begin = "    from mcx_jax.console.command import begin\n\n    begin()\n\n"
    begin = f'if __name__ == "__main__":\n{begin}'
    found = 0
    for module in pkgutil.walk_packages(mcx_jax.__path__, "mcx_jax."):
        path = repo_root / (module.name.replace(".", "/") + ".py")
        source = path.read_text() if path.is_file() else ""
        if re.search(r"^    run_command\(main\)", source, re.MULTILINE):
            found += 1
            first = re.search(r"^(import|from|if) ", source.split('"""\n\n', 1)[1], re.MULTILINE)
            assert first and source.split('"""\n\n', 1)[1].startswith(begin), path
    assert found >= 7


ENDS = """
import os, signal, sys, time
from mcx_jax.console import command
command.begin()
with command.last_words(lambda: "so far: 3"):
    try:
        with command.interruptible():
            os.kill(os.getpid(), signal.SIGINT)
    except KeyboardInterrupt:
        print("tidied up")
    print("in the middle of a line", end="")
    try:
        os.kill(os.getpid(), signal.SIGINT)
    except BaseException:  # as a library that swallows
        pass
print("not reached")
"""


def test_ctrl_c_says_what_there_is_to_say_and_nothing_swallows_it():
    done = subprocess.run([sys.executable, "-c", ENDS], capture_output=True, text=True, check=False)
    assert done.stdout == "tidied up\nin the middle of a line"
    assert (done.returncode, done.stderr) == (130, "\nso far: 3\n")


def test_an_ignored_ctrl_c_stays_ignored(monkeypatch):
    """`nohup ... &`."""
    set_to = []
    monkeypatch.setattr(signal, "getsignal", lambda signum: signal.SIG_IGN)
    monkeypatch.setattr(signal, "signal", lambda *args: set_to.append(args))
    monkeypatch.setattr(command.streams, "guard", lambda: None)
    command.begin()
    assert set_to == []
