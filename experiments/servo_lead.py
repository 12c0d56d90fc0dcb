"""How much of the lead that a joint loses beyond its velocity servo's range is to be given back.

    python experiments/servo_lead.py RUN...

RUN are trained runs (the IK baseline runs beside each). 400 episodes of TRAINING motion in Wd, so
that the choice of `envs.servo.LEAD_MADE_UP` has not seen a test episode. Counts steps in which a
joint is asked for more than its servo's range and the ten after them; their mean and largest error.
Writes experiments/servo_lead.csv.
"""

import sys
import time
from pathlib import Path
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from record import provenance, write_rows

from mcx_jax.arm import servo
from mcx_jax.compute import startup
from mcx_jax.config.delay import CONTROL_DT_S
from mcx_jax.config.task import MotionConfig
from mcx_jax.controllers.by_name import load_controller
from mcx_jax.envs.v2v import make_env
from mcx_jax.evaluation.statistics import WARM_UP_STEPS
from mcx_jax.runs.run_dir import stored_config

SHARES = (0.0, 0.5, 0.7, 0.85, 1.0)
EPISODES, AFTER_STEPS = 400, 10


def episodes(env, controller, keys, gain, share):
    """(dp m, da rad, a joint is too fast), each (steps, N)."""
    act = jax.vmap(lambda state, memory: controller.act(env, state, memory), -1, -1)
    step = jax.vmap(env.step, -1, -1)
    state = jax.vmap(env.reset, 0, -1)(keys)
    memory = jax.vmap(lambda state: controller.init(env, state), -1, -1)(state)

    def body(carry, _):
        state, memory = carry
        memory, action = act(state, memory)
        after = step(state, env.bounded(gain * action))
        rate = (after.reference - state.reference) / CONTROL_DT_S
        lost = jax.vmap(lambda rate: servo.lost_lead(env.model, rate), -1, -1)(rate)
        fast = jnp.any(lost != 0.0, axis=0)
        return (after, memory), (after.metrics.pos_error_m, after.metrics.ang_error_rad, fast)

    with mock.patch.object(servo, "LEAD_MADE_UP", share):  # an input: one program for all shares
        return jax.lax.scan(body, (state, memory), None, env.episode_steps)[1]


def soon_after(fast: np.ndarray) -> np.ndarray:
    """fast (steps, N), and the AFTER_STEPS steps after each."""
    near = fast.copy()
    for k in range(1, AFTER_STEPS + 1):
        near[k:] |= fast[:-k]
    return near


def rows(run: Path) -> list[dict]:
    config = stored_config(run)
    env = make_env(config.env, MotionConfig(sea="Wd"), split="train")
    _, controller = load_controller(str(run))
    keys = jax.random.split(jax.random.key(1), EPISODES)
    compiled = jax.jit(episodes)
    found = []
    for who, gain in (("ik", 0.0), (run.name, 1.0)):
        for share in SHARES:
            begun = time.monotonic()
            dp, da, fast = (np.asarray(x) for x in compiled(env, controller, keys, gain, share))
            counted = slice(WARM_UP_STEPS, None)
            near = soon_after(fast)[counted]
            mm, mrad = 1e3 * dp[counted][near], 1e3 * da[counted][near]
            found.append(
                {
                    "who": who,
                    "delay": config.env.delay,
                    "integrator": config.env.integrator,
                    "share": share,
                    "steps_too_fast": int(fast[counted].sum()),
                    "steps": fast[counted].size,
                    "episodes": int(fast[counted].any(axis=0).sum()),
                    "pos_mm": f"{mm.mean():.2f}",
                    "ang_mrad": f"{mrad.mean():.2f}",
                    "pos_mm_max": f"{mm.max():.1f}",
                    "ang_mrad_max": f"{mrad.max():.1f}",
                    "seconds": f"{time.monotonic() - begun:.0f}",
                }
            )
            print(found[-1], flush=True)
    return found


def main() -> None:
    runs = [Path(word) for word in sys.argv[1:]]
    startup.configure()
    origin = provenance()
    write_rows("servo_lead", [row | origin for run in runs for row in rows(run)])


if __name__ == "__main__":
    main()
