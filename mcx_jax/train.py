"""`python -m mcx_jax.train --delay D --num-envs N`: train a policy; see `--help`.

Writes DIR/{config.json, metrics.jsonl, checkpoints/, policy.npz}. The command line is read and the
directory checked before anything is computed, so that a mistake is told at once.
"""

import contextlib
import functools
import os
import sys
import tempfile
import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mcx_jax import checkpoint, cli, machine, tensorboard
from mcx_jax.config import TrainConfig, preset_config
from mcx_jax.errors import UserError
from mcx_jax.progress import Progress, short_time
from mcx_jax.run_dir import (
    POLICY,
    RunDir,
    default_path,
    open_existing,
    open_new,
    stored_config,
    writing,
)
from mcx_jax.stop import StopRequest

if TYPE_CHECKING:
    from mcx_jax.policy import Policy
    from mcx_jax.ppo.trainer import IterationMetrics, TrainState
    from mcx_jax.programs import Training

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


def read_command(argv: list[str]) -> tuple[TrainCommand, RunDir]:
    """The command and its checked directory; nothing is written.

    `--preset` and `--smoke` change the defaults of the other flags; with `--resume` or
    `--resume-from` the stored configuration is the default, and a flag that contradicts it is
    refused.
    """
    algo = cli.value_of(argv, "--algo") or "ppo"
    defaults = preset_config(cli.value_of(argv, "--preset") or "fast", algo)
    if "--smoke" in argv:
        defaults = smoke_config(defaults)
    parse = functools.partial(cli.parse, TrainCommand, argv, prog="train")
    command = parse(default=TrainCommand(train=defaults))
    if not command.resume and not command.resume_from:
        return command, open_new(_directory(command), command.train)
    path = Path(command.run_dir) if command.run_dir else default_path(command.train)
    command = parse(default=TrainCommand(train=stored_config(path)))
    return command, open_existing(path, command.train, command.resume_from)


def _directory(command: TrainCommand) -> Path:
    if command.run_dir:
        return Path(command.run_dir)
    if command.smoke:
        # A name alone: reading a command line leaves nothing behind.
        return Path(tempfile.gettempdir()) / f"mcx_jax-smoke-{uuid.uuid4().hex[:12]}"
    return default_path(command.train)


def metric_rows(
    config: TrainConfig, iteration: int, metrics: "IterationMetrics"
) -> list[dict[str, Any]]:
    """Rows of metrics.jsonl: one per seed."""
    import jax
    import numpy as np

    names = metrics.__dataclass_fields__
    values = {name: np.atleast_1d(jax.device_get(getattr(metrics, name))) for name in names}
    return [
        {
            "iteration": iteration,
            "steps": iteration * config.steps_per_iteration,
            "seed": config.seed + k,
            **{name: float(value[k]) for name, value in values.items()},
        }
        for k in range(config.seeds)
    ]


def policies_of(config: TrainConfig, state: "TrainState") -> "list[Policy]":
    """The policy of every seed."""
    import jax

    from mcx_jax.policy import Policy, PolicyMeta

    arrays = jax.device_get((state.learner.policy.params, state.obs_stats, state.iteration))
    if config.seeds == 1:
        arrays = jax.tree.map(lambda x: x[None], arrays)
    actions = arrays[0]["params"]["raw_sigma"].shape[-1]

    def policy(k: int) -> Policy:
        params, stats, iteration = jax.tree.map(lambda x: x[k], arrays)
        meta = PolicyMeta(
            obs_size=stats.mean.shape[-1],
            action_size=actions,
            hidden=config.ppo.hidden,
            cell=config.ppo.cell,
            config=cli.config_to_json(config),
            iteration=int(iteration),
            seed=config.seed + k,
        )
        return Policy(params, stats, meta)

    return [policy(k) for k in range(config.seeds)]


def save(run: RunDir, state: "TrainState", rows: list[dict[str, Any]]) -> "tuple[Policy, int]":
    """Checkpoint and policy files; policy.npz is the best seed by reward of the last iteration.

    Returns:
        The best policy, and its seed.
    """
    from mcx_jax.policy import save_policy

    policies = policies_of(run.config, state)
    best = max(range(len(policies)), key=lambda k: rows[k]["reward"] if rows else 0.0)
    with writing(run.path):
        if len(policies) > 1:
            for policy in policies:
                save_policy(run.path / f"policy_s{policy.meta.seed}.npz", policy)
        save_policy(run.path / POLICY, policies[best])
    # Last: a run killed before goes on from the checkpoint before, and writes the policies again.
    config = cli.config_to_json(run.config)
    checkpoint.save(run.path, policies[0].meta.iteration, state, config)
    return policies[best], policies[best].meta.seed


