"""Train agents for every delay, all seeds of one in a single call, and evaluate them on four seas.

    python experiments/sweep.py ppo|first-order [--seeds N] [--quiet] [DELAY...] [-- TRAIN OPTIONS]

Runs are kept in runs/ under the names that `train` gives them and gone on with if they are not
finished; one run a seed, as tools/sweep.sbatch makes them, does as well. --quiet: with the
integrator quiet, "-quiet" in the names. Writes experiments/ppo.csv or first_order.csv
(..._quiet.csv): rows of `ik` and of every seed, for the delays named and those that the file has.
"""

import subprocess
import sys
from pathlib import Path

from record import commit, kept, run_rows, write_rows

from mcx_jax.compute import startup
from mcx_jax.runs.checkpoint import latest
from mcx_jax.runs.run_dir import CONFIG, stored_config

DELAYS = ("E0", "B4_21", "E1", "B4_4", "E2")
RUNS = Path("runs")


def trained(algo: str, delay: str, seeds: int, quiet: bool, options: list[str]) -> list[Path]:
    """Runs that hold the seeds 0 to seeds - 1 of a delay, trained to their end; from the first seed
    that is in no run on, all in one call."""
    stem = f"{delay}-{'fast' if algo == 'ppo' else algo}" + "-quiet" * quiet
    runs: list[Path] = []
    first = 0
    while first < seeds:
        named = (RUNS / f"{stem}-s{first}", *sorted(RUNS.glob(f"{stem}-s{first}-*")))
        begun = [run for run in named if (run / CONFIG).exists()]
        command = [sys.executable, "-m", "mcx_jax.train"]
        if begun:
            run = begun[-1]
            command += ["--run-dir", str(run), "--resume"]
        else:
            last = f"-{seeds - 1}" if seeds - 1 > first else ""
            run = RUNS / f"{stem}-s{first}{last}"
            command += ["--run-dir", str(run), "--algo", algo, "--delay", delay]
            command += ["--seed", str(first), "--seeds", str(seeds - first), *options]
            command += ["--integrator", "quiet"] * quiet
        if begun and stored_config(run).env.integrator != ("quiet" if quiet else "model"):
            raise SystemExit(f"{run}: of another integrator; move it away")
        if not begun or latest(run) != stored_config(run).iterations:
            print(" ".join(command), flush=True)
            subprocess.run(command, check=True)
        runs.append(run)
        first += stored_config(run).seeds
    return runs


def main() -> None:
    commit()
    words, options = sys.argv[1:], []
    if "--" in words:
        words, options = words[: words.index("--")], words[words.index("--") + 1 :]
    if not words or words[0] not in ("ppo", "first-order"):
        raise SystemExit(__doc__)
    algo, quiet = words[0], "--quiet" in words
    seeds = int(words[words.index("--seeds") + 1]) if "--seeds" in words else 1
    delays = [word for word in words[1:] if word in DELAYS] or list(DELAYS)
    if unknown := set(words[1:]) - {*DELAYS, "--quiet", "--seeds", str(seeds)}:
        raise SystemExit(f"unknown: {', '.join(unknown)}; delays are {', '.join(DELAYS)}")
    runs = [trained(algo, delay, seeds, quiet, options) for delay in delays]
    startup.configure()
    name = algo.replace("-", "_") + ("_quiet" if quiet else "")
    everything = kept(name, "delay", delays)
    for of_delay in runs:
        for k, run in enumerate(of_delay):
            everything += [row for row in run_rows(run) if row["who"] != "ik" or k == 0]
    everything.sort(key=lambda row: DELAYS.index(row["delay"]))
    write_rows(name, everything)


if __name__ == "__main__":
    main()
