"""`python -m mcx_jax.bench`: every engine, the environment, the rollout, training, compile times.

All in one run, rivals included; medians of five (training under --quick: three); compile times
apart.
"""

if __name__ == "__main__":
    from mcx_jax.command import begin

    begin()

import importlib.util
import json
import resource
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from mcx_jax import machine
from mcx_jax.errors import UserError

ENVS = (1, 8, 64, 512, 2048, 16384)
QUICK_ENVS = (1, 64, 2048)
FEW_ENVS = (1, 64, 2048)
"""For MJX, whose larger batches take minutes and tell nothing new."""
ENVIRONMENT_ENVS = (512, 2048, 16384)
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
    from dataclasses import asdict

    from mcx_jax.bench import physics, program, startup_time
    from mcx_jax.bench.timing import REPEATS
    from mcx_jax.config import TrainConfig
    from mcx_jax.envs.v2v import make_env

    figures: dict[str, Any] = {"device": machine.device(), "versions": machine.versions()}
    figures["physics"] = rows = []
    for engine, speed in physics.ENGINES.items():
        for envs in batch_sizes(engine, quick):
            rows.append({"engine": engine, "envs": envs, "steps_per_s": speed(envs)})
            say(f"{engine:>10} {envs:6d} environments: {rows[-1]['steps_per_s']:12,.0f} steps/s")
    figures["ratio"] = ratios(rows)
    for name, value in figures["ratio"].items():
        say(f"{name.replace('_', ' ')}: {value:.1f} times")
    if not quick:
        figures["gradient_over_forward"] = physics.gradient_over_forward(RATIO_ENVS)
        say(f"gradient of ten physics steps: {figures['gradient_over_forward']:.1f} times forward")

    config = TrainConfig()
    env = make_env(config.env, config.motion)
    figures["environment"] = []
    for envs in (config.num_envs,) if quick else ENVIRONMENT_ENVS:
        us = program.environment_us(env, program.reset(env, envs))
        figures["environment"].append({"envs": envs, "steps_per_s": 1e6 / us, "us_per_step": us})
        say(f"environment, {envs} environments: {1e6 / us:,.0f} control steps/s ({us:.2f} us)")
    speeds = {row["envs"]: row["steps_per_s"] for row in figures["environment"]}
    figures["environment_steps_per_s"] = speeds[config.num_envs]
    if not quick:
        figures["breakdown_us"] = program.breakdown_us(env, program.reset(env, config.num_envs))
        parts = ", ".join(f"{name} {us:.2f}" for name, us in figures["breakdown_us"].items())
        say(f"parts of a control step alone, us: {parts}")
    figures["peak_memory_gib"] = peak_memory_gib()
    say(f"peak memory so far, no learner: {figures['peak_memory_gib']:.2f} GiB")

    speed = program.training_speed(config, env, 3 if quick else REPEATS)
    figures.update(asdict(speed))
    figures["matmul_gflops"] = program.matmul_gflops()
    figures["learner_matmul_share"] = speed.learner_gflops / figures["matmul_gflops"]
    say(f"rollout with policy: {speed.rollout_steps_per_s:,.0f} control steps/s")
    say(f"training, learning included: {speed.training_steps_per_s:,.0f} control steps/s")
    say(
        f"learner: {speed.learner_gflops:.0f} GFlop/s of the machine's "
        f"{figures['matmul_gflops']:.0f}: {100 * figures['learner_matmul_share']:.0f} %"
    )
    figures["compile_s"] = {"cold": None, "warm": None}
    if not quick:
        figures["compile_s"] = startup_time.first_metrics_s()
        say(
            "command to first metrics: {cold:.0f} s cold, {warm:.0f} s warm".format(
                **figures["compile_s"]
            )
        )
    return figures


def batch_sizes(engine: str, quick: bool) -> tuple[int, ...]:
    """Numbers of environments to time an engine with."""
    if engine == "mjx":
        return (RATIO_ENVS,) if quick else FEW_ENVS
    return QUICK_ENVS if quick else ENVS


def ratios(rows: list[dict[str, Any]]) -> dict[str, float]:
    """How many times faster the chain engine is: best batch against C's best, and against MJX."""

    def best(*engines: str) -> float:
        return max(row["steps_per_s"] for row in rows if row["engine"] in engines)

    def at(engine: str) -> float:
        chosen = [r for r in rows if r["engine"] == engine and r["envs"] == RATIO_ENVS]
        return chosen[0]["steps_per_s"]

    return {
        "chain_over_c": best("chain") / best("c-rollout", "c-batch"),
        "chain_over_mjx": at("chain") / at("mjx"),
    }


def peak_memory_gib() -> float:
    """Peak resident memory of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def main(argv: list[str] | None = None) -> None:
    """Command line."""
    from mcx_jax import cli, startup

    argv = list(sys.argv[1:] if argv is None else argv)
    config = cli.parse(BenchConfig, cli.optional_value(argv, "--json", "-"), prog="bench")
    cli.check_output("--json", config.json)
    cli.check_output("--plot", config.plot)
    if config.plot and Path(config.plot).suffix not in (".png", ".svg"):
        raise UserError(f"--plot {config.plot}: the name must end in .png or .svg")
    if config.plot and importlib.util.find_spec("matplotlib") is None:
        raise UserError("--plot needs matplotlib: install the 'viz' extra")
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
        cli.write_output("--json", config.json, text + "\n")
    if config.plot:
        from mcx_jax.bench.plot import draw

        draw(figures, Path(config.plot))


if __name__ == "__main__":
    from mcx_jax.startup import run_command

    run_command(main)
