"""Evaluate, record, draw: everything of a report but its files."""

import json
import shlex
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np

from mcx_jax.arm.model import torque_limits_nm
from mcx_jax.compute import machine
from mcx_jax.config.delay import CONTROL_DT_S
from mcx_jax.controllers.by_name import fit_if_needed
from mcx_jax.evaluate import Errors, errors_beside_ik, evaluation_env, rows_beside_ik
from mcx_jax.evaluation.paper import is_papers_world, table3
from mcx_jax.palette import controllers
from mcx_jax.report import sections, style
from mcx_jax.report.entries import Entry, learning_curves
from mcx_jax.report.episode import record
from mcx_jax.report.noise import Sweep, noise_sweep
from mcx_jax.report.page import page
from mcx_jax.report.sections import Section
from mcx_jax.report.spectra import motion_spectra
from mcx_jax.report.table import table

UNITS = ("pos_mm", "ang_mrad")
Rows = dict[str, list[dict[str, Any]]]


def build(
    config: Any, entries: Sequence[Entry], argv: Sequence[str], say: Callable[[str], None]
) -> tuple[str, dict[str, bytes], dict[str, Any]]:
    """(page, PNG files by name, results as plain numbers) of a `ReportConfig`.

    Args:
        entries: `ik` first.
        argv: the command line, for the page.
        say: prints a line of progress.
    """
    env = evaluation_env(config.env, config.motion)
    entries = [
        replace(e, controller=fit_if_needed(e.who, e.controller, config.env, config.motion, ""))
        for e in entries
    ]
    errors, rows = _evaluate(config, env, entries, say)
    colours = controllers([entry.label for entry in entries])
    parts = [(e.label, e.learned, errors[e.label]) for e in entries]
    ideal = is_papers_world(config.env, config.motion)
    chapters = [
        sections.distributions(parts, ideal),
        _table_section(rows, ideal),
        *_episode_sections(config, env, entries, colours, say),
        *_learning_sections(config, entries, rows, colours),
        sections.sea_spectra(
            motion_spectra(
                np.asarray(env.motion.knots_a), env.motion.seas, generated=not config.motion.motion
            )
        ),
    ]
    swept: list[dict[str, Any]] = []
    if config.noise_sweep:
        section, swept = _noise_section(config, env, entries, rows, colours, say)
        chapters.insert(-1, section)
    say("drawing")
    pngs = {p.name: style.png(p.figure) for chapter in chapters for p in chapter.panels}
    names = ", ".join(entry.label for entry in entries)
    html = page(
        f"Motion compensation, delay {config.env.delay}",
        f"{names}: {config.episodes} test episodes a sea. {config.env.describe_delays()}.",
        sections.lead(rows, [e.label for e in entries if e.learned]),
        chapters,
        facts := _facts(config, entries, argv),
    )
    every = [row for part in rows.values() for row in part]
    return html, pngs, {"made": facts, "rows": every, "noise": swept}


def _evaluate(config, env, entries: Sequence[Entry], say) -> tuple[dict[str, Errors], Rows]:
    """Errors and rows by label. As in `evaluate`, the baseline runs beside another controller."""
    errors: dict[str, Errors] = {}
    rows: Rows = {}
    for entry in entries[1:] or entries:
        say(f"evaluating {entry.label}")
        both = errors_beside_ik(
            entry.who, entry.controller, env, episodes=config.episodes, seed=config.seed
        )
        of_ik, of_entry = rows_beside_ik(both)
        errors.setdefault("ik", both[0])
        rows.setdefault("ik", of_ik)
        errors[entry.label], rows[entry.label] = both[-1], of_entry
    return errors, rows


