"""Motion tables: one hour of vessel motion per (sea state, seed), at laboratory scale.

An inverse FFT sums all harmonic components at once (deterministic amplitudes, uniform phases, as
SIMO does), so an hour costs milliseconds and needs no per-environment state: an episode is a table
number and a start. Everything stored here is scaled by Froude's law: lengths / 10, time / sqrt(10),
angles and accelerations unchanged. Sampling: `mcx_jax.envs.sampler`.
"""

import functools
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mcx_jax.config.delay import PHYSICS_DT_S
from mcx_jax.sea.hydro import VesselKnobs, load_hydro, motion_rao
from mcx_jax.sea.spectrum import GRAVITY_M_S2, SeaState, jonswap, spreading_weights, steepest_hs_m

FROUDE_LAMBDA = 10.0
KNOT_DT_S = 0.1  # laboratory time; at this spacing cubic Hermite errs by < 3e-6 m, 5e-6 rad
KNOT_STEPS = round(KNOT_DT_S / PHYSICS_DT_S)  # 50 physics steps per knot interval
TABLE_S = 3600.0  # laboratory time, 3.2 h at sea: the usual 3 h sea state
TABLE_KNOTS = round(TABLE_S / KNOT_DT_S)
TRAIN_SEEDS = 8
TEST_SEEDS = 1
# At the border of a train and a test part. The motion forgets itself within 10 to 15 s: the
# envelope of its autocorrelation is 0.28 to 0.50 after 6 s, 0.10 to 0.23 after 10 s, 0.01 to 0.02
# after 20 s (heave and roll, Wa and Wd).
SPLIT_GAP_S = 20.0
# Rest position of vessel B's deck origin seen from vessel A's, laboratory metres (authors' code).
SEPARATION_X_M = 0.65

Role = Literal["train", "test"]


@dataclass(frozen=True)
class MotionTables:
    """Motion of a deck origin about its rest pose, for the sampler.

    Attributes:
        knots: (tables, rows, 12) float32, one row per 0.1 s: x, y, z in m, roll, pitch, yaw in rad,
            then their time derivatives. R = Rz(yaw) Ry(pitch) Rx(roll). Row i + 1 exists for
            every knot interval i; the last row of a whole synthetic hour repeats its first.
        companion: the same shape for vessel B at the same instants in the same waves, or None if
            the vessels take independent windows of `knots`. Its x, y are along the world axes
            (vessel A's), not along B's turned ones, because that is how the environment adds them.
        sea_index: (tables,) int32, which of `sea_names` a table belongs to.
        sea_names: names of the sea states, in the order given.
    """

    knots: np.ndarray
    companion: np.ndarray | None
    sea_index: np.ndarray
    sea_names: tuple[str, ...]

    @property
    def duration_s(self) -> float:
        """Length of one table, laboratory seconds."""
        return (self.knots.shape[1] - 1) * KNOT_DT_S


def table_seed(sea: SeaState, role: Role, index: int) -> int:
    """Seed of a table: a hash, so that no two (sea, role, index) share phases."""
    text = f"{sea.hs_m:.6g}:{sea.tp_s:.6g}/{role}/{index}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little")


def uniform_phases(seed: int, count: int) -> np.ndarray:
    """`count` phases in [0, 2 pi): raw PCG64 output, the part of numpy's streams that is fixed."""
    raw = np.random.PCG64(seed).random_raw(count)
    return 2.0 * math.pi * ((raw >> np.uint64(11)) * 2.0**-53)


@functools.lru_cache(maxsize=1)
def component_grid() -> tuple[np.ndarray, np.ndarray]:
    """FFT bins within the solved band and their full-scale frequencies, (n,) each, n = 5,436."""
    omega = load_hydro().omega
    step = 2.0 * math.pi / (TABLE_S * math.sqrt(FROUDE_LAMBDA))
    bins = np.arange(math.ceil(omega[0] / step), math.floor(omega[-1] / step) + 1)
    return bins, bins * step


