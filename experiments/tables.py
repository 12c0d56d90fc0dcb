"""Regenerate the tables of README.md and of the site's pages from the stored results.

    python experiments/tables.py

Each block stands between `<!-- table:NAME -->` and `<!-- end -->`.
"""

import csv
import math
import re
from collections.abc import Iterable
from pathlib import Path

FOLDER = Path(__file__).parent
ROOT = FOLDER.parent
PAGES = (
    "README.md",
    "docs/results.md",
    "docs/speed.md",
    "docs/paper.md",
    "docs/task.md",
    "docs/cluster.md",
    "docs/trust.md",
)
SEA_NAMES = {
    "Wa": "Wa: Hs 1.0 m, Tp 6 s",
    "Wb": "Wb: Hs 1.5 m, Tp 8 s",
    "Wc": "Wc: Hs 2.0 m, Tp 9 s",
    "Wd": "Wd: Hs 2.5 m, Tp 10 s",
}
SEAS = tuple(SEA_NAMES)
DELAYS = ("E0", "B4_21", "E1", "B4_4", "E2")


def read(name: str) -> list[dict[str, str]]:
    """Rows of experiments/NAME.csv."""
    with (FOLDER / f"{name}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


LEARNS_NOTHING = ("ik", "extrapolate", "fir")
"""Controllers that see what an agent sees. `extrapolate-best` is left out: the best lead that it
finds is the one that `extrapolate` has, so that their errors are the same in every cell."""


def over_seeds(name: str) -> list[dict[str, str]]:
    """Rows of experiments/NAME.csv, one for each delay and sea: interquartile means over seeds."""
    from mcx_jax.evaluation.statistics import interquartile_mean

    groups: dict[tuple[str, str, str], list[dict[str, str]]] = {}
    for row in read(name):
        groups.setdefault((row["who"], row["delay"], row["sea"]), []).append(row)
    out = []
    for rows in groups.values():
        mean = {
            key: f"{interquartile_mean([float(r[key]) for r in rows]):.3f}"
            for key in rows[0]
            if key.startswith(("pos_mm", "ang_mrad", "gain_")) and not key.endswith("_paper")
        }
        out.append({**rows[0], **mean, "seeds": str(len(rows))})
    return out


def source(row: dict[str, str]) -> str:
    return f"`{row['command']}` (commit {row['commit']}, {row['device']}, jax {row['jax']})"


def sources(rows: Iterable[dict[str, str]]) -> str:
    """Every command that the rows come from, once."""
    return "; ".join(dict.fromkeys(source(row) for row in rows))


def markdown(header: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(header) + " |", "|" + " --- |" * len(header)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def headline() -> str:
    """Delay B4_4 in the paper's world: what the README shows."""
    cells = {(r["who"], r["sea"]): r for r in _everyone("B4_4")}
    columns = {
        "no correction (`ik`)": "ik",
        "best without a network (`fir`)": "fir",
        "here, PPO": "ppo",
        "here, first-order": "first-order",
    }
    rows = []
    for sea, name in SEA_NAMES.items():
        errors = [_pair(cells[who, sea], "") for who in columns.values()]
        rows.append([name, *errors, _pair(cells["fir", sea], "_paper")])
    table = markdown(["sea, full scale", *columns, "paper's agent"], rows)
    return f"{table}\n\nRows, commands, commits: `experiments/*.csv`."


def _pair(row: dict[str, str], ending: str) -> str:
    pos, ang = (float(row[unit + ending]) for unit in ("pos_mm", "ang_mrad"))
    return f"{pos:.2f} mm, {ang:.2f} mrad"


def baseline() -> str:
    """The IK baseline beside the one that table 3 implies."""
    cells = {(r["delay"], r["sea"]): r for r in read("baseline_ik")}
    rows = []
    for delay in DELAYS:
        row = [delay]
        for unit in ("pos_mm", "ang_mrad"):
            row += [
                f"{float(cells[delay, s][unit]):.2f} / {cells[delay, s][unit + '_paper']}"
                for s in SEAS
            ]
        rows.append(row)
    header = ["delay", *(f"{s} mm" for s in SEAS), *(f"{s} mrad" for s in SEAS)]
    return markdown(header, rows) + "\n\nSource: " + sources(cells.values())


def _everyone(delay: str) -> list[dict[str, str]]:
    """Every controller's rows of a delay, in the paper's world."""
    found = []
    for who in (*LEARNS_NOTHING, "preview"):
        found += [r for r in read(f"baseline_{who}") if r["delay"] == delay]
    for name in ("ppo", "first_order"):
        found += [r for r in over_seeds(name) if r["who"] != "ik" and r["delay"] == delay]
    return found


def all_delays() -> str:
    """Everybody side by side, every delay."""
    rows, stored = [], []
    for delay in DELAYS:
        everyone = _everyone(delay)
        cells = {(r["who"], r["sea"]): r for r in everyone}
        for who in dict.fromkeys(r["who"] for r in everyone):
            values = [float(cells[who, s][unit]) for unit in ("pos_mm", "ang_mrad") for s in SEAS]
            rows.append([delay, who, *map(_short, values)])
        paper = [cells["preview", s][f"{u}_paper"] for u in ("pos_mm", "ang_mrad") for s in SEAS]
        rows.append([delay, "paper's agent", *paper])
        stored += everyone
    header = ["delay", "who", *(f"{s} mm" for s in SEAS), *(f"{s} mrad" for s in SEAS)]
    return markdown(header, rows) + "\n\nSource: " + sources(stored)


def agents() -> str:
    """Agents of all delays beside the paper's."""
    blocks = []
    for name, what in (
        ("ppo", "PPO, the paper's world"),
        ("first_order", "first-order, the paper's world"),
        ("first_order_quiet", "first-order, the quiet world"),
        ("first_order_implicitfast", "first-order, implicitfast"),
    ):
        cells = {(r["delay"], r["sea"]): r for r in over_seeds(name) if r["who"] != "ik"}
        rows = []
        for delay in dict.fromkeys(delay for delay, _ in cells):
            mine = [cells[delay, s] for s in SEAS]
            row = [delay]
            for unit in ("pos_mm", "ang_mrad"):
                row += [f"{_short(float(r[unit]))} / {r[unit + '_paper']}" for r in mine]
            rows.append([*row, f"{int(mine[0]['steps']) / 1e6:.1f} M", mine[0]["seeds"]])
        header = [what, *(f"{s} mm" for s in SEAS), *(f"{s} mrad" for s in SEAS)]
        table = markdown([*header, "steps", "seeds"], rows)
        blocks.append(table + "\n\nSource: " + sources(cells.values()))
        blocks += _over_seeds_line(name)
        if name == "first_order_implicitfast":
            continue
        worst = [_below_paper(cell) for cell in cells.values()]
        if all(worst):
            below = [line for lines in worst for line in lines[1:]]
            found = f"{len(below)} of {6 * len(worst)} below the paper's"
            found += ": " + ", ".join(below) if below else ""
            found += _below_by_seed(name)
            blocks.append(f"Improvements of top 5 %, top 1 % and maximum over `ik`: {found}.")
        blocks += _beside_classical(cells, "_quiet" if name.endswith("_quiet") else "")
    return "\n\n".join(blocks)


def _short(error: float) -> str:
    return f"{error:.2f}" if error >= 0.1 else f"{error:.3f}"


def _beside_classical(cells: dict[tuple[str, str], dict[str, str]], world: str) -> list[str]:
    """How agents compare, cell by cell, with the best of the controllers without learning."""
    best: dict[tuple[str, str, str], float] = {}
    names = ("extrapolate", "fir") if world else LEARNS_NOTHING
    for who in names:
        for row in read(f"baseline_{who}{world}"):
            for unit in ("pos_mm", "ang_mrad"):
                cell = row["delay"], row["sea"], unit
                best[cell] = min(best.get(cell, math.inf), float(row[unit]))
    said = []
    for unit, what in (("pos_mm", "position"), ("ang_mrad", "orientation")):
        shares = {key: float(row[unit]) / best[(*key, unit)] for key, row in cells.items()}
        worst = max(shares, key=lambda key: shares[key])
        third = sum(share <= 1 / 3 for share in shares.values())
        said.append(
            f"{what} {min(shares.values()):.2f} to {shares[worst]:.2f} (worst: {' '.join(worst)}) "
            f"of that controller's error, at most a third in {third} of {len(shares)} cells"
        )
    rivals = ", ".join(f"`{who}`" for who in names)
    return [f"Beside the best of {rivals} in each cell: {'; '.join(said)}."]


def _over_seeds_line(name: str) -> list[str]:
    """How far seeds differ, if a delay has several."""
    import numpy as np

    from mcx_jax.evaluation.statistics import bootstrap_interval, interquartile_mean

    groups: dict[tuple[str, str], list[dict[str, str]]] = {}
    for row in read(name):
        if row["who"] != "ik":
            groups.setdefault((row["delay"], row["sea"]), []).append(row)
    most = max((len(rows) for rows in groups.values()), default=0)
    if most < 2:
        return []
    said = []
    for unit, what in (("pos_mm", "position"), ("ang_mrad", "orientation")):
        reach, single = 0.0, 0.0
        for rows in groups.values():
            values = np.array([float(r[unit]) for r in rows])
            single = max(single, values.max() / float(rows[0][f"{unit}_paper"]))
            if len(rows) > 1:
                middle = interquartile_mean(values)
                ends = np.array(bootstrap_interval(values, draws=1000))
                reach = max(reach, np.abs(ends / middle - 1).max())
        said.append(f"{what} {100 * reach:.0f} % and {single:.2f}")
    return [
        "Seeds: interquartile means above; the widest 95 % bootstrap interval of a cell reaches so "
        "far from it, and the worst cell of any single seed is so much of the paper's: "
        f"{', '.join(said)}."
    ]


def goals() -> str:
    """Goals that move on the deck."""
    stored = [r for r in read("goals") if r["who"] != "extrapolate-best"]
    cells = {(r["who"], r["goal"]): r for r in stored}
    paths = list(dict.fromkeys(r["goal"] for r in stored))
    rows = [
        [who, *(_mean_and_max(cells[who, path]) for path in paths)]
        for who in dict.fromkeys(r["who"] for r in stored)
    ]
    table = markdown(["mean (largest), mm, mrad", *paths], rows)
    return table + "\n\nSource: " + source(stored[0])


def _mean_and_max(r: dict[str, str]) -> str:
    return ", ".join(
        f"{float(r[unit + '_mean']):.2f} ({float(r[unit + '_max']):.1f})"
        for unit in ("pos_mm", "ang_mrad")
    )


def growth(rows: list[dict]) -> str:
    """Resident memory of a long run over time (the largest of three samples around an instant:
    single ones are lower by 200 MiB), and what was traced or compiled."""
    minutes = [float(r["minute"]) for r in rows]
    mib = [float(r["resident_mib"]) for r in rows]

    def around(minute: float) -> float:
        near = sorted(range(len(rows)), key=lambda i: abs(minutes[i] - minute))[:3]
        return max(mib[i] for i in near)

    end, half = minutes[-1], minutes[-1] / 2
    marks = [m for m in (5, 10, 20, 30, 40) if m < end]
    seen = ", ".join(f"{around(m):.0f} (minute {m})" for m in marks)
    counts = [int(r["compilations"]) for r in rows]
    last = counts.index(counts[-1])
    return (
        f"{end:.1f} min, resident MiB: {seen}, {around(end):.0f} at the end; in the second half "
        f"{100 * (around(end) / around(half) - 1):+.2f} %. Traces and compilations after the first "
        f"metrics: {counts[-1]}, the last of them before minute {minutes[last]:.1f}"
    )


def long_run() -> str:
    """Memory and compilations of a long run."""
    stored = read("long_run")
    return growth(stored) + ". Source: " + source(stored[0])


def paper_preset() -> str:
    """What the paper's own schedule has done so far."""
    rows = read("paper_preset")
    first, last = rows[0], rows[-1]
    said = [
        f"{what} {float(first[name]):.{digits}f} at first, {float(last[name]):.{digits}f} at last"
        for what, name, digits in (
            ("position error, exploration included, mm", "pos_error_mm", 1),
            ("orientation error, mrad", "ang_error_mrad", 1),
            ("standard deviation of the exploration, cm and crad", "sigma", 3),
        )
    ]
    cells = {(r["who"], r["sea"]): r for r in read("paper_preset_evaluated")}
    beside = [
        f"{sea} {float(cells['ppo', sea][unit]):.1f} / {float(cells['ik', sea][unit]):.1f} {word}"
        for unit, word in (("pos_mm", "mm"), ("ang_mrad", "mrad"))
        for sea in SEAS
    ]
    return (
        f"{last['iteration']} iterations; {'; '.join(said)}. Without exploration, the policy / "
        f"`ik`: {', '.join(beside)}. Source: {sources(rows)}"
    )


def robust() -> str:
    """Where the task is hard: controllers side by side."""
    stored = [r for r in read("robust") if r["who"] != "extrapolate-best"]
    cells = {(r["condition"], r["who"]): r for r in stored}
    whos = list(dict.fromkeys(r["who"] for r in stored))
    rows = [
        [what, *(f"{float(c['pos_mm']):.2f}, {float(c['ang_mrad']):.2f}" for c in row)]
        for what in dict.fromkeys(r["condition"] for r in stored)
        for row in [[cells[what, who] for who in whos]]
    ]
    table = markdown(["mm, mrad", *whos], rows)
    said = [f"`robust` is better in both errors than {_lead(cells, r)}." for r in RIVALS]
    return "\n\n".join([table, " ".join(said), "Source: " + sources(stored)])


RIVALS = (("extrapolate",), LEARNS_NOTHING)


def _lead(cells: dict[tuple[str, str], dict[str, str]], rivals: tuple[str, ...]) -> str:
    """Against whom, in how many conditions, and where not."""
    names = dict.fromkeys(what for what, _ in cells)

    def behind(what: str) -> bool:
        """One that diverged (nan) is behind everybody."""

        def error(who: str, unit: str) -> float:
            value = float(cells[what, who][unit])
            return value if math.isfinite(value) else math.inf

        return any(
            error("robust", unit) >= min(error(r, unit) for r in rivals)
            for unit in ("pos_mm", "ang_mrad")
        )

    lost = [what for what in names if behind(what)]
    against = f"`{rivals[0]}`" if len(rivals) == 1 else "the best controller without learning"
    found = f"{against} in {len(names) - len(lost)} of {len(names)} conditions"
    return found + (f", not in: {'; '.join(lost)}" if lost else "")


def _below_by_seed(name: str) -> str:
    """The same of every seed by itself, where there are several."""
    counts: dict[str, list[int]] = {}
    for row in read(name):
        if row["who"] != "ik":
            counts.setdefault(row["seed"], []).append(len(_below_paper(row)) - 1)
    if len(counts) == 1:
        return ""
    each = [f"{sum(found)} of {6 * len(found)} (seed {seed})" for seed, found in counts.items()]
    return f"; seeds by themselves: {', '.join(each)}"


def _below_paper(cell: dict[str, str]) -> list[str]:
    """["checked", cells whose improvement is smaller than the paper's]; [] without such columns."""
    from mcx_jax.evaluation.paper import table3

    if "gain_pos_max" not in cell:
        return []
    paper, out = table3()[cell["delay"], cell["sea"]], ["checked"]
    for unit in ("pos", "ang"):
        for group in ("top5", "top1", "max"):
            ours, theirs = float(cell[f"gain_{unit}_{group}"]), 100 * paper[f"{unit}_imp_{group}"]
            if ours < theirs:
                name = f"{cell['delay']} {cell['sea']} {unit} {group}"
                out.append(f"{name} {ours:.0f} % (paper {theirs:.0f} %)")
    return out


def speed() -> str:
    """What the bench measured."""
    stored = read("speed")
    one = {r["what"]: float(r["value"]) for r in stored if not r["envs"]}
    at = {(r["what"], int(r["envs"])): float(r["value"]) for r in stored if r["envs"]}

    def best(engine: str) -> str:
        cells = {n: v for (what, n), v in at.items() if what == f"physics {engine}"}
        envs = max(cells, key=lambda n: cells[n])
        return f"{cells[envs] / 1e6:.2f} M/s ({envs} environments)"

    def times(name: str) -> str:
        ends = [one.get(f"{name} {end}", one[name]) for end in ("least", "most")]
        least, most = (f"{x:.0f}" for x in ends)
        return f"{least} times" if least == most else f"{least} to {most} times"

    parts = [f"{name[5:-3]} {us:.2f}" for name, us in one.items() if name.startswith("part ")]
    environment = [f"{v / 1e3:.0f} k/s ({n})" for (w, n), v in at.items() if w == "environment"]
    share, rate = one["learner_matmul_share"], one["matmul_gflops"]
    rows = [
        ["physics steps of 2 ms, chain engine", best("chain")],
        ["C MuJoCo, `mujoco.batch`, all cores", best("c-batch")],
        ["C MuJoCo, `mujoco.rollout`, all cores", best("c-rollout")],
        ["MJX, its CPU flag set", best("mjx")],
        ["chain over C, each at its best batch", times("chain_over_c")],
        ["chain over MJX, 2048 environments", times("chain_over_mjx")],
        ["gradient of ten steps over the steps", f"{one['gradient_over_forward']:.1f} times"],
        ["environment, control steps of 20 ms", ", ".join(environment)],
        ["its parts alone, us a control step", ", ".join(parts)],
        ["rollout with the policy", f"{one['rollout_steps_per_s'] / 1e3:.0f} k control steps/s"],
        ["PPO, learning included", f"{one['training_steps_per_s'] / 1e3:.1f} k control steps/s"],
        ["learner, of the machine's matrix rate", f"{100 * share:.0f} % of {rate:.0f} GFlop/s"],
        [
            "`train` to its first metrics, cache empty / full",
            f"{one['compile cold s']:.0f} s / {one['compile warm s']:.0f} s",
        ],
        ["peak memory, 16,384 environments, no learner", f"{one['peak_memory_gib']:.2f} GiB"],
    ]
    return markdown(["what", "here"], rows) + "\n\nSource: " + source(stored[0])


def speed_summary() -> str:
    """The rows of `speed` that the README shows."""
    lines = speed().split("\n")
    wanted = ("physics steps of", "C MuJoCo, `mujoco.batch`", "MJX,", "environment,", "PPO,")
    chosen = [x for x in lines if x.startswith(tuple(f"| {name}" for name in wanted))]
    return "\n".join([*lines[:2], *chosen])


def scaling() -> str:
    """Training with as many environments a device, on more and more devices."""
    stored = read("scaling")
    rows = [
        [
            f"{r['processes']} x {r['devices_each']}"
            + (", not bound to cores" if r.get("bound") == "False" else ""),
            r["num_envs"],
            f"{float(r['steps_per_s']) / 1e3:.1f} k",
            f"{r['share_of_linear_percent']} %",
        ]
        for r in stored
    ]
    header = ["processes x devices", "environments", "control steps/s", "of cores x the first row"]
    return markdown(header, rows) + "\n\nSource: " + source(stored[0])


def observation() -> str:
    """The observation's table, from the code."""
    from mcx_jax.envs.observe import OBS_TABLE

    rows, start = [], 0
    for row in OBS_TABLE:
        rows.append([f"{start}..{start + row.size - 1}", f"`{row.name}`", row.unit, row.meaning])
        start += row.size
    return markdown(["index", "name", "unit", "meaning"], rows)


def presets() -> str:
    """Where the presets differ, from the code."""
    from dataclasses import fields

    from mcx_jax.config.training import preset_config

    fast, paper = preset_config("fast"), preset_config("paper")
    rows = [["`--num-envs`", str(fast.num_envs), str(paper.num_envs)]]
    rows.append(["`--episode-steps`", *(str(c.env.episode_steps) for c in (fast, paper))])
    for field in fields(fast.ppo):
        ours, theirs = getattr(fast.ppo, field.name), getattr(paper.ppo, field.name)
        if ours != theirs:
            rows.append([f"`--{field.name.replace('_', '-')}`", _setting(ours), _setting(theirs)])
    return markdown(["setting", "`fast` (default)", "`paper`"], rows)


def _setting(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


TABLES = {
    "headline": headline,
    "baseline": baseline,
    "all_delays": all_delays,
    "agents": agents,
    "robust": robust,
    "goals": goals,
    "long_run": long_run,
    "speed": speed,
    "speed_summary": speed_summary,
    "scaling": scaling,
    "observation": observation,
    "presets": presets,
    "paper_preset": paper_preset,
}


def regenerate(text: str) -> str:
    """A page with every block made anew."""

    def block(match: re.Match[str]) -> str:
        return f"<!-- table:{match[1]} -->\n{TABLES[match[1]]()}\n<!-- end -->"

    return re.sub(r"<!-- table:(\w+) -->\n.*?<!-- end -->", block, text, flags=re.DOTALL)


def main() -> None:
    for page in PAGES:
        path = ROOT / page
        path.write_text(regenerate(path.read_text()))


if __name__ == "__main__":
    main()
