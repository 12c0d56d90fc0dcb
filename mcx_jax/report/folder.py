"""The report's directory. A report replaces an earlier one there, and nothing else: results.json
says what that wrote, file by file with its SHA-256, and only such a file is overwritten or removed.
"""

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mcx_jax.config import command_line
from mcx_jax.errors import UserError, reason

PAGE, RESULTS = "index.html", "results.json"
KIND = "mcx_jax report"


def check_out(out: str) -> Path:
    """The directory to write to.

    Raises:
        UserError: none named, a file, not writable, or a directory that holds something (hidden
            files apart, which stay) that no report wrote or that has changed since.
    """
    if not out:
        raise UserError("--out is missing: name a directory for the report")
    path = Path(out)
    command_line.check_name("--out", path)
    if path.exists() and not path.is_dir():
        raise UserError(f"--out {out}: is a file; name a directory")
    # Before minutes of evaluation, not after.
    parent = next(p for p in (path, *path.absolute().parents) if p.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise UserError(f"--out {out}: cannot write in {parent}")
    if path.is_dir():
        _refuse_others(path, [p.name for p in path.iterdir() if not p.name.startswith(".")])
    return path


def write(out: Path, html: str, pngs: Mapping[str, bytes], results: Mapping[str, Any]) -> None:
    """Write page, figures and results in the place of an earlier report.

    Raises:
        UserError: the directory cannot be written to, or holds a file of such a name that no report
            wrote; then everything is as it was.
    """
    files = {f"{name}.png": data for name, data in pngs.items()}
    files[PAGE] = html.encode()
    try:
        out.mkdir(parents=True, exist_ok=True)
        _refuse_others(out, [*files, RESULTS])
        before = _ours(out)
        # First, so that a report cut short is known as one.
        (out / RESULTS).write_bytes(_with_manifest(results, files))
        for name in before - {RESULTS, *files}:
            (out / name).unlink()
        for name, data in files.items():
            (out / name).write_bytes(data)
    except OSError as error:
        raise UserError(f"--out {out}: cannot be written ({reason(error)})") from None


def _refuse_others(path: Path, names: list[str]) -> None:
    ours = _ours(path)
    others = sorted(name for name in names if os.path.lexists(path / name) and name not in ours)
    if others:
        more = f" and {len(others) - 1} more" if len(others) > 1 else ""
        raise UserError(
            f"--out {path}: holds {others[0]}{more}, which no report wrote, or which has changed "
            "since; name a new or an empty directory"
        )


def _ours(path: Path) -> set[str]:
    """Names of the files in a directory that a report wrote, and that are as it wrote them."""
    try:
        results = json.loads((path / RESULTS).read_bytes())
        written = results.pop("files")
        if results["kind"] != KIND or written[RESULTS] != _digest(_json(results)):
            return set()
        inside = {n: digest for n, digest in written.items() if n == Path(n).name}
        return {RESULTS} | {n for n, digest in inside.items() if _unchanged(path / n, digest)}
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return set()


def _unchanged(file: Path, digest: str) -> bool:
    regular = file.is_file() and not file.is_symlink()
    return regular and _digest(file.read_bytes()) == digest


def _with_manifest(results: Mapping[str, Any], files: Mapping[str, bytes]) -> bytes:
    whole = {"kind": KIND, **results}
    written = {RESULTS: _digest(_json(whole))} | {n: _digest(data) for n, data in files.items()}
    return _json(whole | {"files": written})


def _json(value: Any) -> bytes:
    """Standard JSON, which has no NaN."""
    return (json.dumps(value, indent=1, allow_nan=False) + "\n").encode()


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
