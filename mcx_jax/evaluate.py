"""`python -m mcx_jax.evaluate WHO --delay D`: errors of a controller over fixed test episodes.

WHO is ik, extrapolate, extrapolate-best, fir, preview, shipped:DELAY, a run directory or a policy
file. The same seed gives the same motion and the same goals to everyone.
"""

if __name__ == "__main__":
    from mcx_jax.console.command import begin

    begin()

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import tyro

from mcx_jax.config.delay import parse_delay
from mcx_jax.config.task import EnvConfig, MotionConfig
from mcx_jax.config.training import check_seed
from mcx_jax.console.terminal import silent, working
from mcx_jax.controllers.by_name import fit_if_needed, informed, load_controller
from mcx_jax.errors import UserError


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
    strain: Any
    """(steps, 2, seas, episodes) bool: goal out of reach, a joint too fast."""

    def rows(self) -> list[dict[str, Any]]:
        """One result row a sea (without the improvement)."""
        from mcx_jax.evaluation.statistics import effort, row, strain

        return [
            row(self.who, self.delay, sea, self.pos_m[:, i], self.ang_rad[:, i], self.valid[i])
            | effort(self.correction[:, :, i], self.torque_share[:, i])
            | strain(self.strain[:, :, i])
            for i, sea in enumerate(self.seas)
        ]


def evaluation_env(env_config: EnvConfig, motion_config: MotionConfig):
    """The task on test motion.

    Raises:
        UserError: episodes that end within the warm-up.
    """
    from mcx_jax.envs.v2v import make_env
    from mcx_jax.evaluation.statistics import LEAST_STEPS, WARM_UP_STEPS

    if env_config.episode_steps < LEAST_STEPS:
        raise UserError(
            f"--episode-steps {env_config.episode_steps}: the first {WARM_UP_STEPS} steps are not "
            f"counted; evaluate at least {LEAST_STEPS}"
        )
    return make_env(env_config, motion_config, split="test")


def errors_beside_ik(
    who: str,
    controller: Any,
    env,
    *,
    episodes: int,
    seed: int,
    say: Callable[[str], None] = silent,
) -> list[Errors]:
    """Errors of the IK baseline and of a controller on the same episodes; `ik` runs alone.

    Args:
        say: what happens is said to it (`mcx_jax.console.terminal.working`).
    """
    from mcx_jax.evaluation.episodes import episode_errors

    names = ("ik",) if who == "ik" else ("ik", who)
    gains = (0.0, 1.0)[: len(names)]
    count = len(names) * len(env.motion.seas) * episodes
    say(f"compiling (up to 2 min the first time) and running {count} episodes")
    dp, da, valid, correction, share, strain = episode_errors(
        env, controller, gains, episodes, seed
    )
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
            strain=strain[:, :, k],
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
    say: Callable[[str], None] = silent,
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Evaluate the IK baseline and a controller on the test motion of every sea asked for.

    Args:
        who: the controller's name in the result; `ik` runs the baseline alone.
        controller: see mcx_jax.controllers.classical.
        episodes: per sea.
        seed: of the windows of motion and the goals; the same for every controller.
        say: what happens is said to it (`mcx_jax.console.terminal.working`).

    Returns:
        (rows of ik, rows of who), one a sea, as described in the README (section Commands).

    Raises:
        UserError: episodes that end within the warm-up.
    """
    env = evaluation_env(env_config, motion_config)
    return rows_beside_ik(
        errors_beside_ik(who, controller, env, episodes=episodes, seed=seed, say=say)
    )


def rows_beside_ik(
    errors: list[Errors],
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """(rows of ik, rows of the other) with the improvement over ik, from `errors_beside_ik`."""
    from mcx_jax.evaluation.statistics import add_improvement

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


def main(argv: list[str] | None = None) -> None:
    """Command line."""
    from mcx_jax.compute import startup
    from mcx_jax.config import command_line
    from mcx_jax.evaluation.table import print_table

    argv = list(sys.argv[1:] if argv is None else argv)
    config = command_line.parse(
        EvaluateConfig, command_line.optional_value(argv, "--json", "-"), prog="evaluate"
    )
    quiet = config.json == "-"
    report = sys.stderr if quiet else sys.stdout
    command_line.check_output("--json", config.json)
    for line in startup.configure(config.device, mjx=config.env.physics == "mjx"):
        print(line, file=report)
    print(config.env.describe_delays(), file=report)
    with working("preparing the vessels' motion", report) as say:
        who, controller = load_controller(config.who)
        env = informed(evaluation_env(config.env, config.motion), config.known_delay)
        task = config.env, config.motion, config.known_delay
        controller = fit_if_needed(who, controller, *task, say)
        errors = errors_beside_ik(
            who, controller, env, episodes=config.episodes, seed=config.seed, say=say
        )
    baseline, rows = rows_beside_ik(errors)
    print_table(rows if who == "ik" else baseline + rows, config.env, config.motion, report)
    text = json.dumps(rows, indent=1, allow_nan=False)
    if quiet:
        print(text)
    elif config.json:
        command_line.write_output("--json", config.json, text + "\n")


if __name__ == "__main__":
    from mcx_jax.compute.startup import run_command

    run_command(main)
