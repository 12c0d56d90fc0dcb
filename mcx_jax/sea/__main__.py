"""`python -m mcx_jax.sea`: motion statistics of the generator beside the paper's table 1."""

if __name__ == "__main__":
    from mcx_jax.console.command import begin

    begin()

import json
import math
import sys
from dataclasses import dataclass

from mcx_jax.config import command_line
from mcx_jax.sea.spectrum import SEAS
from mcx_jax.sea.statistics import (
    WANTED_ANGULAR_RAD_S,
    WANTED_LINEAR_M_S,
    GoalSpeed,
    goal_speed,
)
from mcx_jax.sea.tables import build_tables


@dataclass(frozen=True)
class SeaConfig:
    """Motion statistics of the generator beside the paper's table 1."""

    json: str = ""
    """Also write the figures to this file."""


def report(speed: GoalSpeed) -> dict:
    """The figures as plain numbers, in the order Wa..Wd."""
    errors = speed.log_errors()
    return {
        "seas": list(SEAS),
        "linear_m_s": speed.linear_m_s.tolist(),
        "linear_wanted_m_s": list(WANTED_LINEAR_M_S),
        "angular_rad_s": speed.angular_rad_s.tolist(),
        "angular_wanted_rad_s": list(WANTED_ANGULAR_RAD_S),
        "worst_ratio": math.exp(abs(errors).max()),
        "rms_log_error": math.sqrt((errors**2).mean()),
    }


def lines(figures: dict) -> list[str]:
    """The table as text."""
    text = ["goal as seen from the arm's base | " + " | ".join(f"{s:>6}" for s in figures["seas"])]
    for label, here, wanted in (
        ("mean linear speed, m/s", "linear_m_s", "linear_wanted_m_s"),
        ("mean angular rate, rad/s", "angular_rad_s", "angular_wanted_rad_s"),
    ):
        ratio = [a / b for a, b in zip(figures[here], figures[wanted], strict=True)]
        for name, row in ((label, figures[here]), ("  paper", figures[wanted]), ("  ratio", ratio)):
            text.append(f"{name:<32} | " + " | ".join(f"{value:6.3f}" for value in row))
    text.append(
        f"worst cell: factor {figures['worst_ratio']:.3f}; "
        f"rms log error {figures['rms_log_error']:.3f}"
    )
    return text


def main(argv: list[str] | None = None) -> None:
    """Print the statistics of the chosen calibration; 8 hours of motion per sea state."""
    argv = list(sys.argv[1:] if argv is None else argv)
    config = command_line.parse(SeaConfig, argv, prog="sea")
    command_line.check_output("--json", config.json)
    figures = report(goal_speed(build_tables(list(SEAS.values()), "train")))
    print("\n".join(lines(figures)))
    if config.json:
        command_line.write_output("--json", config.json, json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    from mcx_jax.compute.startup import run_command

    run_command(main)
