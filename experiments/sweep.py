"""Train agents for every delay, all seeds of one in a single call, and evaluate them on four seas.

    python experiments/sweep.py ppo|first-order [--seeds N] [--quiet] [DELAY...] [-- TRAIN OPTIONS]

Runs are kept in runs/ under the names that `train` gives them (-quiet: the integrator implicitfast)
and gone on with if they are not finished; one run a seed, as tools/sweep.sbatch makes them, does as
well. Writes experiments/ppo.csv or first_order.csv (--quiet:
..._quiet.csv): rows of `ik` and of every seed, for the delays named and those that the file has.
"""

import subprocess
import sys
from pathlib import Path

from record import kept, run_rows, write_rows

from mcx_jax import startup
from mcx_jax.checkpoint import latest
from mcx_jax.run_dir import CONFIG, stored_config

DELAYS = ("E0", "B4_21", "E1", "B4_4", "E2")


def trained(algo: str, delay: str, seeds: int, quiet: bool, options: list[str]) -> list[Path]:
    """The runs of a delay, trained to their end."""
    kind, tail = "fast" if algo == "ppo" else algo, "-quiet" if quiet else ""
    single = [Path("runs") / f"{delay}-{kind}-s{seed}{tail}" for seed in range(seeds)]
    if seeds == 1 or all((run / CONFIG).exists() for run in single):
        return [finished(run, algo, delay, 1, quiet, options) for run in single]
    together = Path("runs") / f"{delay}-{kind}-s0-{seeds - 1}{tail}"
    return [finished(together, algo, delay, seeds, quiet, options)]


def finished(run: Path, algo: str, delay: str, seeds: int, quiet: bool, options: list[str]) -> Path:
    """A run, begun or gone on with if it has to be."""
    command = [sys.executable, "-m", "mcx_jax.train", "--run-dir", str(run)]
    begun = (run / CONFIG).exists()
    if begun:
        command += ["--resume"]
    else:
        command += ["--algo", algo, "--delay", delay, "--seeds", str(seeds), *options]
        command += ["--integrator", "implicitfast"] * quiet
    if not begun or latest(run) != stored_config(run).iterations:
        print(" ".join(command), flush=True)
        subprocess.run(command, check=True)
    return run


def main() -> None:
    words, options = sys.argv[1:], []
    if "--" in words:
        words, options = words[: words.index("--")], words[words.index("--") + 1 :]
    algo, quiet = words[0], "--quiet" in words
    seeds = int(words[words.index("--seeds") + 1]) if "--seeds" in words else 1
    delays = [word for word in words if word in DELAYS] or list(DELAYS)
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
