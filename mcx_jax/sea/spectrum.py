"""Sea states and their wave spectra, at full scale (metres, seconds, rad/s).

Sources: JONSWAP with the two-parameter peakedness of SIMO's user manual (waves, "JONSWAP
two-parameter"), whose limits are those of DNV-RP-C205 section 3.5.5.5; the four sea states are the
paper's table 1 (Herland & Bach, AAAI 2023).
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from mcx_jax.config.task import COUPLED
from mcx_jax.errors import UserError

GRAVITY_M_S2 = 9.81

# A single deep-water wave breaks at a height of 1/7 of its length. A sea whose SIGNIFICANT height
# is that steep does not exist; it is refused. What lies between this and `steepest_hs_m` is
# simulated, with a line that says so: linear waves have no limit of their own, and a limit of
# statistics is no reason to take an experiment away.
_MAX_STEEPNESS = 1.0 / 7.0
# The vessel's response is known from 0.2 to 3.2 rad/s (periods 2 to 31 s): beyond these peak
# periods a good part of the waves would fall outside.
_TP_RANGE_S = (3.0, 20.0)


@dataclass(frozen=True)
class SeaState:
    """A stationary sea at full scale.

    Attributes:
        hs_m: significant wave height, four standard deviations of the surface, metres.
        tp_s: peak period, seconds.
        name: how it is called in tables.
    """

    hs_m: float
    tp_s: float
    name: str


SEAS = {
    "Wa": SeaState(1.0, 6.0, "Wa"),
    "Wb": SeaState(1.5, 8.0, "Wb"),
    "Wc": SeaState(2.0, 9.0, "Wc"),
    "Wd": SeaState(2.5, 10.0, "Wd"),
}
"""The paper's four sea states."""


def parse_sea(text: str) -> SeaState:
    """Sea state from a name or a literal.

    Args:
        text: "Wa" .. "Wd", or "Hs:Tp" in metres and seconds at full scale, e.g. "3.0:11"; an ending
            "-coupled" stays in the name and is the same sea.

    Raises:
        UserError: neither, or no sea that water can carry (Hs of 1/7 of the wave length at Tp).
    """
    sea = text.removesuffix(COUPLED)
    if sea in SEAS:
        return replace(SEAS[sea], name=text)
    valid = f"use {', '.join(SEAS)} or Hs:Tp in metres and seconds at full scale, e.g. 3.0:11"
    parts = sea.split(":")
    try:
        hs_m, tp_s = (float(part) for part in parts)
    except ValueError:
        raise UserError(f"unknown sea state {text!r}: {valid}") from None
    low_s, high_s = _TP_RANGE_S
    if not (hs_m > 0 and low_s <= tp_s <= high_s):
        raise UserError(
            f"sea state {text!r}: Hs must be positive and Tp {low_s:g} to {high_s:g} s; {valid}"
        )
    steepest_m = _MAX_STEEPNESS * peak_length_m(tp_s)
    if hs_m > steepest_m:
        raise UserError(
            f"sea state {text!r}: waves of {tp_s:g} s break above Hs {steepest_m:.1f} m; "
            f"lower Hs or lengthen Tp"
        )
    return SeaState(hs_m, tp_s, text)


def peak_length_m(tp_s: float) -> float:
    """Length of a deep-water wave of the peak period, metres."""
    return GRAVITY_M_S2 * tp_s**2 / (2 * math.pi)


def steepest_hs_m(tp_s: float) -> float:
    """The highest Hs of a sea state by DNV-RP-C205 (section 3.5.4), metres: 1/15 of the wave length
    at Tp up to 8 s, 1/25 from 15 s on, the steepness linear between."""
    return float(np.interp(tp_s, [8.0, 15.0], [1.0 / 15.0, 1.0 / 25.0])) * peak_length_m(tp_s)


def two_parameter_gamma(hs_m: float, tp_s: float) -> float:
    """Peakedness gamma as SIMO sets it from Hs and Tp; 1 (Pierson-Moskowitz) for Wa..Wd."""
    ratio = tp_s / math.sqrt(hs_m)
    if ratio <= 3.6:
        return 5.0
    if ratio >= 5.0:
        return 1.0
    return math.exp(5.75 - 1.15 * ratio)


def _shape(x: np.ndarray, gamma: float) -> np.ndarray:
    """JONSWAP over the frequency ratio x = w / w_p, without its constant."""
    width = np.where(x <= 1.0, 0.07, 0.09)
    peak = gamma ** np.exp(-((x - 1.0) ** 2) / (2.0 * width**2))
    return x**-5.0 * np.exp(-1.25 * x**-4.0) * peak


def jonswap(omega_rad_s: np.ndarray, sea: SeaState, gamma: float | None = None) -> np.ndarray:
    """Wave spectrum, one-sided: its integral over all frequencies is Hs^2 / 16.

    Args:
        omega_rad_s: (n,) positive angular frequencies, full scale.
        sea: the sea state.
        gamma: peakedness; None = SIMO's two-parameter rule.

    Returns:
        (n,) S in m2 s.
    """
    gamma = two_parameter_gamma(sea.hs_m, sea.tp_s) if gamma is None else gamma
    peak_rad_s = 2.0 * math.pi / sea.tp_s
    # Area by quadrature over 0.3..20 peak frequencies (1e-5 of the area lies beyond); SIMO's
    # closed form 1 - 0.287 ln(gamma) is a fit good to 1 %.
    grid = np.linspace(0.3, 20.0, 4001)
    area = np.trapezoid(_shape(grid, gamma), grid)
    scale = sea.hs_m**2 / 16.0 / (area * peak_rad_s)
    return scale * _shape(np.asarray(omega_rad_s) / peak_rad_s, gamma)


def spreading_weights(
    exponent: float | None, directions: int = 25
) -> tuple[np.ndarray, np.ndarray]:
    """Directions and their shares of the wave energy, D(theta) ~ cos^n(theta) on +-90 degrees.

    Args:
        exponent: n; None = long-crested, a single direction.
        directions: number of directions, symmetric about the mean.

    Returns:
        theta_rad (d,) relative to the mean direction and weight (d,), which sum to 1.
    """
    if exponent is None:
        return np.zeros(1), np.ones(1)
    # Midpoints of equal sectors: +-90 degrees themselves carry no energy.
    theta = (np.arange(directions) + 0.5) / directions * math.pi - math.pi / 2.0
    weight = np.cos(theta) ** exponent
    return theta, weight / weight.sum()
