"""Colours: told apart by everyone, read on their paper, the same in page, film, report and plot."""

import itertools
import re

import numpy as np
import pytest

from mcx_jax import palette

DISTINCT = (*palette.CONTROLLERS, *palette.POLICIES)
# Machado, Oliveira & Fernandes 2009, severity 1.0, on linear RGB.
SIGHT = {
    "all cones": np.eye(3),
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanopia": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}
# sRGB to XYZ, D65.
XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750]]
    + [[0.0193339, 0.1191920, 0.9503041]]
)
LEAST = 15.0
"""CIE76 distance of any two curves: a just noticeable difference is 2.3, thin lines and small
letters need several times that (the palette before had 5 for a deuteranope)."""


def linear(colour):
    """(3,) linear RGB of "#rrggbb"."""
    c = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def lab(rgb):
    """(3,) CIE L*a*b* of linear RGB."""
    t = XYZ @ np.clip(rgb, 0, 1) / XYZ.sum(axis=1)
    f = np.where(t > 216 / 24389, np.cbrt(t), (24389 / 27 * t + 16) / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def distance(a, b, sight):
    seen = [lab(np.asarray(SIGHT[sight]) @ linear(colour)) for colour in (a, b)]
    return float(np.linalg.norm(seen[0] - seen[1]))


def contrast(a, b):
    """Of WCAG 2."""
    low, high = sorted(float(XYZ[1] @ linear(colour)) for colour in (a, b))
    return (high + 0.05) / (low + 0.05)


def test_the_yardsticks():
    assert contrast("#ffffff", "#000000") == pytest.approx(21, abs=1e-3)
    assert lab(linear("#ffffff")) == pytest.approx([100, 0, 0], abs=0.01)
    assert lab(linear("#ff0000")) == pytest.approx([53.24, 80.09, 67.20], abs=0.05)
    # Red and green of one brightness, which dichromats confuse.
    assert distance("#c03020", "#6a7000", "all cones") > 60
    assert distance("#c03020", "#6a7000", "deuteranopia") < 20


@pytest.mark.parametrize("paper", [0, 1], ids=["light", "dark"])
@pytest.mark.parametrize("sight", SIGHT)
def test_any_two_controllers_are_told_apart(sight, paper):
    for a, b in itertools.combinations((*DISTINCT, "goal"), 2):
        apart = distance(palette.COLOURS[a][paper], palette.COLOURS[b][paper], sight)
        assert apart > LEAST, (a, b, apart)


@pytest.mark.parametrize("paper", [0, 1], ids=["light", "dark"])
def test_seas_go_one_way_from_the_paper(paper):
    seas = [palette.COLOURS[f"sea-{k}"][paper] for k in (1, 2, 3, 4)]
    from_paper = [contrast(sea, palette.COLOURS["paper"][paper]) for sea in seas]
    assert from_paper == sorted(from_paper)
    for sight, (a, b) in itertools.product(SIGHT, itertools.pairwise(seas)):
        assert distance(a, b, sight) > 0.7 * LEAST, (a, b)  # neighbours lie in order as well


@pytest.mark.parametrize("paper", [0, 1], ids=["light", "dark"])
def test_letters_are_read_on_their_paper(paper):
    for name, pair in palette.COLOURS.items():
        # WCAG AA: 4.5 for letters, 3 for what is drawn.
        least = {"paper": 1, "soft": 1, "grid": 1, "goal": 3}.get(name, 4.5)
        assert contrast(pair[paper], palette.COLOURS["paper"][paper]) >= least, name
    for name in ("ink", "muted"):
        assert contrast(palette.COLOURS[name][paper], palette.COLOURS["soft"][paper]) >= 4.5


def test_names_have_their_colour_and_policies_their_own():
    found = palette.controllers(["ik", "a", "fir", "b", "c", "d", "e", "f"])
    assert found["ik"] == palette.LIGHT["ik"] and found["fir"] == palette.LIGHT["fir"]
    assert found["a"] == palette.LIGHT["policy"]
    assert len(set(found.values())) == 8
    many = palette.controllers([f"run {k}" for k in range(30)])
    assert set(many.values()) <= set(palette.LIGHT.values())


def test_no_module_has_colours_of_its_own(repo_root):
    for path in (repo_root / "mcx_jax").rglob("*.py"):
        found = re.findall(r'"#[0-9a-fA-F]{6}"', path.read_text(encoding="utf-8"))
        assert not found or path.name == "palette.py", (path, found)
