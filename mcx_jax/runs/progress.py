"""What a training run prints: one line of progress, drawn in place on a terminal."""

import sys
import time
from dataclasses import dataclass, field
from typing import Any, TextIO

from mcx_jax.config.training import TrainConfig
from mcx_jax.console.terminal import columns, paragraph
from mcx_jax.evaluation.paper import is_papers_world
from mcx_jax.evaluation.statistics import paper_means

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


TRAINING_NOTE = (
    "dp, da: errors of training episodes, with exploration and an episode's first second; the "
    "table at the end has neither, and first iterations may look worse than no correction"
)


def references(config: TrainConfig) -> str:
    """What the paper reached in the seas of the run, a line; "" where table 3 has nothing.

    That is: another delay or sea, or not the paper's world.
    """
    env, motion = config.env, config.motion
    ik, paper = (paper_means(who, env.delay, motion.sea) for who in ("ik", "paper"))
    if ik is None or paper is None or not is_papers_world(env, motion):
        return ""
    return (
        f"for comparison, table 3 of the paper, on test motion: its trained agents {paper[0]:.2f} "
        f"mm {paper[1]:.2f} mrad, the baseline that they imply {ik[0]:.2f} mm {ik[1]:.2f} mrad"
    )


def _span(values: list[float]) -> str:
    """A value; of several seeds the least and the largest."""
    ends = dict.fromkeys(f"{x:.2f}" for x in (min(values), max(values)))
    return " to ".join(ends)


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

    def begin(self) -> None:
        """Say what the lines that follow show, before the first iteration, if there is one."""
        if self.start_iteration == self.config.iterations:
            return
        for text in (TRAINING_NOTE, references(self.config)):
            if text:
                paragraph(text, self.out)
        if self.out.isatty():
            self.out.write(f"{self.start_iteration}/{self.config.iterations} | first iteration")
            self.out.flush()

    def show(self, rows: list[dict[str, Any]]) -> None:
        """Report an iteration: its rows, one per seed."""
        iteration = rows[0]["iteration"]
        done = iteration == self.config.iterations
        self._warn(rows)
        if self.out.isatty():
            end = "\n" if done else ""
            self.out.write(f"\r\x1b[K{self.line(rows, columns(self.out) - 1)}{end}")
        elif done or time.monotonic() - self.printed > PLAIN_INTERVAL_S:
            self.out.write(self.line(rows) + "\n")
            self.printed = time.monotonic()
        self.out.flush()

    def line(self, rows: list[dict[str, Any]], width: int | None = None) -> str:
        """One line: how far, how good, how fast.

        Args:
            rows: of an iteration, one per seed.
            width: parts at the end that do not fit are left out; None = none.
        """
        parts = self._parts(rows)
        while width is not None and len(" | ".join(parts)) > width and len(parts) > 1:
            parts.pop()
        return " | ".join(parts)

    def _parts(self, rows: list[dict[str, Any]]) -> list[str]:
        """The most important first."""
        iteration, total = rows[0]["iteration"], self.config.iterations
        elapsed = max(time.monotonic() - self.begun, 1e-9)
        done = iteration - self.start_iteration
        rate = done * self.config.steps_per_iteration * self.config.seeds / elapsed
        left = (total - iteration) * elapsed / max(done, 1)
        position = _span([row["pos_error_mm"] for row in rows])
        angle = _span([row["ang_error_mrad"] for row in rows])
        noise = [f"sigma {rows[0]['sigma']:.3f}"] if "sigma" in rows[0] else []
        return [
            *(f"{iteration}/{total}", f"ETA {short_time(left)}"),
            *(f"training dp {position} mm", f"da {angle} mrad"),
            *(f"{rows[0]['steps'] / 1e6:.2f} M steps", f"{rate:,.0f}/s", *noise),
        ]

    def _warn(self, rows: list[dict[str, Any]]) -> None:
        share = max(row["rejected_share"] for row in rows)
        if share > REJECTED_WARNING and not self.warned:
            self.warned = True
            limit = self.config.ppo.reject_mean_sq_reward
            why = {
                "ppo": f"failed IK or a mean squared reward above --reject-mean-sq-reward {limit}",
                "first-order": "failed IK, or the tool or a joint's speed out of all bounds",
            }
            over = "\r\x1b[K" if self.out.isatty() else ""
            self.out.write(
                f"{over}warning: {100 * share:.0f} % of the {LEFT_OUT[self.config.algo]} are left "
                f"out of learning: {why[self.config.algo]}\n"
            )
