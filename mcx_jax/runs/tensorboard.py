"""Event files for TensorBoard beside metrics.jsonl (`train --tensorboard`; extra `viz`)."""

from pathlib import Path
from typing import Any, Self

from mcx_jax import extras
from mcx_jax.config.training import TrainConfig


def require() -> None:
    """Refuse, before anything is computed, where the package is missing."""
    extras.require("tensorboardX", "--tensorboard")


class EventFile:
    """One event file of a run; a resumed run gets another one next to it."""

    def __init__(self, path: Path, config: TrainConfig, start_iteration: int) -> None:
        """Open a new file in the run's directory.

        Args:
            start_iteration: what was written after it is hidden: it will be written again.
        """
        from tensorboardX import SummaryWriter

        self._seeds = config.seeds
        first = start_iteration * config.steps_per_iteration + 1
        # Names hold the second only: a run resumed immediately would overwrite the first file.
        suffix = f".{start_iteration}"
        self._writer = SummaryWriter(str(path), purge_step=first, filename_suffix=suffix)

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(self, *exc: object) -> None:
        """Write what is left."""
        self._writer.close()

    def append(self, rows: list[dict[str, Any]]) -> None:
        """Add an iteration's rows of metrics.jsonl: a curve per metric over control steps, with
        several seeds under seed<n>/."""
        for row in rows:
            under = f"seed{row['seed']}/" if self._seeds > 1 else ""
            for name, value in row.items():
                if name not in ("iteration", "steps", "seed"):
                    self._writer.add_scalar(under + name, value, row["steps"])
        # A killed run goes on from a checkpoint: no point before it may be missing.
        self._writer.flush()
