"""`python -m mcx_jax.bench`: every engine, the environment, the rollout, training, compile times.

All in one run, rivals included; medians of five (training and ratios under --quick: three); compile
times apart. Ratios are measured again, engine and rival in turn, and given as a range.
"""

if __name__ == "__main__":
    from mcx_jax.console.command import begin

    begin()

import json
import os
import statistics
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from mcx_jax.bench.timing import REPEATS
from mcx_jax.compute import machine
from mcx_jax.errors import UserError

ENVS = (1, 8, 64, 512, 2048, 16384)
QUICK_ENVS = (1, 64, 2048)
FEW_ENVS = (1, 64, 2048)
"""For MJX, whose larger batches take minutes and tell nothing new."""
ENVIRONMENT_ENVS = (512, 2048, 16384)
QUICK_REPEATS = 3
RATIO_ENVS = 2048
"""Where chain and MJX are compared."""


@dataclass(frozen=True)
class BenchConfig:
    """How fast everything is on this machine, rivals included, in one run. Let nothing else run."""

    quick: bool = False
    """Fewer batch sizes, no gradient, no cold start: 90 s on two cores once compiled."""
    json: str = ""
    """Write the figures to this file; - or no value: to the terminal, and the report to stderr."""
    plot: str = ""
    """Also draw steps/s against number of environments into this .png or .svg file."""
    device: Literal["auto", "cpu", "gpu"] = "auto"
    """Where to run; auto = GPU if JAX has one."""


def run(quick: bool, say) -> dict[str, Any]:
    """All figures as plain numbers (see README).

    Args:
        quick: fewer batch sizes, no cold start.
        say: prints a line of progress.
    """
    from mcx_jax.bench import program, startup_time
    from mcx_jax.config.training import TrainConfig
    from mcx_jax.envs.v2v import make_env

    figures: dict[str, Any] = {"device": machine.device(), "versions": machine.versions()}
    figures["xla_flags"] = os.environ.get("XLA_FLAGS", "")
    _physics(figures, quick, say)
    config = TrainConfig()
    env = make_env(config.env, config.motion)
    _environment(figures, env, config.num_envs, quick, say)
    if not quick:
        figures["breakdown_us"] = program.breakdown_us(env, program.reset(env, config.num_envs))
        parts = ", ".join(f"{name} {us:.2f}" for name, us in figures["breakdown_us"].items())
        say(f"parts of a control step alone, us: {parts}")
    figures["peak_memory_gib"] = peak_memory_gib()
    if figures["peak_memory_gib"]:
        say(f"peak memory so far, no learner: {figures['peak_memory_gib']:.2f} GiB")
    _training(figures, env, config, quick, say)
    figures["compile_s"] = {"cold": None, "warm": None}
    if not quick:
        figures["compile_s"] = startup_time.first_metrics_s()
        said = "command to first metrics: {cold:.0f} s cold, {warm:.0f} s warm"
        say(said.format(**figures["compile_s"]))
    return figures


def _physics(figures: dict[str, Any], quick: bool, say) -> None:
    from mcx_jax.bench import physics

    repeats = QUICK_REPEATS if quick else REPEATS
    figures["physics"] = rows = []
    for engine, work in physics.ENGINES.items():
        for envs in batch_sizes(engine, quick):
            speed = work(envs).steps_per_s(REPEATS)
            rows.append({"engine": engine, "envs": envs, "steps_per_s": speed})
            say(f"{engine:>10} {envs:6d} environments: {speed:12,.0f} steps/s")
    figures["ratio"], figures["ratio_range"] = {}, {}
    for name, pair in rivals(rows).items():
        ours, theirs = (physics.ENGINES[engine](envs) for engine, envs in pair)
        found = physics.ratios(ours, theirs, repeats)
        least, middle, most = min(found), statistics.median(found), max(found)
        figures["ratio"][name], figures["ratio_range"][name] = middle, [least, most]
        said = f"{least:.1f} to {most:.1f} times, median {middle:.1f} of {repeats}"
        say(f"{name.replace('_', ' ')}: {said}")
    if not quick:
        figures["gradient_over_forward"] = physics.gradient_over_forward(RATIO_ENVS)
        say(f"gradient of ten physics steps: {figures['gradient_over_forward']:.1f} times forward")