def _on_grid(rao: np.ndarray) -> np.ndarray:
    """(w, 6) response of the asset's frequencies -> (6, n) on the component grid.

    Known limitation: the response is interpolated, not the coefficients it is solved from, and the
    asset's steps of 0.05 rad/s cut the peak of roll, which is hardly wider. Interpolating added
    mass, damping and force instead raises, at the default heading of 170 deg, roll by 4.0 % (Wa) to
    2.3 % (Wd), sway by 2.4 to 0.7 % and nothing else by more than 0.3 % (standard deviations). The
    mean errors of `ik` (B4_4, 50 episodes) grow by 0.05 to 0.18 % in position, by 0.5 to 0.9 % in
    orientation. In beam seas roll matters more. Kept, as every stored result is of these tables.
    """
    omega, grid = load_hydro().omega, component_grid()[1]
    return np.stack([np.interp(grid, omega, rao[:, dof]) for dof in range(6)])


@functools.lru_cache(maxsize=8)
def _responses(knobs: VesselKnobs, companion: bool) -> np.ndarray:
    """Response to a wave whose phase is counted at vessel A's midship, per direction: (d, 6, n)."""
    theta, _ = spreading_weights(knobs.spreading)
    headings_deg = knobs.heading_deg + np.degrees(theta)
    if not companion:
        return np.stack([_on_grid(motion_rao(knobs, b)) for b in headings_deg])
    # B is turned by 180 deg: it meets the waves at b - 180, and its own x, y point backwards in
    # world axes. Its midship lies at: base of A + separation, then back by its own base point.
    midship_x_m = FROUDE_LAMBDA * SEPARATION_X_M + 2.0 * knobs.base_x_m
    wavenumber = component_grid()[1] ** 2 / GRAVITY_M_S2
    to_world = np.array([-1.0, -1.0, 1.0, 1.0, 1.0, 1.0])[:, None]
    responses = []
    for heading_deg in headings_deg:
        delay = np.exp(1j * wavenumber * midship_x_m * math.cos(math.radians(heading_deg)))
        turned = _on_grid(motion_rao(knobs, heading_deg - 180.0))
        responses.append(to_world * turned * delay)
    return np.stack(responses)


def wave_amplitudes(sea: SeaState, seed: int, knobs: VesselKnobs) -> np.ndarray:
    """Complex amplitudes of the wave components at vessel A's midship: (directions, n), metres."""
    omega = component_grid()[1]
    _, weight = spreading_weights(knobs.spreading)
    energy = 2.0 * jonswap(omega, sea, knobs.gamma) * (omega[1] - omega[0])
    phase = uniform_phases(seed, len(weight) * len(omega)).reshape(len(weight), len(omega))
    return np.sqrt(weight[:, None] * energy) * np.exp(1j * phase)


