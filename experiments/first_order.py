"""Train by the gradient through the simulator, one run a delay, and evaluate all on the four seas.

    python experiments/first_order.py [--integrator implicitfast] [DELAY...]

Runs are kept in runs/ and gone on with; writes experiments/first_order.csv (first_order_quiet.csv
with implicitfast), rows of `ik` and of the runs with their training steps and seconds.
"""

import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

from record import evaluation_rows, provenance, write_rows

from mcx_jax import startup
from mcx_jax.run_dir import METRICS, POLICY

DELAYS = ("E0", "B4_21", "E1", "B4_4", "E2")


def trained(delay: str, quiet: bool) -> Path:
    """The run of a delay, trained to its end."""
    run = Path("runs") / f"{delay}-first-order-s0{'-quiet' if quiet else ''}"
    command = [sys.executable, "-m", "mcx_jax.train", "--algo", "first-order", "--delay", delay]
    command += ["--run-dir", str(run)] + ["--integrator", "implicitfast"] * quiet
    if not (run / POLICY).exists():
        print(" ".join(command), flush=True)
        subprocess.run(command, check=True)
    return run


def main() -> None:
    quiet = "implicitfast" in sys.argv
    delays = [word for word in sys.argv[1:] if word in DELAYS] or DELAYS
    runs = {delay: trained(delay, quiet) for delay in delays}
    startup.configure()
    from mcx_jax import cli
    from mcx_jax.config import TrainConfig
    from mcx_jax.evaluate import evaluate_beside_ik, load_controller

    out = []
    for run in runs.values():
        config = cli.config_from_json(TrainConfig, (run / "config.json").read_text())
        last = json.loads((run / METRICS).read_text().splitlines()[-1])
        _, controller = load_controller(str(run))
        env = replace(config.env, episode_steps=1000)
        begun = time.monotonic()
        baseline, rows = evaluate_beside_ik(config.algo, controller, env, config.motion)
        steps = {"steps": last["steps"], "train_seconds": f"{last['wall_s']:.0f}"}
        found = evaluation_rows(baseline + rows, time.monotonic() - begun)
        out += [{**row, **steps, **provenance()} for row in found]
    write_rows("first_order_quiet" if quiet else "first_order", out)


if __name__ == "__main__":
    main()
