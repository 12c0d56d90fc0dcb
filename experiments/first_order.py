"""Train by the gradient through the simulator, one run a delay, and evaluate all on the four seas.

    python experiments/first_order.py [--integrator implicitfast] [DELAY...]

Runs are kept in runs/ and gone on with if they are not finished; writes experiments/first_order.csv
(first_order_quiet.csv with implicitfast), rows of `ik` and of the runs.
"""

import subprocess
import sys
from pathlib import Path

from record import run_rows, write_rows

from mcx_jax import startup
from mcx_jax.checkpoint import latest
from mcx_jax.run_dir import CONFIG, stored_config

DELAYS = ("E0", "B4_21", "E1", "B4_4", "E2")


def trained(delay: str, quiet: bool) -> Path:
    """The run of a delay, trained to its end."""
    run = Path("runs") / f"{delay}-first-order-s0{'-quiet' if quiet else ''}"
    command = [sys.executable, "-m", "mcx_jax.train", "--algo", "first-order", "--delay", delay]
    command += ["--run-dir", str(run)] + ["--integrator", "implicitfast"] * quiet
    begun = (run / CONFIG).exists()
    if not begun or latest(run) != stored_config(run).iterations:
        command += ["--resume"] * begun
        print(" ".join(command), flush=True)
        subprocess.run(command, check=True)
    return run


def main() -> None:
    quiet = "implicitfast" in sys.argv
    delays = [word for word in sys.argv[1:] if word in DELAYS] or DELAYS
    runs = [trained(delay, quiet) for delay in delays]
    startup.configure()
    rows = [row for run in runs for row in run_rows(run)]
    write_rows("first_order_quiet" if quiet else "first_order", rows)


if __name__ == "__main__":
    main()
