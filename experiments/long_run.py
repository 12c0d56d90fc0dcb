"""Memory and compilations of a long training run.

    python experiments/long_run.py [options of python -m mcx_jax.train]

Starts the command, reads its resident memory twice a minute and counts what JAX traces and compiles
after the first metrics. Writes experiments/long_run.csv.
"""

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

from record import provenance, write_rows
from tables import growth

PERIOD_S = 30.0
WORK = ("Finished tracing", "Compiling ")


def resident_mib(pid: int) -> float:
    """Resident memory of a process, MiB; 0 when it has ended."""
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0.0
    sizes = [line.split()[1] for line in lines if line.startswith("VmRSS")]
    return float(sizes[0]) / 1024 if sizes else 0.0


def main() -> None:
    command = [sys.executable, "-m", "mcx_jax.train", *sys.argv[1:]]
    environment = {**os.environ, "JAX_LOG_COMPILES": "1"}
    process = subprocess.Popen(
        command, env=environment, stderr=subprocess.PIPE, text=True, stdout=subprocess.PIPE
    )
    begun, seen = time.monotonic(), {"training": False, "compilations": 0}

    def read_log() -> None:
        for line in process.stderr:
            if any(word in line for word in WORK):
                seen["compilations"] += seen["training"]
            elif line.startswith("error: "):
                print(line, end="", file=sys.stderr)

    def read_said() -> None:
        for line in process.stdout:
            # Metrics begin with i/n. What comes after the last one, the table, is compiled anew.
            done, _, of = line.split("|")[0].strip().partition("/")
            seen["training"] = done.isdigit() and done != of
            print(line, end="", flush=True)

    for read in (read_log, read_said):
        threading.Thread(target=read, daemon=True).start()
    rows, origin = [], provenance()
    while process.poll() is None:
        time.sleep(PERIOD_S)
        if seen["training"]:
            rows.append(
                {
                    "minute": f"{(time.monotonic() - begun) / 60:.1f}",
                    "resident_mib": f"{resident_mib(process.pid):.1f}",
                    "compilations": seen["compilations"],
                    **origin,
                }
            )
    if not rows:
        raise SystemExit(process.returncode or "shorter than one sample")
    write_rows("long_run", rows)
    print(growth(rows))


if __name__ == "__main__":
    main()
