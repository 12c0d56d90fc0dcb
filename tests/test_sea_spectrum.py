"""Sea states, spectra and the vessel's response."""

import dataclasses
import hashlib
import math
import pathlib

import numpy as np
import pytest

from mcx_jax.assets import asset_path
from mcx_jax.errors import UserError
from mcx_jax.sea.hydro import VesselKnobs, force_at, load_hydro, motion_rao
from mcx_jax.sea.spectrum import (
    SEAS,
    SeaState,
    jonswap,
    parse_sea,
    spreading_weights,
    steepest_hs_m,
    two_parameter_gamma,
)
from mcx_jax.sea.tables import doubts

VALID = "use Wa, Wb, Wc, Wd or Hs:Tp in metres and seconds at full scale, e.g. 3.0:11"
# The response of section 5's checks: head seas, motion of midship at the waterline.
PANEL_ONLY = VesselKnobs(relative_damping=0.0, base_x_m=0.0, base_z_m=0.0)


@pytest.mark.parametrize("gamma", [None, 1.0, 2.5, 3.3])
@pytest.mark.parametrize("sea", SEAS.values(), ids=SEAS)
def test_area_of_the_spectrum_is_hs_squared_over_16(sea, gamma):
    omega = np.geomspace(0.05, 60.0, 20_000)
    hs_m = 4 * math.sqrt(np.trapezoid(jonswap(omega, sea, gamma), omega))
    assert hs_m == pytest.approx(sea.hs_m, rel=1e-3)  # quadrature of both sides: 2e-4


def test_pierson_moskowitz_at_its_peak_by_hand():
    # Hs 2, Tp 2 pi: w_p = 1, S(1) = 5/16 * Hs^2 * e^-1.25 = 1.25 * 0.2865048 = 0.3581310
    peak = jonswap(np.array([1.0]), SeaState(2.0, 2 * math.pi, "x"), gamma=1.0)
    assert peak[0] == pytest.approx(0.3581310, rel=1e-4)  # quadrature of the area


def test_peakedness_rule():
    assert [two_parameter_gamma(s.hs_m, s.tp_s) for s in SEAS.values()] == [1.0] * 4
    assert two_parameter_gamma(4.0, 7.0) == 5.0  # Tp / sqrt Hs = 3.5
    assert two_parameter_gamma(4.0, 8.0) == pytest.approx(math.exp(1.15))  # 5.75 - 1.15 * 4


def test_spreading_shares():
    theta, weight = spreading_weights(2.0)
    assert weight.sum() == pytest.approx(1.0)
    assert weight @ np.sin(theta) == pytest.approx(0.0, abs=1e-12)
    # mean of cos^2 under cos^2: (3 pi / 8) / (pi / 2) = 3/4; 25 midpoints are exact for it
    assert weight @ np.cos(theta) ** 2 == pytest.approx(0.75, rel=1e-9)
    assert spreading_weights(None)[1].tolist() == [1.0]


def test_parse_names_and_literals():
    assert parse_sea("Wc") == SeaState(2.0, 9.0, "Wc")
    assert parse_sea("3.0:11") == SeaState(3.0, 11.0, "3.0:11")
    assert parse_sea("Wc-coupled") == SeaState(2.0, 9.0, "Wc-coupled")
    assert parse_sea("3.0:11-coupled") == SeaState(3.0, 11.0, "3.0:11-coupled")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("We", f"unknown sea state 'We': {VALID}"),
        ("3", f"unknown sea state '3': {VALID}"),
        ("3:x", f"unknown sea state '3:x': {VALID}"),
        ("1:2:3", f"unknown sea state '1:2:3': {VALID}"),
        ("-1:8", f"sea state '-1:8': Hs must be positive and Tp 3 to 20 s; {VALID}"),
        ("nan:8", f"sea state 'nan:8': Hs must be positive and Tp 3 to 20 s; {VALID}"),
        ("1:60", f"sea state '1:60': Hs must be positive and Tp 3 to 20 s; {VALID}"),
        # 9.81 * 16 / 2 pi / 7 = 3.57
        ("5:4", "sea state '5:4': waves of 4 s break above Hs 3.6 m; lower Hs or lengthen Tp"),
    ],
)
def test_parse_refuses(text, message):
    with pytest.raises(UserError) as error:
        parse_sea(text)
    assert str(error.value) == message


def test_the_steepest_sea_is_dnvs():
    # Hs / (g Tp^2 / 2 pi) = 1/15 up to 8 s, 1/25 from 15 s on; 11.5 s is halfway: 0.8/15.
    length_m = lambda tp_s: 9.81 * tp_s**2 / (2 * np.pi)  # noqa: E731
    for tp_s, steepness in ((5.0, 1 / 15), (8.0, 1 / 15), (11.5, 0.8 / 15), (15.0, 1 / 25)):
        assert steepest_hs_m(tp_s) == pytest.approx(steepness * length_m(tp_s))


@pytest.mark.parametrize(
    ("sea", "coupled", "lines"),
    [
        ("Wa", False, []),
        ("Wd", False, []),
        ("3.7:6", False, []),
        (
            "3.8:6",
            False,
            ["sea 3.8:6: steeper than seas get: at Tp 6 s DNV-RP-C205 has Hs up to 3.7 m"],
        ),
        # 7.9 % at 3 s, 1.1 % at 5 s, 0.5 % at 6 s: measured with wavespectra and with this band
        ("0.5:3", False, ["sea 0.5:3: Hs is 7.9 % low, as waves shorter than 2 s are left out"]),
        ("1:5", False, ["sea 1:5: Hs is 1.1 % low"]),
        ("3.5:4", False, ["steeper than seas get", "Hs is 2.6 % low"]),
        ("Wd-coupled", True, ["sea Wd-coupled, coupled: not a floating arrangement"]),
    ],
)
def test_what_is_doubtful_of_a_sea_is_said(sea, coupled, lines):
    said = doubts(parse_sea(sea), coupled)
    assert len(said) == len(lines), said
    assert all(want in line for want, line in zip(lines, said, strict=True)), said


