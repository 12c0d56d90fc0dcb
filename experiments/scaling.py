"""Weak scaling of training: as many environments for every device, more and more devices.

    python experiments/scaling.py

Devices are CPU cores; where there are more devices than cores the figure shows what dividing the
work costs, no more. Every row is a run of `python -m mcx_jax.train` from its second to its last
iteration, on a machine where nothing else runs. Writes experiments/scaling.csv.
"""

import json
import os
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

from record import commit, provenance, write_rows

from mcx_jax.compute.startup import DEVICES_FLAG, PASSES_FLAG, SPLIT_PASS

ENVS_PER_DEVICE = 1024
WINDOW_STEPS = 32
ITERATIONS = 6
ROWS = ((1, 1, True), (1, 2, True), (2, 1, True), (2, 1, False), (1, 4, True), (1, 8, True))
"""(processes, devices of each, whether every process is bound to as many cores)."""


def steps_per_s(processes: int, devices: int, bound: bool) -> float:
    """Control steps a second of a run."""
    cores = sorted(os.sched_getaffinity(0))
    envs = ENVS_PER_DEVICE * processes * devices
    flags = f"{DEVICES_FLAG}={devices} {PASSES_FLAG}={SPLIT_PASS}"
    with tempfile.TemporaryDirectory() as folder, socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        place = f"127.0.0.1:{free.getsockname()[1]}"
        free.close()
        command = [sys.executable, "-m", "mcx_jax.train", "--num-envs", str(envs)]
        command += ["--total-steps", str(ITERATIONS * WINDOW_STEPS * envs), "--run-dir", folder]
        children = []
        for i in range(processes):
            mine = (cores[i * devices : (i + 1) * devices] if bound else None) or cores
            several = ["--distributed", f"{place},{i}/{processes}"] if processes > 1 else []
            children.append(
                subprocess.Popen(
                    ["taskset", "-c", ",".join(map(str, mine)), *command, *several],
                    env={**os.environ, "XLA_FLAGS": flags},
                    stdout=subprocess.PIPE,
                    text=True,
                )
            )
        metrics = Path(folder) / "metrics.jsonl"
        for line in children[0].stdout:  # the first to write, and to say what it writes
            if line.startswith(f"{ITERATIONS}/"):
                break
        rows = [json.loads(line) for line in metrics.read_text().splitlines()]
        for child in children:
            child.kill()
            child.wait()
    first, last = rows[0], rows[-1]
    return (last["steps"] - first["steps"]) / (last["wall_s"] - first["wall_s"])


def main() -> None:
    commit()
    rows, alone = [], None
    for processes, devices, bound in ROWS:
        rate = steps_per_s(processes, devices, bound)
        alone = alone or rate
        ideal = alone * min(processes * devices, os.cpu_count() or 1)
        where = "" if bound else ", not bound to cores"
        print(f"{processes} x {devices}{where}: {rate:,.0f} steps/s, {100 * rate / ideal:.0f} %")
        rows.append(
            {
                "processes": processes,
                "devices_each": devices,
                "bound": bound,
                "num_envs": ENVS_PER_DEVICE * processes * devices,
                "steps_per_s": f"{rate:.0f}",
                "share_of_linear_percent": f"{100 * rate / ideal:.0f}",
                **provenance(),
            }
        )
    write_rows("scaling", rows)


if __name__ == "__main__":
    main()
