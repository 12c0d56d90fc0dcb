"""Evaluate a trained run on the four seas beside the baseline and store the result.

    python experiments/policy.py RUN_DIR NAME

Writes experiments/NAME.csv: rows of `ik` and of the run, with its training steps and seconds.
"""

import json
import sys
import time
from pathlib import Path

from record import evaluation_rows, provenance, write_rows

from mcx_jax import cli, startup


def main() -> None:
    run, name = Path(sys.argv[1]), sys.argv[2]
    startup.configure()
    from dataclasses import replace

    from mcx_jax.config import TrainConfig
    from mcx_jax.evaluate import evaluate_beside_ik, load_controller

    config = cli.config_from_json(TrainConfig, (run / "config.json").read_text())
    last = json.loads((run / "metrics.jsonl").read_text().splitlines()[-1])
    _, controller = load_controller(str(run))
    env = replace(config.env, episode_steps=1000)
    begun = time.monotonic()
    baseline, rows = evaluate_beside_ik(config.algo, controller, env, config.motion)
    found = evaluation_rows(baseline + rows, time.monotonic() - begun)
    steps = {"steps": last["steps"], "train_seconds": f"{last['wall_s']:.0f}"}
    write_rows(name, [{**r, **steps, **provenance()} for r in found])


if __name__ == "__main__":
    main()
