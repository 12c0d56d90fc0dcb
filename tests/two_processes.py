"""One process of several that train a run: `python two_processes.py RUN PLACE [SIGNAL ITERATION]`,
which it sends to itself after that iteration."""

import os
import sys
from pathlib import Path

import lives

from mcx_jax.compute import processes, startup
from mcx_jax.runs.loop import train
from mcx_jax.runs.run_dir import CONFIG, open_existing, open_new


def main() -> None:
    processes.SILENCE_S = float(os.environ.get("SILENCE_S", processes.SILENCE_S))
    run, place = Path(sys.argv[1]), sys.argv[2]
    if sys.argv[3:]:
        lives.signal_after(int(sys.argv[4]), int(sys.argv[3]))
    begun = (run / CONFIG).exists()
    opened = (open_existing if begun else open_new)(run, lives.RUN_CONFIG)
    processes.join(place)
    train(opened, lives.make_env, checkpoint_interval_s=0.0)
    processes.part()
    print("parted", processes.first(), flush=True)


if __name__ == "__main__":
    startup.run_command(main)