def _table_section(rows: Rows, papers_world: bool) -> Section:
    bad = [
        f"{k} {r['invalid_episodes']} in {r['sea']}"
        for k, part in rows.items()
        for r in part
        if r["invalid_episodes"]
    ]
    beside = papers_world and any((r["delay"], r["sea"]) in table3() for r in rows["ik"])
    return Section(
        "Table 3, ours and the paper's" if beside else "Means and improvements",
        [],
        "Mean and standard deviation over all points, and by how much the mean of all points, of "
        "the worst 5 % and 1 % of them, and the maximum (max) lie below ik's. "
        + (
            "In italics the paper's figures (Herland & Bach, AAAI 2023, table 3), where it has "
            "this delay and sea; its ik is what its agents' errors and improvements imply. "
            if beside
            else "The paper has no figures for this task. "
        )
        + (
            f"Invalid episodes, counted all the same: {', '.join(bad)}."
            if bad
            else "No episode was invalid."
        ),
        table(rows, papers_world),
    )


def _episode_sections(config, env, entries: Sequence[Entry], colours, say) -> list[Section]:
    sea = len(env.motion.seas) - 1
    recorded = []
    for entry in entries[1:] or entries:
        say(f"recording one episode of {entry.label}")
        both = record(
            env,
            entry.controller,
            episode=config.show,
            episodes=config.episodes,
            seed=config.seed,
            sea=sea,
        )
        recorded.append((entry.label, *both))
    baseline = recorded[0][1]
    others = [(label, ours) for label, _, ours in recorded if label != "ik"]
    seconds = config.env.episode_steps * CONTROL_DT_S
    where = f"Test episode {config.show} of sea {env.motion.seas[sea]}, {seconds:g} s"
    return [
        sections.tracking(baseline, others, colours, where),
        sections.effort(baseline, others, colours, torque_limits_nm(env.model)),
    ]


def _noise_section(config, env, entries: Sequence[Entry], rows: Rows, colours, say):
    """(section, rows for results.json), in the sea where the baseline is worst."""
    sea = int(np.argmax([row["pos_mm"]["mean"] for row in rows["ik"]]))
    name = env.motion.seas[sea]
    options = {"sea": sea, "episodes": config.episodes, "seed": config.seed}
    sweeps: list[Sweep] = []
    for entry in entries[1:] or entries:
        begun = time.monotonic()
        labels = tuple(dict.fromkeys(("ik", entry.label)))
        both = noise_sweep(env, entry.controller, labels, **options)
        sweeps += both if not sweeps else both[-1:]
        say(f"measurement noise, {entry.label}: {time.monotonic() - begun:.0f} s")
    section = sections.noise(sweeps, colours, name)
    return section, [row for s in sweeps for row in s.rows(name)]


def _learning_sections(config, entries: Sequence[Entry], rows: Rows, colours) -> list[Section]:
    runs, same = [], True
    for entry in entries:
        curves = learning_curves(entry.run) if entry.run else None
        if curves is not None:
            runs.append((entry.label, curves))
            same &= all(getattr(config.env, k) == v for k, v in entry.settings.items())
    if not runs:
        return []
    final = {
        label: {unit: float(np.mean([row[unit]["mean"] for row in rows[label]])) for unit in UNITS}
        for label in ("ik", *(label for label, _ in runs))
    }
    return [sections.learning(runs, colours, final if same else {})]


def _facts(config, entries: Sequence[Entry], argv: Sequence[str]) -> dict[str, str]:
    from importlib.metadata import version

    packages = {**machine.versions(), "matplotlib": version("matplotlib")}
    metas = [(e, e.controller.policy.meta) for e in entries if e.learned]
    policies = [
        f"{e.label if e.label == e.who else f'{e.label} = {e.who}'}, iteration {m.iteration}, "
        f"seed {m.seed}"
        for e, m in metas
    ]
    return {
        "command": f"python -m mcx_jax.report {shlex.join(argv)}",
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "versions": ", ".join(f"{name} {value}" for name, value in packages.items()),
        "device": machine.device(),
        "policies": "; ".join(policies) or "none",
        "task": json.dumps(asdict(config.env)),
        "motion": json.dumps(asdict(config.motion)),
        "episodes": f"{config.episodes} a sea, seed {config.seed}; the first second is not counted",
    }
