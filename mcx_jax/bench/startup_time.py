"""Seconds from typing the training command to its first metrics, with an empty and a full cache."""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from mcx_jax.console.command import interruptible
from mcx_jax.errors import UserError

LIMIT_S = 600.0


def first_metrics_s() -> dict[str, float]:
    """{"cold", "warm"}: preset fast with all its environments, compilation cache empty and full."""
    with interruptible(), tempfile.TemporaryDirectory() as folder:
        cache = Path(folder) / "cache"
        return {name: _first_metrics_s(Path(folder) / name, cache) for name in ("cold", "warm")}


def _first_metrics_s(run_dir: Path, cache: Path) -> float:
    command = [sys.executable, "-m", "mcx_jax.train", "--run-dir", str(run_dir)]
    log = run_dir.with_suffix(".log")
    begun = time.monotonic()
    with log.open("w") as out:
        environment = {**os.environ, "MCX_JAX_CACHE": str(cache)}
        process = subprocess.Popen(command, stdout=out, stderr=out, env=environment)
        try:
            while not _has_line(run_dir / "metrics.jsonl"):
                if process.poll() is not None or time.monotonic() - begun > LIMIT_S:
                    tail = " ".join(log.read_text().splitlines()[-1:])
                    raise UserError(f"bench: the training command gave no metrics: {tail}")
                time.sleep(0.05)
            return time.monotonic() - begun
        finally:
            process.kill()
            process.wait()


def _has_line(path: Path) -> bool:
    return path.is_file() and path.stat().st_size > 0
