"""A training run from its first iteration to its last: metrics, checkpoints, policies, stopping.

`mcx_jax.train` is the command; nothing here reads a command line.
"""

import contextlib
import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from mcx_jax.compute import processes
from mcx_jax.config import command_line
from mcx_jax.config.task import EnvConfig, MotionConfig
from mcx_jax.config.training import TrainConfig
from mcx_jax.console import command, streams
from mcx_jax.console.terminal import working
from mcx_jax.errors import UserError
from mcx_jax.runs import checkpoint, tensorboard
from mcx_jax.runs.progress import Progress, short_time
from mcx_jax.runs.run_dir import CONFIG, POLICY, RunDir, writing
from mcx_jax.runs.stop import StopRequest

if TYPE_CHECKING:
    from mcx_jax.policy.file import Policy
    from mcx_jax.ppo.trainer import IterationMetrics, TrainState
    from mcx_jax.runs.programs import Training


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

    from mcx_jax.policy.file import Policy, PolicyMeta

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
            config=command_line.config_to_json(config),
            iteration=int(iteration),
            seed=config.seed + k,
        )
        return Policy(params, stats, meta)

    return [policy(k) for k in range(config.seeds)]


def save(run: RunDir, state: "TrainState", rows: list[dict[str, Any]]) -> "tuple[Policy, int]":
    """Checkpoint and policy files; policy.npz is the best seed by reward of the last iteration.

    Returns:
        The best policy, and its seed.

    Raises:
        UserError: they cannot be written.
    """
    try:
        return _save(run, state, rows)
    except UserError:
        # Alone, since all processes have to take part in a checkpoint.
        if not (processes.alone() and run.follow()):
            raise
        return _save(run, state, rows)  # the directory was moved meanwhile


def _save(run: RunDir, state: "TrainState", rows: list[dict[str, Any]]) -> "tuple[Policy, int]":
    from mcx_jax.policy.file import save_policy

    policies = policies_of(run.config, state)
    rewards = {row["seed"]: row["reward"] for row in rows if math.isfinite(row["reward"])}
    best = max(range(len(policies)), key=lambda k: rewards.get(policies[k].meta.seed, -math.inf))
    if run.writes:
        with writing(run.path):
            if len(policies) > 1:
                for policy in policies:
                    save_policy(run.path / f"policy_s{policy.meta.seed}.npz", policy)
            save_policy(run.path / POLICY, policies[best])
    # Last: a run killed before goes on from the checkpoint before, and writes the policies again.
    config = command_line.config_to_json(run.config)
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
    from mcx_jax.runs.divergence import Watch

    config, progress = run.config, Progress(run.config, run.start_iteration)
    progress.begin()
    watch = Watch(run)
    saved = time.monotonic()
    rows = run.last_rows()
    for iteration in range(run.start_iteration + 1, config.iterations + 1):
        watch.before_iteration(state)
        state, metrics = training.iterate(state, iteration - 1)
        rows = metric_rows(config, iteration, metrics)
        moved = run.append([{**row, "wall_s": time.monotonic() - progress.begun} for row in rows])
        if events:
            events.append(rows)
        progress.show(rows)
        watch.after_iteration(state, rows)
        overdue = moved or time.monotonic() - saved > checkpoint_interval_s
        signum, overdue = processes.agree(stop.signum, overdue)
        if signum:  # not stored unless there is one: a signal that came meanwhile is kept
            stop.signum = signum
            break
        if overdue and not watch.lost:
            watch.check(state, rows)
            save(run, state, rows)
            saved = time.monotonic()
    watch.check(state, rows)
    policy, seed = save(run, state, rows)
    run.note(streams.take_losses())
    if config.seeds > 1:
        print(f"{run.path / POLICY}: seed {seed}, the best of {config.seeds} by training reward")
    return policy


