"""Make docs/licences.md: what mcx_jax needs to run, and under which licences.

    python tools/licences.py

From the metadata of the installed packages, which must be those of constraints.txt; the markers of
their requirements are read for Python 3.11 on Linux, with which the constraints were made.
"""

import re
import tomllib
from importlib.metadata import distribution
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "licences.md"
EXTRAS = ("gym", "export", "viz")
"""Beside `runtime`: the extras that users install."""
MARKERS = {"python_version": "3.11", "python_full_version": "3.11.7", "sys_platform": "linux"} | {
    "platform_system": "Linux",
    "platform_machine": "x86_64",
    "os_name": "posix",
    "implementation_name": "cpython",
    "platform_python_implementation": "CPython",
}
SPDX = {
    "Apache 2.0": "Apache-2.0",
    "Apache Software License": "Apache-2.0",
    "BSD 3-Clause": "BSD-3-Clause",
    "3-Clause BSD License": "BSD-3-Clause",
    "MIT License": "MIT",
    "Python Software Foundation License": "PSF-2.0",
}
"""Names in use, as SPDX writes them."""

HEAD = """# Licences

What mcx_jax (Apache-2.0) needs to run, with the versions of `constraints.txt`; made by
`python tools/licences.py` from the packages' own metadata, checked by `tests/test_packaging.py`.
None is under the GPL or AGPL.

`imageio-ffmpeg` brings an FFmpeg program, which is under the GPL and runs as a process of its own.
Not in the table: `sb3`, `cuda` and `hydro`. Capytaine 3 (extra `hydro`, Apache-2.0) only remakes a
data file (`tools/hydro`); nothing in `mcx_jax` imports it. Wheels may hold libraries with licences
of their own, such as the Fortran run-time library in SciPy's: see the packages.

| package | version | licence | needed by |
| --- | --- | --- | --- |
"""


def normalised(name: str) -> str:
    """A distribution's name as an index compares it (PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()


def pins() -> dict[str, str]:
    """constraints.txt as {normalised name: version}."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pairs = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {normalised(name): version for name, version in pairs}


def needed(requirements: list[str], pinned: dict[str, str]) -> set[str]:
    """Names of all pinned packages that some requirements lead to."""
    found: set[tuple[str, str]] = set()
    todo = [(text, "") for text in requirements]
    while todo:
        text, extra = todo.pop()
        requirement = Requirement(text)
        if requirement.marker and not requirement.marker.evaluate(MARKERS | {"extra": extra}):
            continue
        name = normalised(requirement.name)
        for wanted in {"", *requirement.extras}:
            if name in pinned and (name, wanted) not in found:
                found.add((name, wanted))
                todo += [(line, wanted) for line in distribution(name).requires or []]
    return {name for name, _ in found}


def licence(name: str) -> str:
    """SPDX expression of an installed package, or the nearest that its metadata says; "": none."""
    metadata = distribution(name).metadata
    classifiers = [
        c.split(" :: ")[-1]
        for c in metadata.get_all("Classifier", [])
        if c.startswith("License :: OSI")
    ]
    said = (metadata.get("License-Expression") or metadata.get("License") or "").strip()
    if not said or len(said) > 80 or "\n" in said:  # some put the whole text there
        said = " OR ".join(SPDX.get(c, c) for c in classifiers) or said.partition("\n")[0]
    return SPDX.get(said, said)


def table() -> list[tuple[str, str, str, str]]:
    """(package, version, licence, needed by) of every package that running can need."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    pinned = pins()
    runtime = needed(project["dependencies"], pinned)
    users = {extra: needed(project["optional-dependencies"][extra], pinned) for extra in EXTRAS}
    rows = []
    for name in sorted(runtime.union(*users.values())):
        by = [extra for extra, names in users.items() if name in names]
        rows.append((name, pinned[name], licence(name), "runtime" if name in runtime else
                     ", ".join(by)))  # fmt: skip
    return rows


def page() -> str:
    """The content of docs/licences.md."""
    return HEAD + "".join(f"| {' | '.join(row)} |\n" for row in table())


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(f"done: {PAGE}")
