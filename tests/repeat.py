"""What one seed gives, as digests of all bits: `python repeat.py CORES` prints a line of JSON.

Every part is computed twice in the process, with the same compiled programs; no compilation cache,
so that another process compiles anew. Optimisation level 0: a third of the compile time.
"""

import hashlib
import json
import os
import sys
from dataclasses import replace

os.environ["MCX_JAX_CACHE"] = ""
os.environ["XLA_FLAGS"] = "--xla_backend_optimization_level=0"

from mcx_jax.compute import startup

if __name__ == "__main__":
    startup.configure("cpu", cores=int(sys.argv[1]))

import jax
import jax.numpy as jnp
import numpy as np
from probe_envs import make_probe
from test_first_order import CONFIG as FIRST_ORDER
from test_ppo_trainer import CONFIG as PPO

from mcx_jax.config.task import EnvConfig, MotionConfig
from mcx_jax.controllers.classical import CLASSICAL
from mcx_jax.evaluate import errors_beside_ik, evaluation_env, rows_beside_ik
from mcx_jax.runs import checkpoint
from mcx_jax.runs.programs import prepare


def digest(tree) -> str:
    """SHA-256 of every leaf's bytes, random keys as their data."""
    total = hashlib.sha256()
    for path, leaf in checkpoint.flatten(tree).items():
        total.update(path.encode() + np.asarray(jax.device_get(leaf)).tobytes())
    return total.hexdigest()


def training(config):
    """seed -> digest of the state and the metrics after two iterations."""
    programs = prepare(replace(config, seed=0), make_probe(scale=0.01))

    def run(seed):
        mine = replace(programs, seeds=jnp.zeros_like(programs.seeds) + seed)
        state = mine.start()
        for i in range(2):
            state, metrics = mine.iterate(state, i)
        return digest((state, metrics))

    return run


def episodes():
    """seed -> digests of every step of two episodes (reset, 60 steps; Euler, whose chatter doubles
    any difference) and of the JSON that `evaluate` makes of them."""
    env = evaluation_env(EnvConfig(delay="E2", episode_steps=60), MotionConfig(sea="Wd"))

    def run(seed):
        errors = errors_beside_ik(
            "extrapolate", CLASSICAL["extrapolate"], env, episodes=2, seed=seed
        )
        rows = json.dumps(rows_beside_ik(errors))
        return digest(
            [(e.pos_m, e.ang_rad, e.correction, e.torque_share) for e in errors]
        ), hashlib.sha256(rows.encode()).hexdigest()

    return run


PARTS = {
    "ppo": lambda: training(PPO),
    "first-order": lambda: training(FIRST_ORDER),
    "episodes": episodes,
}


if __name__ == "__main__":
    found = {}
    for name, make in PARTS.items():
        run = make()
        found[name] = [run(0), run(0), run(1)]
    print(json.dumps(found))
