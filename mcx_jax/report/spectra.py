"""Spectra of the vessels' motion: of the tables that the episodes use, and what they should be.

The target is the wave spectrum times the square of the vessel's response, at laboratory scale: a
frequency f there is the full-scale w sqrt(lambda) / 2 pi, lengths are divided by lambda.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mcx_jax.sea.hydro import VesselKnobs, load_hydro, motion_rao
from mcx_jax.sea.spectrum import jonswap, parse_sea, spreading_weights
from mcx_jax.sea.tables import FROUDE_LAMBDA, KNOT_DT_S

CHANNELS = ("surge x", "sway y", "heave z", "roll", "pitch", "yaw")
UNITS = ("mm", "mm", "mm", "mrad", "mrad", "mrad")
SEGMENT_KNOTS = 2048
"""205 s of laboratory time: 0.005 Hz, a quarter of the width of the narrowest peak."""


@dataclass(frozen=True)
class Spectrum:
    """One-sided spectra of the six motions of one sea, mm2/Hz and mrad2/Hz, laboratory scale."""

    sea: str
    frequency_hz: np.ndarray
    """(n,)."""
    measured: np.ndarray
    """(6, n) of the motion tables."""
    measured_std: np.ndarray
    """(6,) standard deviation of the motion, mm and mrad."""
    target_hz: np.ndarray
    """(m,); empty for a recording."""
    target: np.ndarray
    """(6, m)."""

    @property
    def target_std(self) -> np.ndarray:
        """(6,) standard deviation that the target stands for."""
        return np.sqrt(np.trapezoid(self.target, self.target_hz, axis=1))


def motion_spectra(knots: np.ndarray, seas: Sequence[str], generated: bool) -> list[Spectrum]:
    """Spectra of every sea.

    Args:
        knots: (tables, rows, 12) of `Motion`, ordered by sea.
        seas: their names.
        generated: by the generator; False for a recording, which has no target.
    """
    from scipy.signal import welch

    spectra = []
    for name, tables in zip(seas, np.split(knots, len(seas)), strict=True):
        motion = 1e3 * tables[..., :6].astype(np.float64)
        length = min(SEGMENT_KNOTS, motion.shape[1])
        hz, density = welch(motion, fs=1.0 / KNOT_DT_S, nperseg=length, axis=1)
        target_hz, target = target_spectrum(name) if generated else (np.empty(0), np.empty((6, 0)))
        std = np.sqrt(motion.var(axis=1).mean(axis=0))
        spectra.append(Spectrum(name, hz, density.mean(axis=0).T, std, target_hz, target))
    return spectra


def target_spectrum(sea_name: str) -> tuple[np.ndarray, np.ndarray]:
    """(frequency Hz (n,), (6, n) mm2/Hz and mrad2/Hz) of the generator's default vessel."""
    knobs, sea, solved = VesselKnobs(), parse_sea(sea_name), load_hydro().omega
    omega = np.linspace(solved[0], solved[-1], 2000)
    theta, weight = spreading_weights(knobs.spreading)
    power = np.zeros((6, len(omega)))
    for angle, share in zip(theta, weight, strict=True):
        rao = motion_rao(knobs, knobs.heading_deg + math.degrees(angle))
        fine = np.stack([np.interp(omega, solved, rao[:, dof]) for dof in range(6)])
        power += share * np.abs(fine) ** 2
    power *= jonswap(omega, sea, knobs.gamma)
    power[:3] /= FROUDE_LAMBDA**2
    hz_per_rad_s = math.sqrt(FROUDE_LAMBDA) / (2 * math.pi)
    return omega * hz_per_rad_s, 1e6 * power / hz_per_rad_s
