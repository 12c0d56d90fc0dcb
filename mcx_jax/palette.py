"""The colours of page, film, report and plots: a controller has the same one everywhere.

Each is a pair, for light and for dark paper. Letters are drawn in them (4.5 : 1 against the paper),
and any two of the controllers can be told apart without red or green cones (tests/test_palette.py).
"""

from collections.abc import Sequence
from itertools import cycle

COLOURS = {
    "ink": ("#1f2328", "#e6e9ed"),
    "muted": ("#5f6670", "#9aa4b0"),
    "grid": ("#e3e6ea", "#2c333b"),
    "paper": ("#ffffff", "#14181d"),
    "soft": ("#f5f7f9", "#1d232a"),
    "goal": ("#8b929b", "#656d78"),
    "ik": ("#c2500a", "#ff9145"),
    "extrapolate": ("#7212d0", "#e7d0fa"),
    "extrapolate-best": ("#a13081", "#d868c0"),
    "fir": ("#215b42", "#b3edd2"),
    "preview": ("#433602", "#f9db29"),
    "policy": ("#0b6fc4", "#4ca6f5"),
    "policy-2": ("#100747", "#7073fa"),
    "policy-3": ("#260308", "#ff5060"),
    "sea-1": ("#2a78b5", "#5790bd"),
    "sea-2": ("#1d5888", "#80b1da"),
    "sea-3": ("#12395c", "#afd0ec"),
    "sea-4": ("#081c33", "#e6f1fa"),
}
"""(on light, on dark paper) by name."""
LIGHT = {name: pair[0] for name, pair in COLOURS.items()}

CONTROLLERS = ("ik", "extrapolate", "extrapolate-best", "fir", "preview")
POLICIES = ("policy", "policy-2", "policy-3")
SEAS = tuple(LIGHT[f"sea-{k}"] for k in (1, 2, 3, 4))
"""Calm to rough, away from the paper's: the order shows without colour as well."""
ENGINES = {"chain": "policy", "c-batch": "ik", "c-rollout": "preview", "mjx": "extrapolate-best"}
"""Of `bench`: whose colour each engine has there."""


def controllers(labels: Sequence[str]) -> dict[str, str]:
    """A colour on light paper for each controller: of a known name its own; of policies the first
    free ones, from the beginning again where they end."""
    others = [name for name in CONTROLLERS if name not in labels]
    free = cycle([*POLICIES, *others])
    return {label: LIGHT[label if label in CONTROLLERS else next(free)] for label in labels}
