"""Evaluate a trained run on the four seas beside the baseline and store the result.

    python experiments/policy.py RUN_DIR NAME

Writes experiments/NAME.csv: rows of `ik` and of the run, with its training steps and seconds.
"""

import sys
from pathlib import Path

from record import run_rows, write_rows

from mcx_jax import startup


def main() -> None:
    startup.configure()
    write_rows(sys.argv[2], run_rows(Path(sys.argv[1])))


if __name__ == "__main__":
    main()
