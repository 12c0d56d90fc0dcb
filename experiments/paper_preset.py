"""How far the paper's own schedule comes in its first iterations.

    python -m mcx_jax.train --preset paper --delay B4_4 --run-dir runs/B4_4-paper-s0    (Ctrl-C)
    python experiments/paper_preset.py runs/B4_4-paper-s0

All of it is 2500 iterations of 8 x 1000 steps, 80 updates of the policy and 80 of the value each:
ten hours on two free cores. Writes experiments/paper_preset.csv, what the run has printed so far,
and experiments/paper_preset_evaluated.csv, the policy without exploration beside the IK baseline.
"""

import sys
from pathlib import Path

from record import provenance, run_rows, write_rows

from mcx_jax.compute import startup
from mcx_jax.runs.run_dir import METRICS, whole_rows

KEPT = {
    **{"iteration": "d", "steps": "d", "pos_error_mm": ".3f", "ang_error_mrad": ".3f"},
    **{"reward": ".6f", "sigma": ".4f", "policy_steps": ".0f", "wall_s": ".0f"},
}


def main() -> None:
    startup.configure()
    run, origin = Path(sys.argv[1]), provenance()
    write_rows(
        "paper_preset",
        [
            {name: f"{row[name]:{form}}" for name, form in KEPT.items()} | origin
            for row in whole_rows(run / METRICS)
        ],
    )
    write_rows("paper_preset_evaluated", run_rows(run))


if __name__ == "__main__":
    main()
