"""How the defaults of `VesselKnobs` were found: `python experiments/calibrate_sea.py`.

Prints linear-theory ratios to the paper's eight means (linear Wa..Wd | angular Wa..Wd) around the
defaults, then the best sets of a grid of round values. 20 s on one core.
"""

import argparse
import dataclasses
import itertools

import numpy as np

from mcx_jax.sea.hydro import VesselKnobs
from mcx_jax.sea.spectrum import SEAS
from mcx_jax.sea.statistics import linear_goal_speed

# Where the search began (long-crested, SIMO's gamma rule, base amidships).
START = {"roll_damping": 0.15, "base_x_m": 0.0, "base_z_m": 3.0, "gamma": None}

ALONE = {
    "heading_deg": (180.0, 175.0, 165.0, 160.0, 90.0, 0.0),
    "relative_damping": (0.0, 0.2, 0.3, 0.45),
    "roll_damping": (0.05, 0.10, 0.15),
    "base_x_m": (-6.0, -2.0, 0.0, 4.0),
    "base_z_m": (0.0, 3.0, 4.0, 6.0),
    "gamma": (None, 1.5, 2.0, 3.3),
    "spreading": (64.0, 16.0, 4.0),
}

GRID = {
    "heading_deg": (168.0, 170.0, 172.0, 175.0),
    "relative_damping": (0.25, 0.3, 0.35),
    "roll_damping": (0.05, 0.08, 0.1, 0.15),
    "base_x_m": (-4.0, -2.0, 0.0),
    "base_z_m": (3.0, 4.0, 5.0, 6.0),
    "gamma": (1.0, 2.0, 2.5, 3.3),
}


def log_errors(knobs: VesselKnobs) -> np.ndarray:
    """(2, 4) ln(here / paper)."""
    return linear_goal_speed(list(SEAS.values()), knobs, samples=3000).log_errors()


def line(label: str, errors: np.ndarray) -> str:
    """Ratios, rms and worst cell in one line."""
    linear, angular = ("  ".join(f"{r:5.3f}" for r in row) for row in np.exp(errors))
    rms, worst = np.sqrt((errors**2).mean()), np.exp(np.abs(errors).max())
    return f"{label:<42} {linear} | {angular}   rms {rms:.4f}  worst x{worst:.3f}"


def main() -> None:
    """Print the candidates."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--best", type=int, default=15, help="how many sets of the grid to print")
    args = parser.parse_args()
    default = VesselKnobs()
    print(line("start", log_errors(dataclasses.replace(default, **START))))
    print(line("default", log_errors(default)))
    for name, values in ALONE.items():
        for value in values:
            knobs = dataclasses.replace(default, **{name: value})
            print(line(f"default, {name} = {value}", log_errors(knobs)))
    sets = [dict(zip(GRID, values, strict=True)) for values in itertools.product(*GRID.values())]
    found = [(log_errors(dataclasses.replace(default, **chosen)), chosen) for chosen in sets]
    found.sort(key=lambda item: float((item[0] ** 2).mean()))
    print("grid: " + ", ".join(GRID))
    for errors, chosen in found[: args.best]:
        print(line(", ".join(f"{value:g}" for value in chosen.values()), errors))


if __name__ == "__main__":
    main()