def test_missing_asset_is_a_user_error():
    with pytest.raises(UserError, match="asset 'no_such_file' is missing"):
        asset_path("no_such_file")


def test_long_waves_carry_the_vessel_along():
    # k = w^2 / g; at 0.2 rad/s the hull is 1/60 of a wave length: heave 1, pitch = slope. 5 %: the
    # surge, 18 % large from its 80 s mooring, drags a centre of gravity 1 m over the water.
    rao = motion_rao(VesselKnobs(base_x_m=0.0, base_z_m=0.0), 180.0)[0]
    assert abs(rao[2]) == pytest.approx(1.0, rel=0.01)
    assert abs(rao[4]) == pytest.approx(0.2**2 / 9.81, rel=0.05)
    # Crest amidships, waves running aft: half a period later the bow is down, -i k cos(180) = i k.
    assert rao[4] / abs(rao[4]) == pytest.approx(1j, abs=0.02)
    # Orbital motion: at the crest the water, and the vessel, moves with the waves (aft), so
    # x = Re(X e^-iwt) with -iw X < 0: X = -i, times 1.18 for the 80 s mooring,
    # whose 10 % damping turns it by 5 deg.
    assert rao[0] == pytest.approx(-1.18j, abs=0.12)


@pytest.mark.parametrize(
    ("knobs", "heave", "pitch"),
    [
        (PANEL_ONLY, (0.93, 0.84, 0.69, 0.52), (0.95, 0.89, 0.81, 0.66)),
        (
            dataclasses.replace(PANEL_ONLY, relative_damping=0.35),
            (0.86, 0.69, 0.46, 0.22),
            (0.86, 0.72, 0.53, 0.33),
        ),
    ],
)
def test_head_sea_response_as_in_an_independent_solution(knobs, heave, pitch):
    # An earlier prototype's separately meshed hull; 0.03: two meshes differ by .02, rounding .005.
    omega = load_hydro().omega
    rows = [int(np.argmin(abs(omega - w))) for w in (0.8, 1.0, 1.2, 1.4)]
    rao = motion_rao(knobs, 180.0)[rows]
    np.testing.assert_allclose(abs(rao[:, 2]), heave, atol=0.03)
    np.testing.assert_allclose(abs(rao[:, 4]) / (omega[rows] ** 2 / 9.81), pitch, atol=0.03)


def test_port_and_starboard_mirror():
    port, starboard = motion_rao(VesselKnobs(), 130.0), motion_rao(VesselKnobs(), -130.0)
    np.testing.assert_allclose(starboard, port * [1, -1, 1, -1, 1, -1], atol=1e-12)
    head = motion_rao(VesselKnobs(), 180.0)
    assert abs(head[:, [1, 3, 5]]).max() < 1e-10  # solver noise of a symmetric hull


def test_force_between_headings():
    hydro = load_hydro()
    np.testing.assert_allclose(force_at(hydro, 170.0), hydro.force[:, 17], rtol=1e-9, atol=1e-6)
    # Leave out every other heading; the rest must predict them. 0.3 % of the largest force up to
    # 1.6 rad/s, where 18 directions still carry the order k L / 2 = 3.3.
    coarse = dataclasses.replace(
        hydro, force=hydro.force[:, ::2], heading_deg=hydro.heading_deg[::2]
    )
    low = hydro.omega < 1.6
    error = abs(force_at(coarse, 130.0) - hydro.force[:, 13])[low]
    assert (error / abs(hydro.force[low]).max(axis=1)).max() < 3e-3


def test_arm_base_above_the_origin_moves_with_pitch_and_roll():
    low, high = PANEL_ONLY, dataclasses.replace(PANEL_ONLY, base_x_m=-4.0, base_z_m=5.0)
    at_origin, at_base = motion_rao(low, 150.0), motion_rao(high, 150.0)
    roll, pitch, yaw = at_origin[:, 3:].T
    # w x r for r = (-4, 0, 5)
    shift = np.stack([5 * pitch, -4 * yaw - 5 * roll, 4 * pitch], axis=1)
    np.testing.assert_allclose(at_base[:, :3], at_origin[:, :3] + shift, atol=1e-12)


def test_radiation_damping_is_the_energy_of_the_waves():
    # Haskind: B_jj = k / (8 pi rho g Vg) int |F_j|^2 d heading; 6 %: panel size, 10 deg trapezoid.
    hydro = load_hydro()
    rho, g = hydro.meta["rho_kg_m3"], hydro.meta["gravity_m_s2"]
    rows = (hydro.omega > 0.39) & (hydro.omega < 2.01)
    omega = hydro.omega[rows]
    integral = 2 * np.trapezoid(abs(hydro.force[rows]) ** 2, np.radians(hydro.heading_deg), axis=1)
    factor = (omega**2 / g) / (8 * np.pi * rho * g * g / (2 * omega))
    damping = np.diagonal(hydro.damping[rows], axis1=1, axis2=2)
    np.testing.assert_allclose(damping / (factor[:, None] * integral), 1.0, atol=0.06)


def test_asset_was_made_by_the_committed_scripts():
    root = pathlib.Path(__file__).parents[1]
    for name, digest in load_hydro().meta["scripts_sha256"].items():
        assert hashlib.sha256((root / name).read_bytes()).hexdigest() == digest, name
