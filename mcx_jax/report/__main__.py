"""`python -m mcx_jax.report RUN... --out DIR`: one page about controllers, with all its figures.

RUN is what `evaluate` takes; ik is always there.
"""

if __name__ == "__main__":
    from mcx_jax.console.command import begin

    begin()

import dataclasses
import sys
from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro

from mcx_jax.config import command_line
from mcx_jax.config.task import EnvConfig, MotionConfig
from mcx_jax.errors import UserError
from mcx_jax.evaluate import EvaluateConfig
from mcx_jax.report.folder import PAGE, check_out, write


@dataclass(frozen=True)
class ReportConfig:
    """One self-contained HTML page about controllers, and its figures as PNG files beside it."""

    runs: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="RUN ...")] = ()
    """Any of ik, extrapolate, extrapolate-best, fir, preview, shipped:DELAY, run directories and
    policy .npz files."""
    out: str = ""
    """Directory to write to: a new one, an empty one, or an earlier report's."""
    episodes: int = 50
    """Test episodes per sea state (paper: 50)."""
    seed: int = 0
    """Seed of the episodes' windows and goals, as in evaluate."""
    show: int = 0
    """Which of the episodes (0, 1, ...) is drawn over time, in the last sea."""
    noise_sweep: bool = False
    """Errors against measurement noise too: half a minute for each controller, to compile."""
    device: Literal["auto", "cpu", "gpu"] = "auto"
    """Where to run; auto = GPU if JAX has one."""
    env: EnvConfig = field(default_factory=EnvConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)

    def __post_init__(self) -> None:
        EvaluateConfig(who="ik", episodes=self.episodes, seed=self.seed)  # the same limits
        if not 0 <= self.show < self.episodes:
            raise UserError(f"--show {self.show}: must be 0 to {self.episodes - 1} (--episodes)")


def main(argv: list[str] | None = None) -> None:
    """Command line."""
    from mcx_jax import extras
    from mcx_jax.compute import startup
    from mcx_jax.report import entries

    argv = list(sys.argv[1:] if argv is None else argv)
    config = command_line.parse(ReportConfig, argv, prog="report")
    names = entries.check_names(config.runs)
    out = check_out(config.out)
    extras.require("matplotlib", "report")
    for line in startup.configure(config.device, mjx=config.env.physics == "mjx"):
        print(line)
    loaded = entries.load_entries(names)
    own = dataclasses.replace(EnvConfig(), **entries.common_settings(loaded, argv))
    # Again, with the runs' own task as the defaults.
    config = command_line.parse(ReportConfig, argv, prog="report", default=ReportConfig(env=own))
    print(config.env.describe_delays())

    from mcx_jax.report.build import build

    html, pngs, results = build(config, loaded, argv, say=lambda text: print(text, flush=True))
    write(out, html, pngs, results)
    print(f"done: {out / PAGE}")


if __name__ == "__main__":
    from mcx_jax.compute.startup import run_command

    run_command(main)