def inverse_fft(components: np.ndarray) -> np.ndarray:
    """Sum Re(X_k e^{-i w_k t}) and its time derivative at the knots of one hour.

    Args:
        components: (channels, n) complex, full-scale amplitudes on the component grid.

    Returns:
        (channels, TABLE_KNOTS) values and derivatives per LABORATORY second; lengths not scaled.
    """
    bins, omega = component_grid()
    channels = len(components)
    rate = -1j * omega * math.sqrt(FROUDE_LAMBDA)
    spectrum = np.zeros((2 * channels, TABLE_KNOTS // 2 + 1), complex)
    # irfft sums with e^{+iwt} and weight 2/N: hence the conjugate and N/2.
    spectrum[:channels, bins] = np.conj(components) * (TABLE_KNOTS / 2)
    spectrum[channels:, bins] = np.conj(components * rate) * (TABLE_KNOTS / 2)
    return np.fft.irfft(spectrum, n=TABLE_KNOTS, axis=1)


def synthesise(sea: SeaState, seed: int, knobs: VesselKnobs, companion: bool = False) -> np.ndarray:
    """One hour of motion: (TABLE_KNOTS + 1, 12) float32, periodic, columns of `MotionTables`."""
    waves = wave_amplitudes(sea, seed, knobs)
    motion = np.einsum("dn,dcn->cn", waves, _responses(knobs, companion))
    motion[:3] /= FROUDE_LAMBDA
    table = np.empty((TABLE_KNOTS + 1, 12), np.float32)
    table[:-1] = inverse_fft(motion).T
    table[-1] = table[0]
    return table


def realised_hs_m(sea: SeaState, knobs: VesselKnobs) -> float:
    """Hs of the waves that the vessel's response is known for (2 to 31 s), metres."""
    omega = component_grid()[1]
    return 4.0 * math.sqrt(jonswap(omega, sea, knobs.gamma).sum() * (omega[1] - omega[0]))


def doubts(sea: SeaState, coupled: bool) -> list[str]:
    """What a user should know of a sea state before relying on its results, a line each."""
    said, steepest_m = [], steepest_hs_m(sea.tp_s)
    if sea.hs_m > steepest_m:
        said.append(
            f"sea {sea.name}: steeper than seas get: at Tp {sea.tp_s:g} s DNV-RP-C205 has Hs up to "
            f"{steepest_m:.1f} m; it is simulated all the same, with linear waves"
        )
    lost = 1.0 - realised_hs_m(sea, VesselKnobs()) / sea.hs_m
    if lost > 0.01:
        said.append(
            f"sea {sea.name}: Hs is {100 * lost:.1f} % low, as waves shorter than 2 s are left out"
        )
    if coupled:
        said.append(
            f"sea {sea.name}, coupled: not a floating arrangement: the midships of the two 25 m "
            "hulls are 1.5 m apart, one inside the other, and move up and down nearly as one; no "
            "result for vessels side by side"
        )
    return said


def build_tables(
    seas: Sequence[SeaState],
    role: Role,
    knobs: VesselKnobs | None = None,
    *,
    coupled: Sequence[bool] = (),
    split: Literal["seeds", "paper"] = "seeds",
    seeds_per_sea: int | None = None,
) -> MotionTables:
    """All tables of a role, sea by sea (table = sea * seeds + seed).

    Args:
        seas: sea states.
        role: "train" or "test"; their waves never share a seed, or an instant.
        knobs: the vessel; None = the calibrated defaults.
        coupled: of each sea: give vessel B the same waves instead of an independent window (none
            given: in no sea). No floating arrangement: the arm's base and vessel B's deck origin,
            each 4 m aft of midships, are 6.5 m apart, so the midships are 1.5 m apart and one hull
            is inside the other. Each vessel answers as if alone: no shelter, no interaction.
        split: "seeds": 8 hours per sea to train on and another one to test on. "paper": one hour,
            the first 2/3 trains, the last 1/3 tests, 20 s cut at both borders of the test part.
        seeds_per_sea: other than the usual number of hours (split "seeds" only).
    """
    knobs = VesselKnobs() if knobs is None else knobs
    if split == "paper":
        count, seed_role, rows = 1, "train", paper_rows(role)
    else:
        count = seeds_per_sea or (TRAIN_SEEDS if role == "train" else TEST_SEEDS)
        seed_role, rows = role, slice(None)
    plan = [(sea, table_seed(sea, seed_role, k)) for sea in seas for k in range(count)]
    companion = None
    knots = np.stack([synthesise(sea, seed, knobs)[rows] for sea, seed in plan])
    if any(coupled):
        own = [
            synthesise(*p, knobs, True)[rows] if coupled[k // count] else knots[k]
            for k, p in enumerate(plan)
        ]
        companion = np.stack(own)
    return MotionTables(
        knots=knots,
        companion=companion,
        sea_index=np.repeat(np.arange(len(seas), dtype=np.int32), count),
        sea_names=tuple(sea.name for sea in seas),
    )


def paper_rows(role: Role) -> slice:
    """Rows of the hour that the paper's split gives to a role."""
    border, gap = TABLE_KNOTS * 2 // 3, round(SPLIT_GAP_S / KNOT_DT_S)
    if role == "train":
        return slice(0, border + 1)
    # The hour is periodic: its end meets the training part's start, so a gap there as well.
    return slice(border + gap, TABLE_KNOTS - gap + 1)
