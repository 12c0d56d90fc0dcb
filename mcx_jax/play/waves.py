"""The surface that moves the vessels: the very components, with their phases, of the motion tables.

By default each vessel has its own window of the hour (the paper), and B's waves meet its own bow:
there is no one sea. So around each vessel its own waves are drawn, faded into each other between
them. `--coupled` has one wave field, drawn as it is. A recording has no known waves: calm water.
"""

import functools
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mcx_jax.config.task import MotionConfig
from mcx_jax.play.episode import Take
from mcx_jax.sea.hydro import VesselKnobs
from mcx_jax.sea.spectrum import GRAVITY_M_S2, parse_sea
from mcx_jax.sea.tables import (
    FROUDE_LAMBDA,
    KNOT_DT_S,
    SEPARATION_X_M,
    component_grid,
    paper_rows,
    table_seed,
    wave_amplitudes,
)

REACH_M = 16.0
"""Elevation is tabulated this far along the waves from vessel A's midship, laboratory metres."""
SPACING_M = 0.06
"""The shortest waves, 3.2 rad/s at full scale, are 0.6 m long in the laboratory."""
POINTS = 2 * round(REACH_M / SPACING_M) + 1
FAN = 0.8
"""The strip in which two wave fields fade widens by this, both ways, per metre off the vessels."""


@dataclass(frozen=True)
class Surface:
    """Elevation over time. Waves are long-crested, so one profile along their way is all of it."""

    profiles_m: np.ndarray
    """(fields, frames, points) elevation, laboratory metres; fields: A's, and B's if it differs."""
    heading_rad: float
    """Direction the waves run to, in the axes of the field's own vessel."""
    midship_x_m: float
    """Midship ahead of the deck origin, laboratory metres: where the phases are counted from."""
    note: str
    """One sentence for the viewer: what this sea is."""

    def elevation_m(self, frame: int, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        """Height of the surface over the mean water level at points of the world frame I.

        Args:
            frame: index of the instants that the surface was made for.
            x_m, y_m: of one shape, laboratory metres.
        """
        fields = [self._field(self.profiles_m[0, frame], x_m, y_m)]
        if len(self.profiles_m) == 1:
            return fields[0]
        # Vessel B's axes: turned by 180 deg about z.
        fields.append(self._field(self.profiles_m[1, frame], SEPARATION_X_M - x_m, -y_m))
        half_m = SEPARATION_X_M / 2 + FAN * np.abs(y_m)
        way = np.clip((x_m - SEPARATION_X_M / 2) / (2 * half_m) + 0.5, 0, 1)
        # Squares add to one: two independent waves keep their height where they are mixed.
        turn = math.pi / 2 * way**2 * (3 - 2 * way)
        return np.cos(turn) * fields[0] + np.sin(turn) * fields[1]

    def _field(self, profile_m: np.ndarray, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
        along_m = math.cos(self.heading_rad) * (x_m - self.midship_x_m)
        along_m = along_m + math.sin(self.heading_rad) * y_m
        return np.interp(along_m, np.linspace(-REACH_M, REACH_M, len(profile_m)), profile_m)


def surface(
    take: Take, motion: MotionConfig, time_s: np.ndarray, role: Literal["train", "test"] = "test"
) -> Surface:
    """The sea of an episode's motion at the instants to draw.

    Args:
        time_s: (frames,) since the episode's beginning.
        role: whose motion it is.
    """
    knobs = VesselKnobs()
    if motion.motion:
        note = "A recording holds no waves: the water is drawn calm."
        profiles_m = np.zeros((1, len(time_s), POINTS))
    else:
        sea = parse_sea(take.sea)
        coupled = motion.is_coupled(take.sea)
        one_hour = motion.split == "paper"
        seed = table_seed(sea, "train" if one_hour else role, int(take.poses[0].seed[0]))
        cut = (paper_rows(role).start or 0) * KNOT_DT_S if one_hour else 0.0
        starts_s = take.window_starts_s[:1] if coupled else take.window_starts_s
        (amplitudes,) = wave_amplitudes(sea, seed, knobs)  # one direction: long-crested
        profiles_m = np.stack([_profile(amplitudes, cut + start + time_s) for start in starts_s])
        note = (
            "Both vessels in the one wave field that is drawn."
            if coupled
            else "Each vessel rides its own window of the sea (as in the paper): the waves drawn "
            "around it are the ones that move it, faded into the other's in between."
        )
    return Surface(
        profiles_m=profiles_m,
        heading_rad=math.radians(knobs.heading_deg),
        midship_x_m=-knobs.base_x_m / FROUDE_LAMBDA,
        note=note,
    )


def _profile(amplitudes: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """Re sum a_k e^{i (k s - w t)}: (frames, POINTS) laboratory metres, from full-scale waves."""
    omega = component_grid()[1]
    full_s = math.sqrt(FROUDE_LAMBDA) * time_s
    in_time = amplitudes * np.exp(-1j * np.outer(full_s, omega))
    # The phases are exact by now; single precision is 1e-6 of a wave and twice as fast.
    total = in_time.astype(np.complex64) @ _in_space()
    return total.real / FROUDE_LAMBDA


@functools.cache
def _in_space() -> np.ndarray:
    """e^{i k s}: (n, POINTS) complex64. Kept: it takes a second, the rest of a frame 10 ms."""
    wavenumber = component_grid()[1] ** 2 / GRAVITY_M_S2
    along_m = np.linspace(-REACH_M, REACH_M, POINTS)
    return np.exp(1j * np.outer(wavenumber, FROUDE_LAMBDA * along_m)).astype(np.complex64)