def iterate(
    run: RunDir,
    training: "Training",
    state: "TrainState",
    stop: StopRequest,
    events: "tensorboard.EventFile | None",
    checkpoint_interval_s: float,
) -> "Policy":
    """Train to the end, or to the first iteration after a request to stop.

    Returns:
        The policy that was saved last.

    Raises:
        UserError: training has diverged, or the directory cannot be written.
    """
    from mcx_jax.divergence import Watch

    config, progress = run.config, Progress(run.config, run.start_iteration)
    watch = Watch(run)
    saved = time.monotonic()
    rows = run.last_rows()
    for iteration in range(run.start_iteration + 1, config.iterations + 1):
        watch.before_iteration(state)
        state, metrics = training.iterate(state, iteration - 1)
        rows = metric_rows(config, iteration, metrics)
        run.append([{**row, "wall_s": time.monotonic() - progress.begun} for row in rows])
        if events:
            events.append(rows)
        progress.show(rows)
        watch.after_iteration(state, rows)
        if stop.signum:
            break
        if time.monotonic() - saved > checkpoint_interval_s and not watch.lost:
            watch.check(state, rows)
            save(run, state, rows)
            saved = time.monotonic()
    watch.check(state, rows)
    policy, seed = save(run, state, rows)
    if config.seeds > 1:
        print(f"{run.path / POLICY}: seed {seed}, the best of {config.seeds} by training reward")
    return policy


def train(
    run: RunDir,
    make_env: Callable[..., Any],
    *,
    events: bool = False,
    checkpoint_interval_s: float = 60.0,
) -> "Policy":
    """Build the environment, compile, and train; nobody else can use the directory meanwhile.

    Args:
        make_env: (env_config, motion_config, split="train") -> environment.
        events: write event files for TensorBoard, too.

    Raises:
        UserError: the arm, the motion, the checkpoint or the directory cannot be used; training
            diverges.
        SystemExit: stopped by a signal, after saving.
    """
    with run.held():
        return _train(run, make_env, events, checkpoint_interval_s)


def _train(
    run: RunDir, make_env: Callable[..., Any], events: bool, checkpoint_interval_s: float
) -> "Policy":
    from mcx_jax.programs import prepare

    config = run.config
    begun = time.monotonic()
    env = make_env(config.env, config.motion, split="train")
    ready = time.monotonic()
    training = prepare(config, env)
    print(
        f"set-up {short_time(ready - begun)}, compile {short_time(time.monotonic() - ready)}; "
        f"{config.iterations} iterations of {config.num_envs} x {config.iteration_steps} steps",
        flush=True,
    )
    if run.start_iteration:
        state = checkpoint.restore(run.path, training.like, run.start_iteration)
    else:
        state = training.start()
    run.create()
    if run.start_iteration:
        print(f"going on after iteration {run.start_iteration}")
    with contextlib.ExitStack() as stack:
        file = None
        if events:
            file = tensorboard.EventFile(run.path, config, run.start_iteration)
            stack.enter_context(file)
        stop = stack.enter_context(StopRequest())
        policy = iterate(run, training, state, stop, file, checkpoint_interval_s)
    if stop.signum and policy.meta.iteration < config.iterations:
        print(f"saved; go on with: python -m mcx_jax.train --run-dir {run.path} --resume")
        raise SystemExit(128 + stop.signum)
    return policy


def final_table(config: TrainConfig, policy: "Policy", episodes: int, steps: int) -> None:
    """Evaluate the policy beside the IK baseline on test motion and print the table.

    Args:
        episodes: per sea.
        steps: control steps of an episode, whatever the length in training.
    """
    from mcx_jax.evaluate import evaluate_beside_ik, print_table
    from mcx_jax.policy import PolicyController

    named = config.motion.sea in ("all", "Wa", "Wb", "Wc", "Wd")
    motion = replace(config.motion, sea="all") if named else config.motion
    env = replace(config.env, episode_steps=steps)
    controller = PolicyController(policy)
    baseline, rows = evaluate_beside_ik("policy", controller, env, motion, episodes=episodes)
    print_table(baseline + rows)


QUICK_COMPILE = "--xla_backend_optimization_level=0"
"""For --smoke, which compiles for a minute to compute for a second: a third of the compile time."""


def compile_quickly() -> str:
    """Set `QUICK_COMPILE` unless the user has set a level; returns what to tell the user."""
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_optimization_level" in flags:
        return "XLA_FLAGS: optimisation level as set by you"
    os.environ["XLA_FLAGS"] = f"{flags} {QUICK_COMPILE}".strip()
    return f"XLA_FLAGS += {QUICK_COMPILE} (a smoke run: its speed means nothing)"


def main(argv: list[str] | None = None) -> None:
    """Command line."""
    from mcx_jax import startup

    command, run = read_command(list(sys.argv[1:] if argv is None else argv))
    if command.tensorboard:
        tensorboard.require()
    if command.smoke:
        print(compile_quickly())
    for line in startup.configure(command.device, mjx=run.config.env.physics == "mjx"):
        print(line)
    print(machine.describe())
    print(run.config.env.describe_delays())
    print(f"run directory: {run.path}", flush=True)
    from mcx_jax.envs.v2v import make_env

    try:
        policy = train(
            run,
            make_env,
            events=command.tensorboard,
            checkpoint_interval_s=command.checkpoint_interval_s,
        )
    except KeyboardInterrupt:
        print("\nstopped before the end of an iteration; go on with --resume if a run had begun")
        raise SystemExit(130) from None
    length = (SMOKE_EPISODES, SMOKE_STEPS) if command.smoke else (FINAL_EPISODES, FINAL_STEPS)
    try:
        final_table(run.config, policy, *length)
    except KeyboardInterrupt:
        print(f"\nstopped before the table; python -m mcx_jax.evaluate {run.path} makes it")
        raise SystemExit(130) from None
    print(f"done: {run.path / POLICY}")


if __name__ == "__main__":
    from mcx_jax.startup import run_command

    run_command(main)
