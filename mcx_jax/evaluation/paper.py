"""The paper's published results (table 3), for comparison."""

import csv
import functools
from dataclasses import replace

from mcx_jax.assets import asset_path
from mcx_jax.config.task import COUPLED, ConditionsConfig, EnvConfig, MotionConfig


@functools.cache
def table3() -> dict[tuple[str, str], dict[str, float]]:
    """(delay, sea) -> columns of assets/paper_table3.csv as numbers."""
    lines = asset_path("paper_table3.csv").read_text().splitlines()
    rows = csv.DictReader(line for line in lines if not line.startswith("#"))
    return {
        (row["delay"], row["sea"]): {
            name: float(value) for name, value in row.items() if name not in ("delay", "sea")
        }
        for row in rows
    }


def is_papers_world(env: EnvConfig, motion: MotionConfig) -> bool:
    """Whether the paper measured this task, so that table 3 may stand beside it.

    That is every default: the arm `paper` with its tool and its integrator (Euler), a goal at rest,
    ideal measurements, the arm's own masses, the bound of corrections, vessels in generated waves
    that do not know of each other. Free are delay and sea, which `table3` looks up; the engine,
    since both simulate the same; the number of steps; and how test motion is divided from training.
    """
    same = replace(
        env,
        delay=EnvConfig.delay,
        physics=EnvConfig.physics,
        episode_steps=EnvConfig.episode_steps,
        integrator="model" if env.integrator == "euler" else env.integrator,
        conditions=ConditionsConfig(),
    )
    ideal = env.conditions.ranges == ConditionsConfig().ranges  # however it is written
    moved = replace(motion, sea=MotionConfig.sea, split=MotionConfig.split)
    apart = COUPLED not in motion.sea
    return apart and ideal and same == EnvConfig() and moved == MotionConfig()
