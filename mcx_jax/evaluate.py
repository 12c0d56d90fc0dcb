"""`python -m mcx_jax.evaluate WHO --delay D`: errors of a controller over fixed test episodes.

WHO is ik, extrapolate, extrapolate-best, fir, preview, shipped:DELAY, a run directory or a policy
file. The same seed gives the same motion and the same goals to everyone.
"""

if __name__ == "__main__":
    from mcx_jax.command import begin

    begin()

import json
import sys
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import tyro

from mcx_jax.config import check_seed
from mcx_jax.delay import parse_delay
from mcx_jax.env_config import EnvConfig, MotionConfig
from mcx_jax.errors import UserError
from mcx_jax.paper import is_papers_world
from mcx_jax.roster import fit_if_needed, informed, load_controller


@dataclass(frozen=True)
class EvaluateConfig:
    """Evaluate a controller on test motion that no training has seen."""

    who: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="WHO")]
    """ik, extrapolate, extrapolate-best, fir, preview, shipped:DELAY (a trained policy that comes
    with mcx_jax), a run directory, or a policy .npz file."""
    episodes: int = 50
    """Test episodes per sea state (paper: 50)."""
    seed: int = 0
    """Seed of the episodes' windows and goals; the same for everyone evaluated."""
    known_delay: str = ""
    """Delay that controllers without learning are told; default the true one (the first)."""
    json: str = ""
    """Write the result as JSON to this file ('-' or no value: standard output)."""
    device: Literal["auto", "cpu", "gpu"] = "auto"
    """Where to run; auto = GPU if JAX has one."""
    env: EnvConfig = field(default_factory=EnvConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise UserError(f"--episodes {self.episodes}: must be a positive integer")
        check_seed(self.seed)
        if self.known_delay:
            parse_delay(self.known_delay)


@dataclass(frozen=True)
class Errors:
    """Errors of whole test episodes of one controller, NumPy."""

    who: str
    delay: str
    seas: tuple[str, ...]
    pos_m: Any
    """dp (steps, seas, episodes)."""
    ang_rad: Any
    """da (steps, seas, episodes)."""
    valid: Any
    """(seas, episodes) bool."""
    correction: Any
    """(steps, 6, seas, episodes) cm and crad."""
    torque_share: Any
    """(steps, seas, episodes), 1 = at the limit."""

    def rows(self) -> list[dict[str, Any]]:
        """One result row a sea (without the improvement)."""
        from mcx_jax.results import effort, row

        return [
            row(self.who, self.delay, sea, self.pos_m[:, i], self.ang_rad[:, i], self.valid[i])
            | effort(self.correction[:, :, i], self.torque_share[:, i])
            for i, sea in enumerate(self.seas)
        ]


def evaluation_env(env_config: EnvConfig, motion_config: MotionConfig):
    """The task on test motion.

    Raises:
        UserError: episodes that end within the warm-up.
    """
    from mcx_jax.envs.v2v import make_env
    from mcx_jax.results import WARM_UP_STEPS

    if env_config.episode_steps <= WARM_UP_STEPS:
        raise UserError(
            f"--episode-steps {env_config.episode_steps}: the first {WARM_UP_STEPS} steps are not "
            f"counted; evaluate at least {WARM_UP_STEPS + 1}"
        )
    return make_env(env_config, motion_config, split="test")


def errors_beside_ik(who: str, controller: Any, env, *, episodes: int, seed: int) -> list[Errors]:
    """Errors of the IK baseline and of a controller on the same episodes; `ik` runs alone."""
    from mcx_jax.episodes import episode_errors

    names = ("ik",) if who == "ik" else ("ik", who)
    gains = (0.0, 1.0)[: len(names)]
    dp, da, valid, correction, share = episode_errors(env, controller, gains, episodes, seed)
    return [
        Errors(
            who=name,
            delay=env.config.delay,
            seas=env.motion.seas,
            pos_m=dp[:, k],
            ang_rad=da[:, k],
            valid=valid[k],
            correction=correction[:, :, k],
            torque_share=share[:, k],
        )
        for k, name in enumerate(names)
    ]


def evaluate_beside_ik(
    who: str,
    controller: Any,
    env_config: EnvConfig,
    motion_config: MotionConfig,
    *,
    episodes: int = 50,
    seed: int = 0,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Evaluate the IK baseline and a controller on the test motion of every sea asked for.

    Args:
        who: the controller's name in the result; `ik` runs the baseline alone.
        controller: see mcx_jax.controllers.
        episodes: per sea.
        seed: of the windows of motion and the goals; the same for every controller.

    Returns:
        (rows of ik, rows of who), one a sea, as described in the README (section Commands).

    Raises:
        UserError: episodes that end within the warm-up.
    """
    env = evaluation_env(env_config, motion_config)
    return rows_beside_ik(errors_beside_ik(who, controller, env, episodes=episodes, seed=seed))


def rows_beside_ik(
    errors: list[Errors],
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """(rows of ik, rows of the other) with the improvement over ik, from `errors_beside_ik`."""
    from mcx_jax.results import add_improvement

    rows = [part.rows() for part in errors]
    for part in rows:
        add_improvement(part, rows[0])
    return rows[0], rows[-1]


def evaluate(
    who: str,
    controller: Any,
    env_config: EnvConfig,
    motion_config: MotionConfig,
    *,
    episodes: int = 50,
    seed: int = 0,
) -> list[dict[str, Any]]:
    """The controller's rows of `evaluate_beside_ik`."""
    return evaluate_beside_ik(
        who, controller, env_config, motion_config, episodes=episodes, seed=seed
    )[1]


def print_table(rows: list[dict[str, Any]], file=None, *, papers_world: bool) -> None:
    """Print result rows as a table.

    Args:
        papers_world: put table 3's means beside them, where it has such a delay and sea
            (`mcx_jax.paper.is_papers_world`).
    """
    from rich.console import Console
    from rich.table import Table

    from mcx_jax.results import paper_errors

    published = [paper_errors(r["who"], r["delay"], r["sea"]) for r in rows]
    beside = papers_world and any(published)
    paper = ("paper",) if beside else ()
    table = Table(title=f"tracking error, delay {rows[0]['delay']}")
    for name in ("who", "sea", "dp mm", "std", "top 5%", "top 1%", "max", "vs ik", *paper):
        table.add_column(name, justify="left" if name in ("who", "sea") else "right")
    for name in ("da mrad", "std", "max", "vs ik", *paper, "invalid"):
        table.add_column(name, justify="right")
    for r, means in zip(rows, published, strict=True):
        p, a = r["pos_mm"], r["ang_mrad"]
        papers = [(f"{x:.2f}",) for x in means] if means else [("-",), ("-",)]
        pos_paper, ang_paper = papers if beside else ((), ())
        table.add_row(
            *(r["who"], r["sea"], f"{p['mean']:.3f}", f"{p['std']:.2f}"),
            *(f"{p['top5']:.2f}", f"{p['top1']:.2f}", f"{p['max']:.2f}"),
            f"{100 * r['improvement']['pos']['all']:.0f} %",
            *pos_paper,
            *(f"{a['mean']:.3f}", f"{a['std']:.2f}", f"{a['max']:.2f}"),
            f"{100 * r['improvement']['ang']['all']:.0f} %",
            *ang_paper,
            f"{r['invalid_episodes']}/{r['episodes']}",
        )
    console = Console(file=file, width=None if (file or sys.stdout).isatty() else 150)
    console.print(table)
    for who in dict.fromkeys(r["who"] for r in rows):
        console.print(_effort_line(who, [r for r in rows if r["who"] == who]), highlight=False)


def _effort_line(who: str, rows: list[dict[str, Any]]) -> str:
    """The largest correction and the use of the torque limits over all seas."""
    corrections = [r["correction"] for r in rows]
    most = {name: max(c[name] for c in corrections) for name in corrections[0]}
    share = max(r["torque_share"]["mean"] for r in rows)
    limited = max(r["torque_share"]["at_limit"] for r in rows)
    far_mm, far_mrad, rate_mm_s, rate_mrad_s = (
        10 * most[name] for name in ("max_cm", "max_crad", "rate_cm_s", "rate_crad_s")
    )
    return (
        f"{who}, worst sea: correction up to {far_mm:.1f} mm {far_mrad:.1f} mrad, "
        f"mean rate {rate_mm_s:.0f} mm/s {rate_mrad_s:.0f} mrad/s; most loaded "
        f"joint at {100 * share:.0f} % of its torque limit on average, {100 * limited:.1f} % of "
        "the steps at the limit"
    )


def main(argv: list[str] | None = None) -> None:
    """Command line."""
    from mcx_jax import cli, startup

    argv = list(sys.argv[1:] if argv is None else argv)
    config = cli.parse(EvaluateConfig, cli.optional_value(argv, "--json", "-"), prog="evaluate")
    quiet = config.json == "-"
    report = sys.stderr if quiet else sys.stdout
    cli.check_output("--json", config.json)
    for line in startup.configure(config.device, mjx=config.env.physics == "mjx"):
        print(line, file=report)
    print(config.env.describe_delays(), file=report)
    who, controller = load_controller(config.who)
    env = informed(evaluation_env(config.env, config.motion), config.known_delay)
    controller = fit_if_needed(who, controller, config.env, config.motion, config.known_delay)
    errors = errors_beside_ik(who, controller, env, episodes=config.episodes, seed=config.seed)
    baseline, rows = rows_beside_ik(errors)
    ideal = is_papers_world(config.env, config.motion)
    print_table(rows if who == "ik" else baseline + rows, report, papers_world=ideal)
    if quiet:
        print(json.dumps(rows, indent=1))
    elif config.json:
        cli.write_output("--json", config.json, json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    from mcx_jax.startup import run_command

    run_command(main)
