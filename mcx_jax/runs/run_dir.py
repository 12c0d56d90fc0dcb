"""The directory of a training run: {config.json, metrics.jsonl, checkpoints/, policy.npz}, and
messages.log if anything happened that a user should know.

Opening decides what may happen before anything is written; nothing is ever written over. One
process at a time holds it (`RunDir.held`), and whatever instant it is killed at, `--resume` goes on
exactly (docs/trust.md). Needs no JAX device, so that mistakes are reported immediately.
"""

import contextlib
import itertools
import json
import math
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

from mcx_jax.config import command_line
from mcx_jax.config.training import TrainConfig
from mcx_jax.console import command, streams
from mcx_jax.errors import UserError, reason
from mcx_jax.runs import checkpoint

CONFIG = "config.json"
METRICS = "metrics.jsonl"
POLICY = "policy.npz"
MESSAGES = "messages.log"
NEEDED = ("iteration", "seed", "reward", "lost")
"""Of a row of metrics.jsonl, what a run goes on with."""
LOCK = ".lock"
"""Locked by the process that trains; the kernel lets go of it however that process ends."""
LEFT_OVER = (LOCK, f".{CONFIG}.partial")
"""What a run that was killed before it had a configuration leaves: nothing."""


@dataclass
class RunDir:
    """A run's directory, checked against its configuration."""

    path: Path
    """Absolute while it is held; follows the directory where a user moves it (`follow`)."""
    config: TrainConfig
    start_iteration: int = 0
    """Iteration of the checkpoint to go on from; 0 = a new run."""
    writes: bool = True
    """False in all but one of the processes that share a run (`mcx_jax.compute.processes`)."""
    options: tuple[str, ...] = ()
    """Of the command line that began it, what config.json does not hold (--smoke, say)."""
    _open: contextlib.ExitStack = field(default_factory=contextlib.ExitStack, repr=False)
    _folder: int = field(default=-1, repr=False)
    """Descriptor of the directory while it is held, which a new name does not change."""
    _metrics: TextIO | None = field(default=None, repr=False)
    """metrics.jsonl, open for reading: its rows survive its deletion."""

    @property
    def resume_line(self) -> str:
        """The command that goes on with this run."""
        return command.line("train", "--run-dir", self.path, "--resume", *self.options)

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Keep every other run's process out; makes the directory.

        Raises:
            UserError: another process is in it, or was since it was opened; it cannot be written.
        """
        self.path = self.path.absolute()
        if not self.writes:
            yield
            return
        with contextlib.ExitStack() as self._open:
            self._claim()
            if (self.path / CONFIG).exists():
                _refuse_difference(self.path, self.config)
            if not self.start_iteration and checkpoint.latest(self.path):
                raise UserError(
                    f"{self.path}: another process has trained here meanwhile; look, then --resume"
                )
            yield
        self._folder, self._metrics = -1, None

    def _claim(self) -> None:
        """Make the directory, keep it open and lock it."""
        try:
            import fcntl
        except ImportError:
            raise UserError(
                f"{self.path}: this system cannot lock a run's directory; train on Linux or macOS, "
                "or in the Windows Subsystem for Linux"
            ) from None
        with writing(self.path):
            self.path.mkdir(parents=True, exist_ok=True)
            file = self._open.enter_context((self.path / LOCK).open("a"))
            self._folder = os.open(self.path, os.O_RDONLY)
            self._open.callback(os.close, self._folder)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UserError(
                f"{self.path}: another process is training here; wait for it, or name another "
                "--run-dir"
            ) from None
        except OSError as error:
            raise UserError(
                f"{self.path}: this file system cannot lock files ({reason(error)}); name a "
                "--run-dir on one that can"
            ) from None

    def create(self) -> None:
        """Write config.json, and metrics up to where the run goes on from."""
        if not self.writes:
            return
        with writing(self.path):
            self.follow()
            if not (self.path / CONFIG).exists():
                _write_whole(self.path / CONFIG, command_line.config_to_json(self.config))
            checkpoint.set_aside_after(self.path, self.start_iteration)
            _cut_metrics(self.path / METRICS, self.start_iteration)
            self._keep_metrics()

    def follow(self) -> bool:
        """Find the directory again if it was renamed or moved; make it again, under the first name
        that is free, if it was deleted. Says so.

        Returns:
            Whether it is in another place than before, or empty.
        """
        if self._folder < 0 or _is_at(self.path, self._folder):
            return False
        old, now = self.path, _place_of(self._folder)
        if now:
            self.path = now
            self.say(f"{old} is now {now}: the run goes on there")
            return True
        self.path = next(path for path in _names_like(old) if not os.path.lexists(path))
        self._claim()
        with writing(self.path):
            _write_whole(self.path / CONFIG, command_line.config_to_json(self.config))
            if self._metrics:
                self._metrics.seek(0)
                _write_whole(self.path / METRICS, self._metrics.read())
                self._keep_metrics()
        self.say(f"{old} is gone: the run goes on in {self.path}, and is saved there at once")
        return True

    def _keep_metrics(self) -> None:
        self._metrics = self._open.enter_context((self.path / METRICS).open())

    def say(self, text: str) -> None:
        """Print a line, and keep it in messages.log."""
        streams.end_line()
        print(text, flush=True)
        self.note([text])

    def note(self, lines: list[str]) -> None:
        """Add lines to messages.log, each with the time; whether that works ends nothing."""
        if lines and self.writes:
            now = time.strftime("%Y-%m-%d %H:%M:%S")
            with contextlib.suppress(OSError), (self.path / MESSAGES).open("a") as file:
                file.writelines(f"{now} {line}\n" for line in lines)

    def last_rows(self, iterations: int = 1) -> list[dict[str, Any]]:
        """Rows of metrics.jsonl of the last iterations, one per iteration and seed."""
        return whole_rows(self.path / METRICS)[-iterations * self.config.seeds :]

    def append(self, rows: list[dict[str, Any]]) -> bool:
        """Add rows to metrics.jsonl, wherever the directory is now.

        Returns:
            Whether it was moved or deleted since the last time.
        """
        if not self.writes:
            return False
        with writing(self.path):
            moved = self.follow()
        with writing(self.path), (self.path / METRICS).open("a") as file:
            file.writelines(_line(row) for row in rows)
            file.flush()
            os.fsync(file.fileno())  # a checkpoint must not be on the disk before its rows
        self.note(streams.take_losses())
        return moved


def default_path(config: TrainConfig) -> Path:
    """runs/<delay>-<preset or first-order>-s<seed>, or -s<first>-<last> for several seeds."""
    last = f"-{config.seed + config.seeds - 1}" if config.seeds > 1 else ""
    delay = config.env.delay.replace(":", "_").replace(",", "+")
    kind = config.preset if config.algo == "ppo" else config.algo
    return Path("runs") / f"{delay}-{kind}-s{config.seed}{last}"


def stored_config(path: Path) -> TrainConfig:
    """Configuration of the run in `path`.

    Raises:
        UserError: there is none, or it cannot be read.
    """
    file = path / CONFIG
    if not os.path.isfile(file):
        raise UserError(f"{path}: no run to go on with here ({CONFIG} is missing)")
    try:
        text = file.read_text("utf-8")
    except (OSError, UnicodeDecodeError):
        raise UserError(f"{file}: cannot be read, or is not text") from None
    return command_line.config_from_json(TrainConfig, text, str(file))


def open_new(path: Path, config: TrainConfig) -> RunDir:
    """A directory for a new run.

    Raises:
        UserError: it holds something already.
    """
    command_line.check_name("--run-dir", path)
    if path.exists() and not path.is_dir():
        raise UserError(f"--run-dir {path}: is a file; name a directory")
    if not path.is_dir() or not any(p.name not in LEFT_OVER for p in path.iterdir()):
        _check_writable(path)
        return RunDir(path, config)
    if not (path / CONFIG).is_file():
        raise UserError(f"--run-dir {path}: holds other files; name an empty or a new directory")
    _refuse_difference(path, config)
    if checkpoint.latest(path) == config.iterations:
        raise UserError(f"{path}: holds a finished run; name another directory with --run-dir")
    raise UserError(
        f"{path}: holds an unfinished run; go on with --resume, or name another --run-dir"
    )


def open_existing(path: Path, config: TrainConfig, iteration: int = 0) -> RunDir:
    """The directory of a run to go on with.

    Args:
        iteration: of the checkpoint to go on from; 0 = the last one.

    Raises:
        UserError: no run, one with another configuration, or a checkpoint that cannot be used.
    """
    _refuse_difference(path, config)
    iteration = iteration or checkpoint.latest(path) or 0
    if iteration:
        checkpoint.check(path, iteration, command_line.config_to_json(config))
        _check_rows(path / METRICS, iteration)
    # Stopped before its first checkpoint it starts again from its beginning, which is exact.
    return RunDir(path, config, iteration)


def _refuse_difference(path: Path, config: TrainConfig) -> None:
    differs = command_line.difference(stored_config(path), config)
    if differs:
        raise UserError(
            f"{path}: holds a run with {differs}; name another directory with --run-dir"
        )


def _is_at(path: Path, folder: int) -> bool:
    """Whether a directory that is open has this name."""
    try:
        return os.path.samestat(os.stat(path), os.fstat(folder))
    except (FileNotFoundError, NotADirectoryError):
        return False


def _place_of(folder: int) -> Path | None:
    """The name that a directory that is open has now; None: deleted, or there is no /proc."""
    try:
        path = Path(os.readlink(f"/proc/self/fd/{folder}"))
    except FileNotFoundError:
        return None
    return path if _is_at(path, folder) else None


def _names_like(path: Path) -> Iterator[Path]:
    """The name itself, then with a number."""
    yield path
    yield from (path.with_name(f"{path.name}-{i}") for i in itertools.count(2))


def _check_writable(path: Path) -> None:
    parent = next(p for p in (path, *path.absolute().parents) if p.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise UserError(f"--run-dir {path}: cannot write in {parent}")


def _cut_metrics(path: Path, iteration: int) -> None:
    """Leave out rows after the checkpoint (and a row cut short): they will be written again."""
    rows = whole_rows(path) if path.is_file() else []
    kept = [_line(row) for row in rows if row["iteration"] <= iteration]
    _write_whole(path, "".join(kept))


def _check_rows(path: Path, iteration: int) -> None:
    """Refuse rows, up to an iteration, without the numbers that a run goes on with."""
    for row in whole_rows(path) if path.is_file() else []:
        bad = [name for name in NEEDED if type(row.get(name)) not in (int, float)]
        if bad and row["iteration"] <= iteration:
            raise UserError(
                f"{path}: the row of iteration {row['iteration']} has no number {bad[0]!r}; put it "
                "back, or take the line out"
            )


def whole_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of metrics.jsonl, without lines that a killed process or a bad disk left; what was
    not finite is NaN."""
    rows = []
    for line in path.read_text("utf-8", errors="replace").splitlines():
        try:
            row = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if isinstance(row, dict) and isinstance(row.get("iteration"), int):
            rows.append({name: math.nan if x is None else x for name, x in row.items()})
    return rows


def _line(row: dict[str, Any]) -> str:
    """Strict JSON, which has no NaN and no infinity: they are null."""
    strict = {
        k: None if isinstance(x, float) and not math.isfinite(x) else x for k, x in row.items()
    }
    return json.dumps(strict, allow_nan=False) + "\n"


def _write_whole(path: Path, text: str) -> None:
    partial = path.with_name(f".{path.name}.partial")
    with partial.open("w") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Report a full or read-only disk as a UserError."""
    try:
        yield
    except OSError as error:
        raise UserError(
            f"{path}: cannot be written ({reason(error)}); fix this, then continue with --resume"
        ) from None
