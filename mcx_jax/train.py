"""`python -m mcx_jax.train --delay D --num-envs N`: train a policy; see `--help`.

Writes DIR/{config.json, metrics.jsonl, checkpoints/, policy.npz}. The command line is read and the
directory checked before anything is computed, so that mistakes are reported immediately.
"""

if __name__ == "__main__":
    from mcx_jax.console.command import begin

    begin()

import functools
import os
import sys
import tempfile
import uuid
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from mcx_jax.assets import policy_file
from mcx_jax.compute import machine, processes
from mcx_jax.config import command_line
from mcx_jax.config.training import TrainConfig, preset_config
from mcx_jax.console import streams
from mcx_jax.console.command import last_words
from mcx_jax.errors import UserError
from mcx_jax.runs import tensorboard
from mcx_jax.runs.loop import rest, table_motion, train
from mcx_jax.runs.run_dir import (
    POLICY,
    RunDir,
    default_path,
    open_existing,
    open_new,
    stored_config,
)

if TYPE_CHECKING:
    from mcx_jax.policy.file import Policy

FIRST_ORDER_USES = ("hidden", "cell", "lr_decay", "max_grad_norm")
"""Settings of PPO that --algo first-order has, too."""

STORED = ("run_dir", "resume", "resume_from", "train")
"""Fields of TrainCommand that a run's directory holds, or that --resume replaces."""

FINAL_EPISODES, FINAL_STEPS = 50, 1000
SMOKE_EPISODES, SMOKE_STEPS = 2, 96
SMOKE_ITERATIONS = 3


@dataclass(frozen=True)
class TrainCommand:
    """Train a policy that corrects the arm's goal against the delay of its actuation."""

    run_dir: str = ""
    """Directory of the run; default runs/<delay>-<preset or first-order>-s<seed>."""
    resume: bool = False
    """Go on with the run in --run-dir from its last checkpoint, exactly as if never stopped."""
    resume_from: int = 0
    """Go on from the checkpoint of this iteration; 0 = the last one."""
    checkpoint_interval_s: float = 60.0
    """Seconds between checkpoints; 0 = one after every iteration."""
    smoke: bool = False
    """Try the whole path on a tiny run (a minute), in a temporary directory unless --run-dir."""
    device: Literal["auto", "cpu", "gpu"] = "auto"
    """Where to compute."""
    distributed: str = ""
    """One run over several processes that see the same --run-dir: auto (Slurm, Open MPI or
    Kubernetes tell who takes part) or HOST:PORT,I/N (this is process I of N, and process 0 listens
    there)."""
    tensorboard: bool = False
    """Also write TensorBoard event files into the run's directory (extra viz)."""
    train: TrainConfig = field(default_factory=TrainConfig)

    def __post_init__(self) -> None:
        """Refuse what cannot be meant."""
        for flag, value in (
            ("--resume-from", self.resume_from),
            ("--checkpoint-interval-s", self.checkpoint_interval_s),
        ):
            if not value >= 0:
                raise UserError(f"{flag} {value}: must be 0 or a positive number")
        processes.check(self.distributed)


def smoke_config(config: TrainConfig) -> TrainConfig:
    """A preset's defaults made tiny: 16 environments, 96-step episodes, three iterations."""
    fast = config.preset == "fast"
    window, episode = (32, 96) if fast else (96, 96)
    ppo = replace(
        config.ppo,
        window_steps=window,
        sequence_steps=window,
        epochs=min(config.ppo.epochs, 4),
        minibatches=2 if fast else 1,
    )
    first_order = replace(config.first_order, horizon_steps=8, windows=4)
    env = replace(config.env, episode_steps=episode)
    steps = SMOKE_ITERATIONS * 16 * window
    return replace(
        config, num_envs=16, total_steps=steps, env=env, ppo=ppo, first_order=first_order
    )


def _refuse_unused(asked: TrainConfig, defaults: TrainConfig) -> None:
    """A setting of the other algorithm would be without effect."""
    other = "first_order" if asked.algo == "ppo" else "ppo"
    ours, theirs = getattr(asked, other), getattr(defaults, other)
    for setting in fields(ours):
        name = setting.name
        if name not in FIRST_ORDER_USES and getattr(ours, name) != getattr(theirs, name):
            flag = f"--{name.replace('_', '-')} {getattr(ours, name)}"
            raise UserError(f"{flag} has no meaning with --algo {asked.algo}; leave it out")


