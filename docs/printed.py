"""What the commands on the site print: runs them and keeps their output in docs/printed/.

    python docs/printed.py              # the quick ones, which tests/test_docs.py compares
    python docs/printed.py NAME ...     # these
    python docs/printed.py all          # every one: half an hour on two cores

Every command runs in an empty directory that has `docs` and `runs` of this source tree. Output of
what computes ends with the commit, the day and the machine.
"""

import datetime
import os
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "docs" / "printed"
COLUMNS = "100"

QUICK = {
    **{
        f"help-{name}": f"{name} --help"
        for name in ("train", "evaluate", "play", "report", "export", "bench", "sea")
    },
    "error-delay": "evaluate ik --delay butter:4:30Hz",
    "error-site": "evaluate ik --arm docs/seven.xml",
    "error-mjx": "evaluate ik --physics mjx --payload-kg 2",
}
"""Name -> command after `python -m mcx_jax.`; nothing is simulated, so a test repeats them all."""

EXTRAPOLATE = "evaluate extrapolate --delay B4_4 --sea Wd"
POLICY = "evaluate runs/B4_4-first-order-s0 --delay"
SLOW = {
    "sea": "sea",
    "ik": "evaluate ik --delay B4_4 --sea all",
    "extrapolate": EXTRAPOLATE,
    "seven": "evaluate ik --arm docs/seven.xml --tool-site gripper --delay E0 --sea all",
    "known-none": f"{EXTRAPOLATE} --known-delay E0",
    "known-long": f"{EXTRAPOLATE} --known-delay E2",
    "noise": f"{EXTRAPOLATE} --noise-mm 1 --noise-mrad 1",
    "latency": f"{EXTRAPOLATE} --latency-steps 2",
    "payload": f"{EXTRAPOLATE} --payload-kg 5",
    "wrist": f"{EXTRAPOLATE} --wrist-inertia 0.02",
    "delays": "evaluate extrapolate --delay B4_4,E1,E2 --sea Wd",
    "mixed": f"{EXTRAPOLATE} --integrator mixed",
    "goal": f"{EXTRAPOLATE} --goal circle",
    "bound": f"{EXTRAPOLATE} --max-correction 1",
    "smoke": "train --smoke --run-dir smoke",
    "policy": f"{POLICY} B4_4 --sea Wd",
    "policy-e1": f"{POLICY} E1 --sea Wd",
    "policy-e2": f"{POLICY} E2 --sea Wd",
    "export": "export runs/B4_4-first-order-s0 --out policy.npz",
}
"""These compute; `runs` must hold what they name (docs/commands.md says how it was trained)."""


def command_line(command: str) -> str:
    """The command as a user types it."""
    return f"python -m mcx_jax.{command}"


def printed(command: str) -> str:
    """What a command prints, errors included."""
    module, *words = shlex.split(command)
    variables = {"COLUMNS": COLUMNS, "PYTHONPATH": str(ROOT), "TERM": "dumb", "NO_COLOR": "1"}
    with tempfile.TemporaryDirectory() as folder:
        for name in ("docs", "runs"):
            Path(folder, name).symlink_to(ROOT / name)
        done = subprocess.run(
            [sys.executable, "-m", f"mcx_jax.{module}", *words],
            cwd=folder,
            env={**os.environ, **variables},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
    if done.returncode not in (0, 2) or "Traceback" in done.stdout:
        raise SystemExit(f"{command}: exit code {done.returncode}\n{done.stdout}")
    return tidied(done.stdout)


def tidied(text: str) -> str:
    """Without spaces at line ends and the line that depends on the number of cores."""
    lines = [line.rstrip() for line in text.strip().splitlines()]
    return "\n".join(line for line in lines if not line.startswith("XLA_FLAGS += "))


def provenance(seconds: float) -> str:
    """When and where something was computed."""
    git = ["git", "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(git, capture_output=True, text=True, cwd=ROOT).stdout.strip()
    day = datetime.date.today().isoformat()
    return f"# {seconds:.0f} s; commit {commit}, {day}, cpu, {os.cpu_count()} cores, busy"


def main(names: list[str]) -> None:
    """Run the commands named and write their files."""
    every = QUICK | SLOW
    for name in list(every if names == ["all"] else names or QUICK):
        begun = time.monotonic()
        lines = [f"$ {command_line(every[name])}", printed(every[name])]
        if name in SLOW:
            lines.append(provenance(time.monotonic() - begun))
        (FOLDER / f"{name}.txt").write_text("\n".join(lines) + "\n")
        print(f"docs/printed/{name}.txt, {time.monotonic() - begun:.0f} s", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
