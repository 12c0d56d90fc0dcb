"""Run the whole bench on a quiet machine and store its figures and its plot.

    python experiments/speed.py [BENCH.json]

Writes experiments/speed.csv and docs/speed.png; with a file, from figures that `python -m
mcx_jax.bench --json BENCH.json` has just stored.
"""

import json
import sys
from pathlib import Path

from record import FOLDER, commit, provenance, write_rows

from mcx_jax.compute import startup


def main() -> None:
    commit()
    startup.configure()
    from mcx_jax.bench.__main__ import run
    from mcx_jax.bench.plot import draw

    figures = json.loads(Path(sys.argv[1]).read_text()) if sys.argv[1:] else run(False, print)
    draw(figures, FOLDER.parent / "docs" / "speed.png")
    rows = [(f"physics {r['engine']}", r["envs"], r["steps_per_s"]) for r in figures["physics"]]
    rows += [("environment", r["envs"], r["steps_per_s"]) for r in figures["environment"]]
    rows += [(f"part {name} us", "", us) for name, us in figures["breakdown_us"].items()]
    rows += [(name, "", value) for name, value in figures["ratio"].items()]
    for name, (least, most) in figures.get("ratio_range", {}).items():  # not in older files
        rows += [(f"{name} least", "", least), (f"{name} most", "", most)]
    rows += [(f"compile {name} s", "", value) for name, value in figures["compile_s"].items()]
    single = (
        "gradient_over_forward",
        "peak_memory_gib",
        "rollout_steps_per_s",
        "training_steps_per_s",
        "learner_matmul_share",
        "matmul_gflops",
    )
    rows += [(name, "", figures[name]) for name in single]
    end = {**provenance(), "device": figures["device"]}
    write_rows("speed", [{"what": w, "envs": n, "value": f"{v:.4g}", **end} for w, n, v in rows])


if __name__ == "__main__":
    main()