def _refuse_no_policy(start_from: str) -> None:
    if start_from and not os.path.isfile(policy_file(start_from)):
        raise UserError(
            f"--start-from {start_from}: no policy there; name a run directory, a policy .npz or "
            "shipped:DELAY"
        )


def read_command(argv: list[str]) -> tuple[TrainCommand, RunDir]:
    """The command and its checked directory; nothing is written.

    `--preset` and `--smoke` change the defaults of the other flags; with `--resume` or
    `--resume-from` the stored configuration is the default, and a flag that contradicts it is
    refused.
    """
    algo = command_line.value_of(argv, "--algo") or "ppo"
    defaults = preset_config(command_line.value_of(argv, "--preset") or "fast", algo)
    if "--smoke" in argv:
        defaults = smoke_config(defaults)
    parse = functools.partial(command_line.parse, TrainCommand, argv, prog="train")
    command = parse(default=TrainCommand(train=defaults))
    if not command.resume and not command.resume_from:
        _refuse_unused(command.train, defaults)
        _refuse_no_policy(command.train.start_from)
        run = open_new(_directory(command), command.train)
        run.options = tuple(command_line.flags(command, TrainCommand(), STORED))
        return command, run
    path = Path(command.run_dir) if command.run_dir else default_path(command.train)
    command = parse(default=TrainCommand(train=stored_config(path)))
    run = open_existing(path, command.train, command.resume_from)
    run.options = tuple(command_line.flags(command, TrainCommand(), STORED))
    return command, run


def _directory(command: TrainCommand) -> Path:
    if command.run_dir:
        return Path(command.run_dir)
    if command.smoke:
        # A name alone: reading a command line leaves nothing behind.
        return Path(tempfile.gettempdir()) / f"mcx_jax-smoke-{uuid.uuid4().hex[:12]}"
    return default_path(command.train)


def final_table(config: TrainConfig, policy: "Policy", episodes: int, steps: int) -> None:
    """Evaluate the policy beside the IK baseline on test motion and print the table.

    Args:
        episodes: per sea.
        steps: control steps of an episode, whatever the length in training.
    """
    from mcx_jax.console.terminal import working
    from mcx_jax.evaluate import evaluate_beside_ik
    from mcx_jax.evaluation.table import print_table
    from mcx_jax.policy.file import PolicyController

    motion = table_motion(config)
    env = replace(config.env, episode_steps=steps)
    controller = PolicyController(policy)
    with working("evaluating on test motion") as say:
        baseline, rows = evaluate_beside_ik(
            "policy", controller, env, motion, episodes=episodes, say=say
        )
    print_table(baseline + rows, env, motion)


QUICK_COMPILE = "--xla_backend_optimization_level=0"
"""For --smoke, which compiles for a minute to compute for a second: a third of the compile time."""


def compile_quickly() -> str:
    """Set `QUICK_COMPILE` unless the user has set a level; returns what to tell the user."""
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_optimization_level" in flags:
        return "smoke run: compiled at the optimisation level that XLA_FLAGS names"
    os.environ["XLA_FLAGS"] = f"{flags} {QUICK_COMPILE}".strip()
    return "smoke run: compiled without optimisation, so that its speed means nothing"


def main(argv: list[str] | None = None) -> None:
    """Command line."""
    from mcx_jax.compute import startup

    command, run = read_command(list(sys.argv[1:] if argv is None else argv))
    if command.tensorboard:
        tensorboard.require()
    if command.smoke:
        print(compile_quickly())
    mjx = run.config.env.physics == "mjx"
    for line in startup.configure(command.device, mjx=mjx, distributed=command.distributed):
        print(line)
    print(machine.describe())
    print(run.config.env.describe_delays())
    print(f"run directory: {run.path}", flush=True)
    from mcx_jax.envs.v2v import make_env

    with last_words(lambda: f"stopped at once; {rest(run)}"):
        policy = train(
            run,
            make_env,
            events=command.tensorboard,
            checkpoint_interval_s=command.checkpoint_interval_s,
        )
        processes.part()
        if not processes.first():
            return
        length = (SMOKE_EPISODES, SMOKE_STEPS) if command.smoke else (FINAL_EPISODES, FINAL_STEPS)
        final_table(run.config, policy, *length)
    print(f"done: {run.path / POLICY}")
    run.note(streams.take_losses())


if __name__ == "__main__":
    from mcx_jax.compute.startup import run_command

    run_command(main)
