"""What a training run prints: one line of progress, drawn in place on a terminal."""

import shutil
import sys
import time
from dataclasses import dataclass, field
from typing import Any, TextIO

from mcx_jax.config import TrainConfig
from mcx_jax.paper import is_papers_world
from mcx_jax.results import paper_means

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


def references(config: TrainConfig) -> tuple[str, str]:
    """What to print beside dp and da: table 3's IK baseline and agents, for the seas of the run.

    ("", "") where table 3 has none: another delay or sea, or not the paper's world.
    """
    env, motion = config.env, config.motion
    ik, paper = (paper_means(who, env.delay, motion.sea) for who in ("ik", "paper"))
    if ik is None or paper is None or not is_papers_world(env, motion):
        return "", ""
    position, angle = (f" (IK {a:.2f}, paper {b:.2f})" for a, b in zip(ik, paper, strict=True))
    return position, angle


LEFT_OUT = {"ppo": "windows", "first-order": "steps"}
"""What an algorithm leaves out of learning (`rejected_share`)."""


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
        """One line: how good, how far, how fast; the end is cut off on a narrow terminal.

        The errors include the exploration noise and an episode's first second, which the IK
        baseline and the paper's agents beside them do not.
        """
        iteration, total = rows[0]["iteration"], self.config.iterations
        elapsed = max(time.monotonic() - self.begun, 1e-9)
        done = iteration - self.start_iteration
        rate = done * self.config.steps_per_iteration * self.config.seeds / elapsed
        left = (total - iteration) * elapsed / max(done, 1)
        position = " ".join(f"{row['pos_error_mm']:.2f}" for row in rows)
        angle = " ".join(f"{row['ang_error_mrad']:.2f}" for row in rows)
        beside = references(self.config)
        noise = f" | sigma {rows[0]['sigma']:.3f}" if "sigma" in rows[0] else ""
        return (
            f"{iteration}/{total} | dp {position} mm{beside[0]} | da {angle} mrad{beside[1]} | "
            f"ETA {short_time(left)} | {rows[0]['steps'] / 1e6:.2f} M steps, {rate:,.0f}/s{noise}"
        )

    def _warn(self, rows: list[dict[str, Any]]) -> None:
        share = max(row["rejected_share"] for row in rows)
        if share > REJECTED_WARNING and not self.warned:
            self.warned = True
            limit = self.config.ppo.reject_mean_sq_reward
            why = {
                "ppo": f"failed IK or a mean squared reward above --reject-mean-sq-reward {limit}",
                "first-order": "failed IK, or the tool or a joint's speed out of all bounds",
            }
            self.out.write(
                f"warning: {100 * share:.0f} % of the {LEFT_OUT[self.config.algo]} are left out of "
                f"learning: {why[self.config.algo]}\n"
            )
