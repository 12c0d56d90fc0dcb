"""Output of the commands shown on the pages: runs them, stores what they print, fills the pages.

    python tools/printed.py              # the quick ones, which tests/test_docs.py compares
    python tools/printed.py NAME ...     # these
    python tools/printed.py all          # every one: half an hour on two cores
    python tools/printed.py pages        # only copies the stored output into the pages

Every command runs in an empty directory that has `docs` and `runs` of this source tree. Its output
is stored in docs/printed/NAME.txt, and stands on a page between `<!-- printed: NAME ... -->` and
`<!-- end -->`, so that a page is complete wherever it is read; `NAME:14` is its first 14 lines.
Output of a computation ends with the commit, the day and the machine, and needs a clean tree.
"""

import datetime
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FOLDER = ROOT / "docs" / "printed"
COLUMNS = "80"

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
    "shipped": "evaluate shipped:B4_4 --delay B4_4",
    "quick-train": "train --algo first-order --total-steps 700000 --run-dir runs/quick",
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
        Path(folder, "docs").symlink_to(ROOT / "docs")
        Path(folder, "runs").mkdir()  # a command may add a run
        for run in (ROOT / "runs").glob("*"):
            Path(folder, "runs", run.name).symlink_to(run)
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
    return tidied(done.stdout.replace(f"{os.path.realpath(folder)}/", ""))


def tidied(text: str) -> str:
    """Without spaces at line ends."""
    return "\n".join(line.rstrip() for line in text.strip().splitlines())


def provenance() -> str:
    """When and where something was computed; no seconds, since other programs run here too."""
    day = datetime.date.today().isoformat()
    return f"# commit {commit()}, {day}, cpu, {os.cpu_count()} cores"


def commit() -> str:
    """The commit that the program is of; refuses a tree in which tracked files differ from it."""
    git = ["git", "describe", "--always", "--exclude=*", "--dirty=+"]
    name = subprocess.run(git, capture_output=True, text=True, cwd=ROOT).stdout.strip()
    if name.endswith("+"):
        raise SystemExit("commit your changes first: stored output names the commit it comes from")
    return name


def stored(name: str) -> str:
    """Stored output, `NAME`, or its first lines, `NAME:COUNT`."""
    name, _, count = name.partition(":")
    lines = (FOLDER / f"{name}.txt").read_text().rstrip("\n").split("\n")
    return "\n".join([*lines[: int(count)], "..."] if count else lines)


def filled(page: str) -> str:
    """A page with its boxes filled from `printed: NAME ...` (stored output) or `file: PATH`."""

    def box(match: re.Match[str]) -> str:
        kind, names = match[1], match[2].split()
        show = stored if kind == "printed" else lambda name: (ROOT / name).read_text().rstrip("\n")
        text = "\n".join(show(name) for name in names)
        language = "text" if kind == "printed" else "bash"
        return f"<!-- {kind}: {match[2]} -->\n```{language}\n{text}\n```\n<!-- end -->"

    return re.sub(r"<!-- (printed|file): (.*?) -->\n.*?<!-- end -->", box, page, flags=re.DOTALL)


def main(names: list[str]) -> None:
    """Run the commands named, store their output and fill the pages."""
    every = QUICK | SLOW
    chosen = [] if names == ["pages"] else list(every if names == ["all"] else names or QUICK)
    origin = provenance() if set(chosen) & set(SLOW) else ""
    for name in chosen:
        started = time.monotonic()
        lines = [f"$ {command_line(every[name])}", printed(every[name])]
        lines += [origin] if name in SLOW else []
        (FOLDER / f"{name}.txt").write_text("\n".join(lines) + "\n")
        print(f"docs/printed/{name}.txt, {time.monotonic() - started:.0f} s", flush=True)
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        path.write_text(filled(path.read_text()))


if __name__ == "__main__":
    main(sys.argv[1:])
