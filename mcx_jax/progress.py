"""What a training run prints: one line of progress, drawn in place on a terminal."""

import shutil
import sys
import time
from dataclasses import dataclass, field
from typing import Any, TextIO

from mcx_jax.config import TrainConfig

PLAIN_INTERVAL_S = 10.0
"""Seconds between lines where the output is no terminal."""
REJECTED_WARNING = 0.5


def short_time(seconds: float) -> str:
    """12 s, 3 min 20 s or 1 h 05 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


@dataclass
class Progress:
    """Prints the state of a run that starts at `start_iteration`."""

    config: TrainConfig
    start_iteration: int
    out: TextIO = field(default_factory=lambda: sys.stdout)
    begun: float = field(default_factory=time.monotonic)
    printed: float = -1e9
    warned: bool = False

    def show(self, rows: list[dict[str, Any]]) -> None:
        """Report an iteration: its rows, one per seed."""
        iteration = rows[0]["iteration"]
        done = iteration == self.config.iterations
        self._warn(rows)
        if self.out.isatty():
            end = "\n" if done else ""
            width = shutil.get_terminal_size().columns - 1
            self.out.write(f"\r\x1b[K{self.line(rows)[:width]}{end}")
        elif done or time.monotonic() - self.printed > PLAIN_INTERVAL_S:
            self.out.write(self.line(rows) + "\n")
            self.printed = time.monotonic()
        self.out.flush()

    def line(self, rows: list[dict[str, Any]]) -> str:
        """One line: how far, how fast, how good (errors include the exploration noise)."""
        iteration, total = rows[0]["iteration"], self.config.iterations
        elapsed = max(time.monotonic() - self.begun, 1e-9)
        done = iteration - self.start_iteration
        rate = done * self.config.steps_per_iteration * self.config.seeds / elapsed
        left = (total - iteration) * elapsed / max(done, 1)
        position = " ".join(f"{row['pos_error_mm']:.3f}" for row in rows)
        angle = " ".join(f"{row['ang_error_mrad']:.3f}" for row in rows)
        noise = f"sigma {rows[0]['sigma']:.3f} | " if "sigma" in rows[0] else ""
        return (
            f"iteration {iteration}/{total} | {rows[0]['steps'] / 1e6:.2f} M steps | "
            f"{rate:,.0f} steps/s | {position} mm {angle} mrad | "
            f"{noise}ETA {short_time(left)}"
        )

    def _warn(self, rows: list[dict[str, Any]]) -> None:
        share = max(row["rejected_share"] for row in rows)
        if share > REJECTED_WARNING and not self.warned:
            self.warned = True
            self.out.write(
                f"warning: {100 * share:.0f} % of the windows are left out of learning: failed IK "
                "or a mean squared reward above --reject-mean-sq-reward "
                f"{self.config.ppo.reject_mean_sq_reward}\n"
            )
