"""What every stored result carries: the command, the commit, the machine and the versions."""

import csv
import functools
import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

from tables import read

FOLDER = Path(__file__).parent


@functools.cache
def commit() -> str:
    """The commit that runs; refuses a tree with uncommitted changes.

    A script calls it first: before hours of work, and before anything else is committed.
    """
    command = ["git", "describe", "--always", "--dirty=+"]
    name = subprocess.run(command, capture_output=True, text=True, cwd=FOLDER).stdout.strip()
    if name.endswith("+"):
        raise SystemExit("commit your changes first: a stored result names the commit it is of")
    return name


def provenance() -> dict[str, str]:
    """Columns that end every row of a stored result."""
    import jax
    import mujoco

    command = " ".join(["python", "experiments/" + Path(sys.argv[0]).name, *sys.argv[1:]])
    device = f"{jax.devices()[0].platform}, {os.cpu_count()} cores"
    versions = {"jax": jax.__version__, "mujoco": mujoco.__version__}
    return {"command": command, "commit": commit(), "device": device, **versions}


def write_rows(name: str, rows: list[dict]) -> None:
    """Write experiments/NAME.csv and say so."""
    path = FOLDER / f"{name}.csv"
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    print(f"wrote {path.relative_to(FOLDER.parent)}")


def kept(name: str, column: str, anew: list[str]) -> list[dict]:
    """Rows that experiments/NAME.csv has already, but for those with a `column` made anew."""
    stored = read(name) if (FOLDER / f"{name}.csv").is_file() else []
    return [row for row in stored if row[column] not in anew]


def evaluation_rows(rows: list[dict], seconds: float) -> list[dict]:
    """Result rows of `mcx_jax.evaluate` as CSV rows, beside the paper's figures; gains over the IK
    baseline of the worst 5 %, 1 % and the maximum in per cent."""
    from mcx_jax.evaluation.statistics import paper_errors

    out = []
    for r in rows:
        kind = "ik" if r["who"] == "ik" else "agent"
        pos, ang = paper_errors(kind, r["delay"], r["sea"]) or (float("nan"), float("nan"))
        out.append(
            {
                "who": r["who"],
                "delay": r["delay"],
                "sea": r["sea"],
                "pos_mm": f"{r['pos_mm']['mean']:.3f}",
                "pos_mm_paper": f"{pos:.2f}",
                "ang_mrad": f"{r['ang_mrad']['mean']:.3f}",
                "ang_mrad_paper": f"{ang:.2f}",
                "pos_mm_max": f"{r['pos_mm']['max']:.2f}",
                "ang_mrad_max": f"{r['ang_mrad']['max']:.2f}",
                **{
                    f"gain_{unit}_{group}": f"{100 * gain[group]:.1f}"
                    for unit, gain in r["improvement"].items()
                    for group in ("top5", "top1", "max")
                },
                "invalid": r["invalid_episodes"],
                "episodes": r["episodes"],
                "seconds": f"{seconds:.0f}",
            }
        )
    return out


def run_rows(run: Path) -> list[dict]:
    """`ik` and every seed of a trained run on the four seas as CSV rows, with the run's training
    steps (of one seed) and seconds (of all)."""
    from mcx_jax.controllers.by_name import load_controller
    from mcx_jax.evaluate import evaluate_beside_ik
    from mcx_jax.runs.run_dir import METRICS, POLICY, stored_config

    config = stored_config(run)
    last = json.loads((run / METRICS).read_text().splitlines()[-1])
    env = replace(config.env, episode_steps=1000)
    out: list[dict] = []
    for k in range(config.seeds):
        seed = config.seed + k
        file = POLICY if config.seeds == 1 else f"policy_s{seed}.npz"
        _, controller = load_controller(str(run / file))
        begun = time.monotonic()
        baseline, rows = evaluate_beside_ik(config.algo, controller, env, config.motion)
        found = evaluation_rows(rows if k else baseline + rows, time.monotonic() - begun)
        trained = {"steps": last["steps"], "train_seconds": f"{last['wall_s']:.0f}"}
        out += [{**row, "seed": seed, **trained, **provenance()} for row in found]
    return out
