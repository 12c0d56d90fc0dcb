"""Train one run for every delay and seed, and evaluate all on the four seas.

    python experiments/sweep.py ppo|first-order [--integrator implicitfast] [--seeds N] [DELAY...]

Runs are kept in runs/ and gone on with if they are not finished. Writes experiments/ppo.csv or
first_order.csv (with implicitfast: ..._quiet.csv): rows of `ik` and of the runs, for the delays
named and those that the file has already.
"""

import csv
import subprocess
import sys
from pathlib import Path

from record import FOLDER, run_rows, write_rows

from mcx_jax import startup
from mcx_jax.checkpoint import latest
from mcx_jax.run_dir import CONFIG, stored_config

DELAYS = ("E0", "B4_21", "E1", "B4_4", "E2")


def trained(algo: str, delay: str, seed: int, quiet: bool) -> Path:
    """A run, trained to its end."""
    kind = "fast" if algo == "ppo" else algo
    run = Path("runs") / f"{delay}-{kind}-s{seed}{'-quiet' if quiet else ''}"
    command = [sys.executable, "-m", "mcx_jax.train", "--algo", algo, "--delay", delay]
    command += ["--seed", str(seed), "--run-dir", str(run)]
    command += ["--integrator", "implicitfast"] * quiet
    begun = (run / CONFIG).exists()
    if not begun or latest(run) != stored_config(run).iterations:
        command += ["--resume"] * begun
        print(" ".join(command), flush=True)
        subprocess.run(command, check=True)
    return run


def kept(name: str, delays: list[str]) -> list[dict]:
    """Rows of other delays that experiments/NAME.csv has."""
    path = FOLDER / f"{name}.csv"
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return [row for row in csv.DictReader(file) if row["delay"] not in delays]


def main() -> None:
    words = sys.argv[1:]
    algo, quiet = words[0], "implicitfast" in words
    seeds = int(words[words.index("--seeds") + 1]) if "--seeds" in words else 1
    delays = [word for word in words if word in DELAYS] or list(DELAYS)
    runs = [trained(algo, delay, seed, quiet) for delay in delays for seed in range(seeds)]
    startup.configure()
    rows = [row for run in runs for row in run_rows(run)]
    name = algo.replace("-", "_") + ("_quiet" if quiet else "")
    everything = kept(name, delays) + rows
    everything.sort(key=lambda row: DELAYS.index(row["delay"]))
    write_rows(name, everything)


if __name__ == "__main__":
    main()