def _environment(figures: dict[str, Any], env, usual: int, quick: bool, say) -> None:
    from mcx_jax.bench import program

    figures["environment"] = []
    for envs in (usual,) if quick else ENVIRONMENT_ENVS:
        us = program.environment_us(env, program.reset(env, envs))
        figures["environment"].append({"envs": envs, "steps_per_s": 1e6 / us, "us_per_step": us})
        say(f"environment, {envs} environments: {1e6 / us:,.0f} control steps/s ({us:.2f} us)")
    speeds = {row["envs"]: row["steps_per_s"] for row in figures["environment"]}
    figures["environment_steps_per_s"] = speeds[usual]


def _training(figures: dict[str, Any], env, config, quick: bool, say) -> None:
    from dataclasses import asdict

    from mcx_jax.bench import program

    speed = program.training_speed(config, env, QUICK_REPEATS if quick else REPEATS)
    figures.update(asdict(speed))
    # Products alone can be beaten, by a learner that keeps several devices busy at once, say: what
    # the machine has shown counts.
    rate = max(program.matmul_gflops(), speed.learner_gflops)
    figures["matmul_gflops"] = rate
    figures["learner_matmul_share"] = speed.learner_gflops / rate
    say(f"rollout with policy: {speed.rollout_steps_per_s:,.0f} control steps/s")
    say(f"training, learning included: {speed.training_steps_per_s:,.0f} control steps/s")
    say(
        f"learner: {speed.learner_gflops:.0f} GFlop/s of the machine's {rate:.0f}: "
        f"{100 * figures['learner_matmul_share']:.0f} %"
    )


def batch_sizes(engine: str, quick: bool) -> tuple[int, ...]:
    """Numbers of environments to time an engine with."""
    if engine == "mjx":
        return (RATIO_ENVS,) if quick else FEW_ENVS
    return QUICK_ENVS if quick else ENVS


def rivals(rows: list[dict[str, Any]]) -> dict[str, tuple[tuple[str, int], tuple[str, int]]]:
    """{name: ((engine, environments), those of its rival)}: the chain engine's best batch and C's,
    and both JAX engines with the same batch."""

    def best(*engines: str) -> tuple[str, int]:
        row = max((r for r in rows if r["engine"] in engines), key=lambda r: r["steps_per_s"])
        return row["engine"], row["envs"]

    return {
        "chain_over_c": (best("chain"), best("c-rollout", "c-batch")),
        "chain_over_mjx": (("chain", RATIO_ENVS), ("mjx", RATIO_ENVS)),
    }


def peak_memory_gib() -> float | None:
    """Peak resident memory of this process; None on Windows, which does not say."""
    try:
        import resource
    except ImportError:
        return None
    unit = 1 if sys.platform == "darwin" else 2**10  # bytes on macOS, KiB elsewhere
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**30


def main(argv: list[str] | None = None) -> None:
    """Command line."""
    from mcx_jax import extras
    from mcx_jax.compute import startup
    from mcx_jax.config import command_line

    argv = list(sys.argv[1:] if argv is None else argv)
    config = command_line.parse(
        BenchConfig, command_line.optional_value(argv, "--json", "-"), prog="bench"
    )
    command_line.check_output("--json", config.json)
    command_line.check_output("--plot", config.plot)
    if config.plot and Path(config.plot).suffix not in (".png", ".svg"):
        raise UserError(f"--plot {config.plot}: the name must end in .png or .svg")
    if config.plot:
        extras.require("matplotlib", "--plot")
    report = sys.stderr if config.json == "-" else sys.stdout

    def say(line: str) -> None:
        print(line, file=report, flush=True)

    for line in startup.configure(config.device):
        say(line)
    figures = run(config.quick, say)
    text = json.dumps(figures, indent=1)
    if config.json == "-":
        print(text)
    elif config.json:
        command_line.write_output("--json", config.json, text + "\n")
    if config.plot:
        from mcx_jax.bench.plot import draw

        draw(figures, Path(config.plot))


if __name__ == "__main__":
    from mcx_jax.compute.startup import run_command

    run_command(main)
