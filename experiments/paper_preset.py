"""How far the paper's own schedule comes in its first iterations.

    python -m mcx_jax.train --preset paper --delay B4_4 --run-dir runs/B4_4-paper-s0    (Ctrl-C)
    python experiments/paper_preset.py runs/B4_4-paper-s0

All of it is 2500 iterations of 8 x 1000 steps, 80 updates of the policy and 80 of the value each:
days on a CPU. Writes experiments/paper_preset.csv: what the run has printed so far.
"""

import json
import sys
from pathlib import Path

from record import provenance, write_rows

from mcx_jax.run_dir import METRICS

KEPT = ("steps", "pos_error_mm", "ang_error_mrad", "reward", "sigma", "wall_s")


def main() -> None:
    origin = provenance()
    lines = (Path(sys.argv[1]) / METRICS).read_text().splitlines()
    write_rows(
        "paper_preset",
        [
            {"iteration": row["iteration"], **{key: f"{row[key]:.4g}" for key in KEPT}, **origin}
            for row in map(json.loads, lines)
        ],
    )


if __name__ == "__main__":
    main()
