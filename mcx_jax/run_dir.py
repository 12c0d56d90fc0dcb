"""The directory of a training run: {config.json, metrics.jsonl, checkpoints/, policy.npz}.

Opening decides what may happen before anything is written; nothing is ever written over. Needs no
JAX, so that a mistake is told at once.
"""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcx_jax import checkpoint, cli
from mcx_jax.config import TrainConfig
from mcx_jax.errors import UserError

CONFIG = "config.json"
METRICS = "metrics.jsonl"
POLICY = "policy.npz"


@dataclass(frozen=True)
class RunDir:
    """A run's directory, checked against its configuration."""

    path: Path
    config: TrainConfig
    start_iteration: int = 0
    """Iteration of the checkpoint to go on from; 0 = a new run."""

    def create(self) -> None:
        """Make the directory with config.json, and metrics up to where the run goes on from."""
        self.path.mkdir(parents=True, exist_ok=True)
        if not (self.path / CONFIG).exists():
            _write_whole(self.path / CONFIG, cli.config_to_json(self.config))
        _cut_metrics(self.path / METRICS, self.start_iteration)

    def last_rows(self) -> list[dict[str, Any]]:
        """The last iteration's rows of metrics.jsonl, one per seed; [] if there are none."""
        lines = (self.path / METRICS).read_text().splitlines()[-self.config.seeds :]
        return [json.loads(line) for line in lines]

    def append(self, rows: list[dict[str, Any]]) -> None:
        """Add rows to metrics.jsonl."""
        with (self.path / METRICS).open("a") as file:
            file.writelines(json.dumps(row) + "\n" for row in rows)


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
    if not file.is_file():
        raise UserError(f"{path}: no run to go on with here ({CONFIG} is missing)")
    return cli.config_from_json(TrainConfig, file.read_text(), str(file))


def open_new(path: Path, config: TrainConfig) -> RunDir:
    """A directory for a new run.

    Raises:
        UserError: it holds something already.
    """
    if path.exists() and not path.is_dir():
        raise UserError(f"--run-dir {path}: is a file; name a directory")
    if not path.is_dir() or not any(path.iterdir()):
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


def open_existing(path: Path, config: TrainConfig) -> RunDir:
    """The directory of a run to go on with.

    Raises:
        UserError: no run, one with another configuration, or one without a checkpoint.
    """
    _refuse_difference(path, config)
    iteration = checkpoint.latest(path)
    if iteration is None:
        # Stopped before its first checkpoint: it starts again from its beginning, which is exact.
        return RunDir(path, config)
    return RunDir(path, config, iteration)


def _refuse_difference(path: Path, config: TrainConfig) -> None:
    differs = cli.difference(stored_config(path), config)
    if differs:
        raise UserError(f"{path}: holds a run with {differs}; name another directory")


def _check_writable(path: Path) -> None:
    parent = next(p for p in (path, *path.absolute().parents) if p.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise UserError(f"--run-dir {path}: cannot write in {parent}")


def _cut_metrics(path: Path, iteration: int) -> None:
    """Leave out rows after the checkpoint (and a row cut short): they will be written again."""
    kept = []
    for line in path.read_text().splitlines() if path.is_file() else []:
        try:
            row = json.loads(line)
        except ValueError:
            continue
        if row["iteration"] <= iteration:
            kept.append(line + "\n")
    _write_whole(path, "".join(kept))


def _write_whole(path: Path, text: str) -> None:
    partial = path.with_name(f".{path.name}.partial")
    partial.write_text(text)
    partial.replace(path)
