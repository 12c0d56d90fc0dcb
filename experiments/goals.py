"""Tracking a goal that moves on vessel B's deck (the paper's future work), delay B4_4.

    python experiments/goals.py

Trains one agent on `--goal lissajous` (gone on with if it is not finished) and evaluates it on
every path beside the controllers without learning, `fir` fitted on that path, and the agents that
were trained on goals at rest (PPO's by experiments/sweep.py). Writes experiments/goals.csv: means
over four seas, 50 episodes each.
"""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from record import commit, provenance, write_rows

from mcx_jax.compute import startup
from mcx_jax.config.task import EnvConfig, MotionConfig
from mcx_jax.controllers.by_name import fit_if_needed, load_controller
from mcx_jax.evaluate import evaluate
from mcx_jax.runs.checkpoint import latest
from mcx_jax.runs.run_dir import CONFIG, stored_config

GOALS = ("static", "circle", "lissajous")
RUN = Path("runs/B4_4-first-order-lissajous-s0")
WHO = {
    "ik": "ik",
    "extrapolate": "extrapolate",
    "extrapolate-best": "extrapolate-best",
    "fir": "fir",
    "preview": "preview",
    "ppo, goal at rest": "runs/B4_4-fast-s0",
    "first-order, goal at rest": "shipped:B4_4",
    "first-order, lissajous": str(RUN),
}


def train() -> None:
    command = [sys.executable, "-m", "mcx_jax.train", "--run-dir", str(RUN)]
    begun = (RUN / CONFIG).exists()
    command += ["--resume"] if begun else ["--algo", "first-order", "--goal", "lissajous"]
    if not begun or latest(RUN) != stored_config(RUN).iterations:
        subprocess.run(command, check=True)


def main() -> None:
    commit()
    train()
    startup.configure()
    rows = []
    for label, who in WHO.items():
        controller = load_controller(who)[1]
        for goal in GOALS:
            env, motion = EnvConfig(goal=goal), MotionConfig()
            begun = time.monotonic()
            ready = fit_if_needed(who, controller, env, motion, "")
            found = evaluate(label, ready, env, motion)
            mean = {
                f"{unit}_{kind}": f"{np.mean([r[unit][kind] for r in found]):.3f}"
                for unit in ("pos_mm", "ang_mrad")
                for kind in ("mean", "max")
            }
            seconds = f"{time.monotonic() - begun:.0f}"
            invalid = sum(r["invalid_episodes"] for r in found)
            rows.append(
                {"who": label, "goal": goal, **mean, "invalid": invalid, "seconds": seconds}
            )
            print(rows[-1], flush=True)
    write_rows("goals", [{**row, **provenance()} for row in rows])


if __name__ == "__main__":
    main()
