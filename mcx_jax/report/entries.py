"""What a report compares: controllers by name, run directories and policy files."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mcx_jax.config import command_line
from mcx_jax.controllers.by_name import load_controller, policy_path
from mcx_jax.errors import UserError, printable
from mcx_jax.runs.run_dir import METRICS, whole_rows

OWN_SETTINGS = ("delay", "arm", "tool_site", "integrator")
"""What a policy was trained for and is reported in, unless the command line says otherwise. Not
`physics`: both engines are the same task."""


COLUMNS = ("seed", "steps", "wall_s", "pos_error_mm", "ang_error_mrad")
"""Of metrics.jsonl, what learning curves are made of."""


@dataclass(frozen=True)
class Entry:
    """One controller of the report."""

    who: str
    """As on the command line, and in the evaluation's rows."""
    label: str
    """Short and unique, for figures."""
    controller: Any
    settings: dict[str, str]
    """OWN_SETTINGS of a trained policy; {} for a controller without learning."""
    learned: bool
    run: Path | None
    """Run directory, if there is one."""


@dataclass(frozen=True)
class Curves:
    """A training run's metrics, axis 0 = seed."""

    steps: np.ndarray
    """(n,) control steps so far, one seed's."""
    wall_s: np.ndarray
    """(n,) seconds of training, all seeds together."""
    pos_mm: np.ndarray
    """(seeds, n) mean dp of the iteration's experience."""
    ang_mrad: np.ndarray
    """(seeds, n) mean da."""


def check_names(runs: Sequence[str]) -> tuple[str, ...]:
    """The names to report, `ik` first and none twice; a wrong one is refused before JAX starts."""
    if not runs:
        raise UserError(
            "name at least one RUN: ik, extrapolate, fir, shipped:DELAY, a run directory or .npz"
        )
    for who in runs:
        policy_path(who)
    return tuple(dict.fromkeys(["ik", *(who.rstrip("/") for who in runs)]))


def load_entries(runs: Sequence[str]) -> list[Entry]:
    """Controllers for the names of `check_names`; labels can be printed."""
    entries = [_load(who) for who in runs]
    for shorten in (_without_delay, _name):
        labels = [printable(shorten(entry)) for entry in entries]
        if len(set(labels)) == len(labels):
            return [replace(e, label=label) for e, label in zip(entries, labels, strict=True)]
    return [replace(e, label=printable(e.who)) for e in entries]


def _load(who: str) -> Entry:
    controller = load_controller(who)[1]
    path = policy_path(who)
    if path is None:
        return Entry(who, who, controller, {}, learned=False, run=None)
    stored = json.loads(controller.policy.meta.config).get("env")
    stored = stored if isinstance(stored, dict) else {}
    settings = {k: v for k, v in stored.items() if k in OWN_SETTINGS and isinstance(v, str)}
    run = path.parent if (path.parent / METRICS).is_file() else None
    return Entry(who, who, controller, settings, learned=True, run=run)


def _name(entry: Entry) -> str:
    """Name of the run directory, or of the policy file."""
    path = Path(entry.who)
    return path.parent.name if path.name == "policy.npz" else path.name


def _without_delay(entry: Entry) -> str:
    """The same without the delay in front, which the report says once."""
    delay = entry.settings.get("delay", "").replace(":", "_")
    return _name(entry).removeprefix(f"{delay}-")


def common_settings(entries: Sequence[Entry], argv: Sequence[str]) -> dict[str, str]:
    """The policies' own settings, which become the command line's defaults.

    Raises:
        UserError: they differ in one that the command line leaves open.
    """
    common: dict[str, str] = {}
    for name in OWN_SETTINGS:
        flag = "--" + name.replace("_", "-")
        by_entry = {e.label: e.settings[name] for e in entries if name in e.settings}
        if len(set(by_entry.values())) > 1 and command_line.value_of(argv, flag) is None:
            said = ", ".join(f"{label} {value}" for label, value in by_entry.items())
            raise UserError(f"the runs differ in {flag} ({said}); choose one with {flag}")
        if by_entry:
            common[name] = next(iter(by_entry.values()))
    return common


def learning_curves(run: Path) -> Curves | None:
    """metrics.jsonl as arrays, as far as every seed has come; None if there is not one row."""
    rows: dict[int, list[dict[str, Any]]] = {}
    for row in whole_rows(run / METRICS):
        if all(isinstance(row.get(name), int | float) for name in COLUMNS):
            rows.setdefault(row["seed"], []).append(row)
    count = min((len(part) for part in rows.values()), default=0)
    if not count:
        return None

    def column(name: str) -> np.ndarray:
        return np.array([[row[name] for row in part[:count]] for part in rows.values()])

    return Curves(
        steps=column("steps")[0],
        wall_s=column("wall_s").max(axis=0),
        pos_mm=column("pos_error_mm"),
        ang_mrad=column("ang_error_mrad"),
    )
