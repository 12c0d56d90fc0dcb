"""The controllers without learning on the paper's five delays and four seas.

    python experiments/baseline.py [--quiet] ik extrapolate extrapolate-best fir preview

Writes experiments/baseline_WHO.csv, with --quiet (the integrator quiet) baseline_WHO_quiet.csv; for
`ik` in the paper's world prints how close it is to the baseline that the
paper's table 3 implies (rms of the 40 log ratios, worst cell).
"""

import math
import sys
import time

from record import evaluation_rows, kept, provenance, write_rows

from mcx_jax.compute import startup
from mcx_jax.config.delay import NAMED_DELAYS
from mcx_jax.config.task import EnvConfig, MotionConfig


def main() -> None:
    startup.configure()
    from mcx_jax.controllers.by_name import WHO, fit_if_needed, load_controller
    from mcx_jax.evaluate import evaluate

    quiet = "--quiet" in sys.argv
    names = [word for word in sys.argv[1:] if word != "--quiet"] or ["ik"]
    if unknown := set(names) - set(WHO):
        raise SystemExit(f"unknown controller {unknown}: use {', '.join(WHO)}")
    origin = provenance()  # of what runs, whatever is committed meanwhile
    for who in names:
        file = f"baseline_{who}" + "_quiet" * quiet
        rows: list[dict] = []
        for delay in NAMED_DELAYS:
            begun = time.monotonic()
            env = EnvConfig(delay=delay, integrator="quiet" if quiet else "model")
            motion = MotionConfig()
            controller = fit_if_needed(who, load_controller(who)[1], env, motion, "")
            found = evaluate(who, controller, env, motion)
            seconds = time.monotonic() - begun
            rows += [{**row, **origin} for row in evaluation_rows(found, seconds)]
            write_rows(file, rows + kept(file, "delay", [row["delay"] for row in rows]))
            print(f"{who} {delay}: {seconds:.0f} s", flush=True)
        if who == "ik" and not quiet:
            ratios = [
                math.log(float(r[name]) / float(r[f"{name}_paper"]))
                for r in rows
                for name in ("pos_mm", "ang_mrad")
            ]
            rms = math.sqrt(sum(x * x for x in ratios) / len(ratios))
            worst = max(ratios, key=abs)
            print(f"rms log ratio {rms:.3f}, worst cell {100 * (math.exp(worst) - 1):+.1f} %")


if __name__ == "__main__":
    main()
