"""A training run in processes that are killed: `python lives.py RUN CORES LIFE...`.

The imports are made once; every LIFE is a fork of this process (JAX starts its threads after the
fork) that goes on with the run until it ends or is killed:

    end        to the end of the run
    term:I     SIGTERM to itself after iteration I
    event:K    kill -9 at its K-th operation on files of the run
    after:S    kill -9 from outside, S seconds after compiling

Prints a line of JSON a life, its signal or exit code and the last checkpoint; then the run's end.
"""

import hashlib
import json
import os
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path

from mcx_jax.compute import startup

startup.configure("cpu", cores=int(sys.argv[2]) if __name__ == "__main__" else 1)

import jax  # noqa: E402
import numpy as np  # noqa: E402
import orbax.checkpoint  # noqa: E402, F401
from probe_envs import make_probe  # noqa: E402

from mcx_jax.config.task import EnvConfig  # noqa: E402
from mcx_jax.config.training import preset_config  # noqa: E402
from mcx_jax.policy.file import load_policy, named_arrays  # noqa: E402
from mcx_jax.runs import checkpoint, divergence  # noqa: E402, F401
from mcx_jax.runs.loop import train  # noqa: E402
from mcx_jax.runs.programs import prepare  # noqa: E402
from mcx_jax.runs.progress import Progress  # noqa: E402
from mcx_jax.runs.run_dir import CONFIG, open_existing, open_new  # noqa: E402

ITERATIONS = 100
RUN_CONFIG = replace(
    preset_config("fast"),
    num_envs=8,
    total_steps=8 * 8 * ITERATIONS,
    env=EnvConfig(episode_steps=16),
    ppo=replace(
        preset_config("fast").ppo, window_steps=8, sequence_steps=4, minibatches=2, hidden=8
    ),
)
FILE_EVENTS = ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir")


def make_env(env_config, motion_config, split):
    return make_probe(scale=0.01)


def die_at(event: int, run: Path) -> None:
    """kill -9 at the given operation on a file of the run."""
    left = [event]

    def hook(name: str, args: tuple) -> None:
        if name in FILE_EVENTS and str(run) in str(args[0]):
            left[0] -= 1
            if not left[0]:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)


def signal_after(iteration: int, signum: int = signal.SIGTERM) -> None:
    """A signal to this process after an iteration."""
    show = Progress.show

    def show_and_stop(self, rows):
        show(self, rows)
        if rows[0]["iteration"] == iteration:
            os.kill(os.getpid(), signum)

    Progress.show = show_and_stop


def live(run: Path, kind: str, value: str) -> None:
    """What a forked process does."""
    if kind == "event":
        die_at(int(value), run)
    if kind == "term":
        signal_after(int(value))
    begun = (run / CONFIG).exists()
    opened = (open_existing if begun else open_new)(run, RUN_CONFIG)
    train(opened, make_env, checkpoint_interval_s=60.0 if kind == "end" else 0.0)


def fork_life(run: Path, life: str) -> int:
    """A life in a process of its own; its exit code, or minus the signal that killed it."""
    kind, _, value = life.partition(":")
    read, write = os.pipe()
    child = os.fork()
    if not child:
        os.dup2(write, 1)
        code = 1
        try:
            live(run, kind, value)
            code = 0
        except SystemExit as stop:
            code = stop.code
        finally:
            sys.stderr.flush()
            os._exit(code)
    os.close(write)
    with os.fdopen(read) as said:
        if kind == "after" and any("iterations of" in line for line in said):
            time.sleep(float(value))
            os.kill(child, signal.SIGKILL)  # not waited for yet, so it is still that process
        for _ in said:
            pass
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def end_of(run: Path) -> dict:
    """Everything that a run leaves, exactly; no wall-clock columns."""
    like = prepare(RUN_CONFIG, make_env(None, None, "train")).like
    leaves = checkpoint.flatten(checkpoint.restore(run, like))
    policy = named_arrays(load_policy(run / "policy.npz"))
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    for row in rows:
        row.pop("wall_s")

    def digests(arrays):
        arrays = {name: np.asarray(jax.device_get(x)) for name, x in arrays.items()}
        return {k: hashlib.sha256(x.tobytes()).hexdigest() for k, x in sorted(arrays.items())}

    return {
        "leaves": digests(leaves),
        "policy": digests(policy),
        "rows": rows,
        "iteration": checkpoint.latest(run),
        "devices": len(leaves[".actors.env_state.obs"].sharding.device_set),
    }


def main() -> None:
    run = Path(sys.argv[1])
    for life in sys.argv[3:]:
        code = fork_life(run, life)
        print(json.dumps({"code": code, "checkpoint": checkpoint.latest(run)}), flush=True)
    print(json.dumps(end_of(run)))


if __name__ == "__main__":
    main()
