"""`python -m mcx_jax.evaluate WHO --delay D`: errors of a controller over fixed test episodes.

WHO is ik, extrapolate, preview, a run directory or a policy file. The same seed gives the same
motion and the same goals to everyone.
"""

import functools
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tyro

from mcx_jax.config import EnvConfig, MotionConfig
from mcx_jax.errors import UserError

WHO = ("ik", "extrapolate", "preview")


@dataclass(frozen=True)
class EvaluateConfig:
    """Evaluate a controller on test motion that no training has seen."""

    who: tyro.conf.Positional[str]
    """ik, extrapolate, preview, a run directory, or a policy .npz file."""
    episodes: int = 50
    """Test episodes per sea state (paper: 50)."""
    seed: int = 0
    """Seed of the episodes' windows and goals; the same for everyone evaluated."""
    json: str = ""
    """Write the result as JSON to this file ('-' or no value: standard output)."""
    device: str = "auto"
    """auto, cpu or gpu."""
    env: EnvConfig = field(default_factory=EnvConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise UserError(f"--episodes {self.episodes}: must be a positive integer")
        if self.seed < 0:
            raise UserError(f"--seed {self.seed}: must be 0 or a positive integer")


def run_episodes(env, controller, keys, seas):
    """Whole episodes, batch axis last inside.

    Args:
        env: V2VEnv.
        controller: see mcx_jax.controllers.
        keys: (N,) PRNG keys.
        seas: (N,) int32 sea index per episode.

    Returns:
        dp (steps, N) m, da (steps, N) rad, valid (N,) bool.
    """
    import jax

    reset = jax.vmap(lambda k, s: env.reset(k, s), in_axes=0, out_axes=-1)
    step = jax.vmap(env.step, in_axes=-1, out_axes=-1)
    act = jax.vmap(functools.partial(controller.act, env), in_axes=-1, out_axes=-1)
    state = reset(keys, seas)
    memory = jax.vmap(functools.partial(controller.init, env), in_axes=-1, out_axes=-1)(state)

    def body(carry, _):
        state, memory = carry
        memory, action = act(state, memory)
        state = step(state, action)
        return (state, memory), (state.metrics.pos_error_m, state.metrics.ang_error_rad)

    (state, _), (dp, da) = jax.lax.scan(body, (state, memory), None, env.episode_steps)
    return dp, da, state.metrics.valid


@functools.cache
def _compiled():
    """One jitted `run_episodes` per process, so that repeated evaluations trace once."""
    import jax

    return jax.jit(run_episodes)


def episode_errors(env, controller, episodes: int, seed: int):
    """Errors of `episodes` test episodes in each of the env's seas, as NumPy arrays.

    Returns:
        (dp m, da rad, valid) of shapes (steps, seas, episodes), the same, (seas, episodes).
    """
    import jax
    import jax.numpy as jnp

    count = len(env.motion.seas)
    keys = jax.random.split(jax.random.key(seed), episodes)
    # The same windows and goals in every sea, so that a sea's difference is the sea's alone.
    keys = jnp.tile(keys, count)
    seas = jnp.repeat(jnp.arange(count, dtype=jnp.int32), episodes)
    dp, da, valid = jax.device_get(_compiled()(env, controller, keys, seas))
    shape = (-1, count, episodes)
    return dp.reshape(shape), da.reshape(shape), valid.reshape(count, episodes)


def evaluate(
    who: str,
    controller: Any,
    env_config: EnvConfig,
    motion_config: MotionConfig,
    *,
    episodes: int = 50,
    seed: int = 0,
    baseline: list[dict[str, Any]] | None = None,
) -> list[dict[str, Any]]:
    """Evaluate one controller on the test motion of every sea asked for.

    Args:
        who: its name in the result.
        controller: see mcx_jax.controllers.
        baseline: rows of `ik` for the same settings; run here if None.

    Returns:
        One row a sea, as described in the README (section Evaluate).

    Raises:
        UserError: episodes that end within the warm-up.
    """
    from mcx_jax.controllers import IK
    from mcx_jax.envs.v2v import make_env
    from mcx_jax.results import WARM_UP_STEPS, add_improvement, row

    if env_config.episode_steps <= WARM_UP_STEPS:
        raise UserError(
            f"--episode-steps {env_config.episode_steps}: the first {WARM_UP_STEPS} steps are not "
            f"counted; evaluate at least {WARM_UP_STEPS + 1}"
        )
    env = make_env(env_config, motion_config, split="test")

    def rows_of(name, ctrl):
        dp, da, valid = episode_errors(env, ctrl, episodes, seed)
        return [
            row(name, env_config.delay, sea, dp[:, i], da[:, i], valid[i])
            for i, sea in enumerate(env.motion.seas)
        ]

    rows = rows_of(who, controller)
    if baseline is None:
        baseline = rows if who == "ik" else rows_of("ik", IK())
    add_improvement(rows, baseline)
    return rows


def print_table(rows: list[dict[str, Any]], file=None) -> None:
    """Print result rows as a table, beside the paper's where it has such a cell."""
    from rich.console import Console
    from rich.table import Table

    from mcx_jax.results import paper_errors

    table = Table(title=f"tracking error, delay {rows[0]['delay']}")
    for name in ("who", "sea", "dp mm", "std", "top 5%", "top 1%", "max", "vs ik", "paper"):
        table.add_column(name, justify="left" if name in ("who", "sea") else "right")
    for name in ("da mrad", "std", "max", "vs ik", "paper", "invalid"):
        table.add_column(name, justify="right")
    for r in rows:
        p, a = r["pos_mm"], r["ang_mrad"]
        published = paper_errors(r["who"], r["delay"], r["sea"])
        table.add_row(
            *(r["who"], r["sea"], f"{p['mean']:.3f}", f"{p['std']:.2f}"),
            *(f"{p['top5']:.2f}", f"{p['top1']:.2f}", f"{p['max']:.2f}"),
            f"{100 * r['improvement']['pos']['all']:.0f} %",
            f"{published[0]:.2f}" if published else "-",
            *(f"{a['mean']:.3f}", f"{a['std']:.2f}", f"{a['max']:.2f}"),
            f"{100 * r['improvement']['ang']['all']:.0f} %",
            f"{published[1]:.2f}" if published else "-",
            f"{r['invalid_episodes']}/{r['episodes']}",
        )
    Console(file=file, width=None if (file or sys.stdout).isatty() else 150).print(table)


def load_controller(who: str) -> tuple[str, Any]:
    """(name, controller) for a name, a run directory or a policy file."""
    from mcx_jax.controllers import CLASSICAL

    if who in CLASSICAL:
        return who, CLASSICAL[who]
    path = Path(who)
    if not path.exists():
        raise UserError(
            f"unknown controller '{who}': use {', '.join(WHO)}, a run directory or a policy .npz"
        )
    from mcx_jax.policy import PolicyController, load_policy

    policy = load_policy(path / "policy.npz" if path.is_dir() else path)
    return who.rstrip("/"), PolicyController(policy)


def main(argv: list[str] | None = None) -> None:
    """Command line."""
    from mcx_jax import cli, startup

    argv = list(sys.argv[1:] if argv is None else argv)
    config = cli.parse(EvaluateConfig, cli.optional_value(argv, "--json", "-"), prog="evaluate")
    quiet = config.json == "-"
    report = sys.stderr if quiet else sys.stdout
    if config.json not in ("", "-") and not Path(config.json).parent.is_dir():
        raise UserError(f"--json {config.json}: no such directory")
    for line in startup.configure(config.device):
        print(line, file=report)
    print(config.env.parsed_delay.describe(), file=report)
    who, controller = load_controller(config.who)
    rows = evaluate(
        who, controller, config.env, config.motion, episodes=config.episodes, seed=config.seed
    )
    print_table(rows, file=report)
    if quiet:
        print(json.dumps(rows, indent=1))
    elif config.json:
        Path(config.json).write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    from mcx_jax.startup import run_command

    run_command(main)