def first_policy(config: TrainConfig, env: Any) -> "Policy | None":
    """The policy that a new run begins with, if it was asked for.

    Raises:
        UserError: it cannot be read, or is of another shape than this run's.
    """
    if not config.start_from:
        return None
    from mcx_jax.policy.file import load_run

    policy = load_run(config.start_from)
    meta, ppo = policy.meta, config.ppo
    theirs = (meta.obs_size, meta.action_size, meta.hidden, meta.cell)
    ours = (env.obs_size, env.action_size, ppo.hidden, ppo.cell)
    words = ("observations", "actions", "--hidden units", "as its --cell")
    for what, have, want in zip(words, theirs, ours, strict=True):
        if have != want:
            raise UserError(
                f"--start-from {config.start_from}: that policy has {have} {what}, this run "
                f"{want}; change this run's settings, or start from another policy"
            )
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
    run.writes = processes.first()
    with processes.together(run.path), run.held():
        return _train(run, make_env, events and run.writes, checkpoint_interval_s)


def _train(
    run: RunDir, make_env: Callable[..., Any], events: bool, checkpoint_interval_s: float
) -> "Policy":
    config = run.config
    begun = time.monotonic()
    if config.iterations * config.steps_per_iteration != config.total_steps:
        print(rounded_up(config))
    with working("preparing the vessels' motion") as say:
        from mcx_jax.runs.programs import prepare

        env = make_env(config.env, config.motion, split="train")
        first = None if run.start_iteration else first_policy(config, env)
        ready = time.monotonic()
        say("compiling (1 to 2 min the first time)")
        training = prepare(config, env)
    print(
        f"set-up {short_time(ready - begun)}, compile {short_time(time.monotonic() - ready)}; "
        f"{config.iterations} iterations of {config.num_envs} x {config.iteration_steps} steps",
        flush=True,
    )
    if run.start_iteration:
        state = checkpoint.restore(run.path, training.like, run.start_iteration)
    else:
        state = training.start(first)
    run.create()
    processes.agree(0)  # the others read what it has cut
    if run.start_iteration:
        print(f"going on after iteration {run.start_iteration}")
    with contextlib.ExitStack() as stack:
        file = None
        if events:
            file = tensorboard.EventFile(run.path, config, run.start_iteration)
            stack.enter_context(file)
        stop = stack.enter_context(StopRequest())
        policy = iterate(run, training, state, stop, file, checkpoint_interval_s)
    if stop.signum:
        streams.end_line()
        print(f"saved after iteration {policy.meta.iteration} of {config.iterations}; {rest(run)}")
        raise SystemExit(128 + stop.signum)
    return policy


def table_motion(config: TrainConfig) -> MotionConfig:
    """The motion of a run's final table: all four seas, if it was trained on one of them."""
    named = config.motion.sea in ("all", "Wa", "Wb", "Wc", "Wd")
    return replace(config.motion, sea="all") if named else config.motion


def table_line(run: RunDir) -> str:
    """The command that makes the table of a finished run."""
    task = (run.config.env, EnvConfig()), (table_motion(run.config), MotionConfig())
    words = [word for ours, theirs in task for word in command_line.flags(ours, theirs, UNUSED)]
    return command.line("evaluate", run.path, *words)


UNUSED = ("episode_steps",)
"""Of a run's task, what its table does not use."""


def rounded_up(config: TrainConfig) -> str:
    """What is said where --total-steps is no whole number of iterations."""
    whole = config.iterations * config.steps_per_iteration
    return (
        f"--total-steps {config.total_steps:,} is rounded up to {whole:,}: {config.iterations} "
        f"iterations of {config.steps_per_iteration:,} steps"
    )


def rest(run: RunDir) -> str:
    """What is left to do after the last checkpoint, and the command that does it."""
    last = checkpoint.latest(run.path)
    if last == run.config.iterations:
        return f"make the table with:\n{table_line(run)}"
    if last:
        return f"go on from iteration {last} with:\n{run.resume_line}"
    if (run.path / CONFIG).exists():
        return f"there is no checkpoint yet; begin again with:\n{run.resume_line}"
    return "the run had not begun, nothing is saved"
