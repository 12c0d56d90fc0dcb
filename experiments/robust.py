"""Controllers where the task is hard: noise, age of measurements, other delays, arms, loads, seas.

    python experiments/robust.py WHO...

WHO are ik, extrapolate, extrapolate-best, fir, preview, and trained policies (directories, .npz,
shipped:robust) for B4_4 or several delays; the file's rows of others are kept. Every condition is
measured on the same windows of motion and goals, 24 episodes in each of the four seas; one compiled
program per controller runs all conditions. `extrapolate` and `fir` believe in B4_4 throughout and
know the age of measurements; the lead of `extrapolate-best` is found without disturbances, `fir` is
fitted under the ranges of ANY and all DELAYS. Writes experiments/robust.csv.
"""

import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from record import commit, kept, provenance, write_rows

from mcx_jax.arm.plant import Plant
from mcx_jax.assets import SHIPPED
from mcx_jax.compute import startup
from mcx_jax.config.task import ConditionsConfig, EnvConfig, MotionConfig
from mcx_jax.controllers.by_name import FITTED, load_controller
from mcx_jax.controllers.classical import CLASSICAL
from mcx_jax.controllers.fitted import fitted
from mcx_jax.envs.conditions import Conditions, Noise
from mcx_jax.envs.v2v import make_env
from mcx_jax.evaluation.episodes import run_everywhere
from mcx_jax.evaluation.statistics import WARM_UP_STEPS

DELAYS = ("B4_4", "E1", "E2", "butter:4:8Hz")
EPISODES, SEED = 24, 0
ANY = ConditionsConfig("0:3", "0:3", "0:3", "0:5", "0.02:1")
"""Every condition below is in these bounds; it makes all of them inputs of one program."""


@dataclass(frozen=True)
class Row:
    """A condition; what is not said is the paper's world."""

    name: str
    noise_mm: float = 0.0
    noise_mrad: float = 0.0
    latency_steps: int = 0
    delay: str = "B4_4"
    payload_kg: float = 0.0
    wrist_inertia: float = 1.0
    quiet: float = 0.0
    sea: str = ""
    """Empty: the paper's four seas."""
    coupled: bool = False


ROWS = (
    Row("as trained by the paper"),
    *(Row(f"noise {x:g} mm", noise_mm=x) for x in (0.3, 1, 3)),
    *(Row(f"noise {x:g} mrad", noise_mrad=x) for x in (1, 3)),
    Row("noise 3 mm, 3 mrad", noise_mm=3, noise_mrad=3),
    *(Row(f"measured {k} steps late", latency_steps=k) for k in (1, 2, 3)),
    *(Row(f"delay {name}", delay=name) for name in DELAYS[1:]),
    *(Row(f"payload {x:g} kg", payload_kg=x) for x in (1, 2, 5)),
    *(Row(f"wrist inertia x {x:g}", wrist_inertia=x) for x in (0.1, 0.02)),
    Row("integrator quiet", quiet=1.0),
    Row("sea 3.0:11", sea="3.0:11"),
    Row("coupled sea", coupled=True),
)


def conditions_of(rows: list[Row], keys: jax.Array) -> Conditions:
    """One per row; leaves (rows,)."""
    column = lambda name: jnp.asarray([getattr(r, name) for r in rows], jnp.float32)  # noqa: E731
    return Conditions(
        plant=Plant(column("payload_kg"), column("wrist_inertia"), column("quiet")),
        noise=Noise(1e-3 * column("noise_mm"), 1e-3 * column("noise_mrad"), keys),
        latency=column("latency_steps").astype(jnp.int32),
        delay=jnp.asarray([DELAYS.index(r.delay) for r in rows], jnp.int32),
        path_start=None,
    )


def task(sea: str, coupled: bool, split: str, conditions: ConditionsConfig = ANY):
    config = EnvConfig(delay=",".join(DELAYS), integrator="mixed", conditions=conditions)
    return make_env(config, MotionConfig(sea=sea, coupled=coupled), split=split)


def measure(env, controller, gain: float, rows: list[Row]) -> list[dict]:
    """Mean errors of a controller under each condition, all of one environment."""
    seas = len(env.motion.seas)
    episodes = seas * EPISODES
    keys = jnp.tile(jax.random.split(jax.random.key(SEED), EPISODES), len(rows) * seas)
    sea = jnp.tile(jnp.repeat(jnp.arange(seas), EPISODES), len(rows))
    every = [row for row in rows for _ in range(episodes)]
    given = conditions_of(every, jax.random.split(jax.random.key(SEED + 1), len(every)))
    gains = jnp.full(len(every), gain)
    dp, da, valid, *_ = run_everywhere(env, controller, keys, sea, gains, given)
    shape = (-1, len(rows), episodes)
    dp, da = dp[WARM_UP_STEPS:].reshape(shape), da[WARM_UP_STEPS:].reshape(shape)
    return [
        {
            "condition": row.name,
            "pos_mm": f"{1e3 * np.mean(dp[:, i]):.3f}",
            "ang_mrad": f"{1e3 * np.mean(da[:, i]):.3f}",
            "invalid": int((~valid.reshape(shape[1:])[i]).sum()),
            "episodes": episodes,
        }
        for i, row in enumerate(rows)
    ]


def controller_of(who: str):
    """A controller by its name; what is fitted is fitted now."""
    if who not in FITTED:
        return CLASSICAL[who] if who in CLASSICAL else load_controller(who)[1]
    train = task("all", False, "train")
    if who == "extrapolate-best":
        nominal = replace(
            train.config, delay="B4_4", conditions=ConditionsConfig(), integrator="euler"
        )
        train = replace(train, config=nominal, integrator="euler")
    return fitted(who, train)


def order(who: str) -> int:
    """Column of a controller: classical ones, then agents."""
    known = ("ik", "extrapolate", *FITTED, "preview", "ppo", "first-order", "robust")
    return known.index(who) if who in known else len(known)


def main() -> None:
    commit()
    startup.configure()
    controllers = {}
    for who in sys.argv[1:]:
        name = Path(who.removeprefix(SHIPPED)).name.removesuffix(".npz")
        controllers[name] = controller_of(who), float(who != "ik")
    found = []
    for who, (controller, gain) in controllers.items():
        begun = time.monotonic()
        for sea, coupled in (("all", False), ("3.0:11", False), ("all", True)):
            rows = [r for r in ROWS if (r.sea or "all", r.coupled) == (sea, coupled)]
            measured = measure(task(sea, coupled, "test"), controller, gain, rows)
            found += [{"who": who, **row} for row in measured]
        print(f"{who}: {time.monotonic() - begun:.0f} s", flush=True)
    places = {row.name: i for i, row in enumerate(ROWS)}
    rows = [{**row, **provenance()} for row in found]
    rows += [r for r in kept("robust", "who", list(controllers)) if r["condition"] in places]
    rows.sort(key=lambda row: (order(row["who"]), places[row["condition"]]))
    write_rows("robust", rows)


if __name__ == "__main__":
    main()
