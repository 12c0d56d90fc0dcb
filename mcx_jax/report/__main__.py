"""`python -m mcx_jax.report RUN... --out DIR`: one page about controllers, with all its figures.

RUN is what `evaluate` takes; ik is always there.
"""

if __name__ == "__main__":
    from mcx_jax.command import begin

    begin()

import dataclasses
import json
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from mcx_jax import cli
from mcx_jax.env_config import EnvConfig, MotionConfig
from mcx_jax.errors import UserError, reason
from mcx_jax.evaluate import EvaluateConfig

PAGE, RESULTS = "index.html", "results.json"
KIND = "mcx_jax report"


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


def check_out(out: str) -> Path:
    """The directory to write to.

    Raises:
        UserError: none named, a file, or a directory with something else in it.
    """
    if not out:
        raise UserError("--out is missing: name a directory for the report")
    path = Path(out)
    cli.check_name("--out", path)
    if path.exists() and not path.is_dir():
        raise UserError(f"--out {out}: is a file; name a directory")
    if path.is_dir() and any(path.iterdir()) and not _is_report(path):
        raise UserError(f"--out {out}: holds other files; name a new or an empty directory")
    # Before minutes of evaluation, not after.
    parent = next(p for p in (path, *path.absolute().parents) if p.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise UserError(f"--out {out}: cannot write in {parent}")
    return path


def _is_report(path: Path) -> bool:
    try:
        return json.loads((path / RESULTS).read_text())["kind"] == KIND
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return False


def main(argv: list[str] | None = None) -> None:
    """Command line."""
    from mcx_jax import startup
    from mcx_jax.report import entries

    argv = list(sys.argv[1:] if argv is None else argv)
    config = cli.parse(ReportConfig, argv, prog="report")
    names = entries.check_names(config.runs)
    out = check_out(config.out)
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        raise UserError("the report needs matplotlib: pip install 'mcx_jax[viz]'") from None
    for line in startup.configure(config.device, mjx=config.env.physics == "mjx"):
        print(line)
    loaded = entries.load_entries(names)
    own = dataclasses.replace(EnvConfig(), **entries.common_settings(loaded, argv))
    # Again, with the runs' own task as the defaults.
    config = cli.parse(ReportConfig, argv, prog="report", default=ReportConfig(env=own))
    print(config.env.describe_delays())

    from mcx_jax.report.build import build

    html, pngs, results = build(config, loaded, argv, say=lambda text: print(text, flush=True))
    write(out, html, pngs, {"kind": KIND, **results})
    print(f"done: {out / PAGE}")


def write(out: Path, html: str, pngs: dict[str, bytes], results: dict[str, Any]) -> None:
    """Write page, figures and results; an earlier report's figures that are no more go."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        for old in out.glob("*.png"):
            old.unlink()
        # First, so that a report cut short is known as one.
        (out / RESULTS).write_text(json.dumps(results, indent=1) + "\n")
        for name, data in pngs.items():
            (out / f"{name}.png").write_bytes(data)
        (out / PAGE).write_text(html, encoding="utf-8")
    except OSError as error:
        raise UserError(f"--out {out}: cannot be written ({reason(error)})") from None


if __name__ == "__main__":
    from mcx_jax.startup import run_command

    run_command(main)
