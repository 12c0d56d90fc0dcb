"""Make `assets/vessel_hydro.npz`: the linear hydrodynamics of the parametric hull of `hull.py`.

Runs once, on a desk; the package reads only the result. Needs Capytaine 3.0.0 (Apache-2.0) in an
environment of its own:

    python -m venv hydro && hydro/bin/pip install capytaine==3.0.0
    hydro/bin/python tools/hydro/solve.py --out assets/vessel_hydro.npz

Conventions: x forward, y to port, z up, origin amidships on the waterline; e^{-iwt}; heading = the
direction the waves run TO (180 deg = head sea); unit wave amplitude; infinite depth; full scale SI.
The file holds the hydrodynamics only. Damping, heading and the other choices that turn it into
motion are `VesselKnobs` of `mcx_jax/sea/hydro.py`.

Checks, printed and stored in the file's meta (702 hull and 360 lid panels, 37 s on one core):
- the energy (Haskind) relation of damping and wave force holds within 5.4 % in all six motions from
  0.4 to 2 rad/s, with a 10 deg trapezoid;
- head seas at 0.8, 1.0, 1.2, 1.4 rad/s, heave .93 .84 .68 .50 m/m and pitch over wave slope
  .95 .88 .79 .64: within .024 of an earlier, separately meshed model of the same hull
  (.93 .84 .69 .52 and .95 .89 .81 .66); at 0.2 rad/s 1.00 and .98, in the limit 1 and 1.
"""

import argparse
import datetime
import hashlib
import json
import pathlib
import time

import capytaine as cpt
import numpy as np
import xarray as xr
from hull import Hull, mass_matrix, port_lid_panels, port_panels

RHO = 1025.0  # kg/m3, sea water
GRAVITY = 9.81  # m/s2
OMEGA = np.concatenate([np.arange(0.20, 2.001, 0.05), np.arange(2.1, 3.201, 0.1)])  # rad/s
HEADING_DEG = np.arange(0.0, 181.0, 10.0)  # port/starboard symmetry gives the other half
DOFS = ["Surge", "Sway", "Heave", "Roll", "Pitch", "Yaw"]


def _mirrored(panels: np.ndarray, name: str) -> cpt.ReflectionSymmetricMesh:
    half = cpt.Mesh.from_list_of_faces(panels.tolist(), name=name)
    return cpt.ReflectionSymmetricMesh(half, plane="xOz", name=name)


def build_body(hull: Hull, stations: int, girth: int, across: int) -> cpt.FloatingBody:
    """Hull and lid as one rigid body whose motions refer to the origin."""
    body = cpt.FloatingBody(
        mesh=_mirrored(port_panels(hull, stations, girth), "hull"),
        lid_mesh=_mirrored(port_lid_panels(hull, stations, across), "lid"),
        dofs=cpt.rigid_body_dofs(rotation_center=(0.0, 0.0, 0.0)),
        name="vessel",
    )
    return body


def hydrostatics(hull: Hull, body: cpt.FloatingBody) -> tuple[np.ndarray, np.ndarray, dict]:
    """Mass and stiffness about the origin (6, 6), and the numbers a naval architect looks at."""
    volume = float(body.volume)
    buoyancy = np.asarray(body.center_of_buoyancy, float)
    mass_kg = RHO * volume
    body.center_of_mass = np.array([buoyancy[0], 0.0, hull.centre_of_gravity_z_m])
    body.mass = mass_kg
    raw = body.compute_hydrostatic_stiffness(rho=RHO, g=GRAVITY)
    stiffness = np.asarray(raw.sel(influenced_dof=DOFS, radiating_dof=DOFS).values, float)
    figures = {
        "volume_m3": volume,
        "mass_kg": mass_kg,
        "block_coefficient": volume / (hull.length_m * hull.beam_m * hull.draught_m),
        "waterplane_coefficient": float(body.waterplane_area) / (hull.length_m * hull.beam_m),
        "centre_of_buoyancy_x_m": float(buoyancy[0]),
        "gm_transverse_m": float(stiffness[3, 3] / (mass_kg * GRAVITY)),
        "gm_longitudinal_m": float(stiffness[4, 4] / (mass_kg * GRAVITY)),
    }
    return mass_matrix(hull, mass_kg, float(buoyancy[0])), stiffness, figures


def solve(body: cpt.FloatingBody) -> dict[str, np.ndarray]:
    """Added mass, radiation damping (w, 6, 6) and wave force per metre (w, heading, 6)."""
    problems = xr.Dataset(
        coords={
            "omega": OMEGA,
            "wave_direction": np.radians(HEADING_DEG),
            "radiating_dof": DOFS,
            "water_depth": [np.inf],
            "rho": [RHO],
            "g": [GRAVITY],
        }
    )
    result = cpt.BEMSolver().fill_dataset(problems, body)
    order = {"influenced_dof": DOFS}
    square = {**order, "radiating_dof": DOFS}
    axes = ("omega", "influenced_dof", "radiating_dof")
    force = result["excitation_force"].sel(order).squeeze()
    return {
        "A": result["added_mass"].sel(square).squeeze().transpose(*axes).values,
        "B": result["radiation_damping"].sel(square).squeeze().transpose(*axes).values,
        "F": force.transpose("omega", "wave_direction", "influenced_dof").values,
    }


def symmetric(data: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], float]:
    """Without the rounding noise that couples symmetric to antisymmetric motion; and its size.

    The hull is its own mirror image, so surge, heave, pitch and sway, roll, yaw do not mix, and
    waves from right ahead or astern push only the former. Capytaine meets this to single precision.

    Returns:
        the cleaned arrays, and the largest entry removed relative to the dof's own scale.
    """
    odd = np.array([False, True, False, True, False, True])
    mixed = odd[:, None] ^ odd[None, :]
    size = np.sqrt(np.abs(np.diagonal(data["M"] + data["A"], axis1=1, axis2=2)).max(axis=0))
    noise = max(
        float((np.abs(data[key]) / np.outer(size, size))[..., mixed].max())
        for key in ("A", "B", "M")
    )
    clean = {key: np.where(mixed, 0.0, data[key]) for key in ("A", "B", "M", "C")}
    clean["F"] = data["F"].copy()
    for end in (0, -1):
        clean["F"][:, end, odd] = 0.0
    return clean, noise


def haskind_ratio(data: dict[str, np.ndarray]) -> np.ndarray:
    """B_jj / (k / (8 pi rho g Vg) int |F_j|^2 d heading): (w, 6), 1 for an exact solution.

    Surge, heave and pitch are even in the heading, sway, roll and yaw odd; |F|^2 is even for all,
    so twice the trapezoid over 0..180 deg is the whole circle.
    """
    wavenumber = OMEGA**2 / GRAVITY
    group_speed = GRAVITY / (2 * OMEGA)
    integral = 2 * np.trapezoid(np.abs(data["F"]) ** 2, np.radians(HEADING_DEG), axis=1)
    energy = wavenumber / (8 * np.pi * RHO * GRAVITY * group_speed)
    return np.diagonal(data["B"], axis1=1, axis2=2) / (energy[:, None] * integral)


def head_sea_rao(data: dict[str, np.ndarray]) -> np.ndarray:
    """Heave (m/m) and pitch over wave slope in head seas, panel method only: (w, 2)."""
    omega = OMEGA[:, None, None]
    impedance = -(omega**2) * (data["M"] + data["A"]) - 1j * omega * data["B"] + data["C"]
    # Surge, sway and yaw have no stiffness; a 1e-3 share of heave's keeps the systems solvable.
    impedance = impedance + np.diag([1, 1, 0, 0, 0, 0]) * 1e-3 * data["C"][2, 2]
    impedance = impedance + np.diag([0, 0, 0, 0, 0, 1]) * 1e-3 * data["C"][4, 4]
    motion = np.linalg.solve(impedance, data["F"][:, -1, :, None])[..., 0]
    return np.stack([np.abs(motion[:, 2]), np.abs(motion[:, 4]) / (OMEGA**2 / GRAVITY)], axis=1)


def main() -> None:
    """Solve, check, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=pathlib.Path, required=True, help="npz file to write")
    parser.add_argument("--stations", type=int, default=36, help="panels along the hull")
    parser.add_argument("--girth", type=int, default=9, help="panels from waterline to keel")
    parser.add_argument("--across", type=int, default=5, help="lid panels per half beam")
    args = parser.parse_args()

    hull, started = Hull(), time.time()
    body = build_body(hull, args.stations, args.girth, args.across)
    mass, stiffness, figures = hydrostatics(hull, body)
    data = {**solve(body), "M": mass, "C": stiffness}
    # Capytaine skips a failed problem with a warning and leaves NaN.
    if not all(np.isfinite(array).all() for array in data.values()):
        raise SystemExit("some problems were not solved: see Capytaine's warnings above")
    data, noise = symmetric(data)
    seconds = time.time() - started
    haskind = haskind_ratio(data)[(OMEGA > 0.39) & (OMEGA < 2.01)]
    raos = {
        f"{w:.1f}": head_sea_rao(data)[np.argmin(abs(OMEGA - w))].round(3).tolist()
        for w in (0.2, 0.8, 1.0, 1.2, 1.4)
    }
    here = pathlib.Path(__file__).parent
    meta = {
        "what": "linear hydrodynamics of a parametric workboat hull; parametric, not the real hull",
        "hull": vars(hull),
        "hydrostatics": figures,
        "rho_kg_m3": RHO,
        "gravity_m_s2": GRAVITY,
        "water_depth": "infinite",
        "axes": "x forward, y port, z up; origin amidships on the waterline; moments about it",
        "time_convention": "exp(-i w t); heading_deg = direction the waves run to, 180 = head sea",
        "units": "SI, full scale: A kg, kg m, kg m2; B the same per s; F N/m, N m/m; C N/m, N m",
        "solver": f"Capytaine {cpt.__version__} (Apache-2.0), numpy {np.__version__}",
        "panels": {
            "hull": body.mesh.nb_faces,
            "lid": body.mesh_including_lid.nb_faces - body.mesh.nb_faces,
        },
        "seconds": round(seconds, 1),
        "scripts_sha256": {
            f"tools/hydro/{name}": hashlib.sha256((here / name).read_bytes()).hexdigest()
            for name in ("hull.py", "solve.py")
        },
        "date": datetime.date.today().isoformat(),
        "licence": "made for this repository, under the repository's licence",
        "knobs": "not here: damping, heading, base point are VesselKnobs in mcx_jax/sea/hydro.py",
        "port_starboard_noise_removed": noise,
        "check_haskind_ratio_0.4_to_2_rad_s": {
            dof: [round(float(haskind[:, j].min()), 3), round(float(haskind[:, j].max()), 3)]
            for j, dof in enumerate(DOFS)
        },
        "check_head_sea_heave_and_pitch_over_slope": raos,
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        args.out, omega=OMEGA, heading_deg=HEADING_DEG, **data, meta=json.dumps(meta)
    )
    print(json.dumps(meta, indent=1))
    print(f"wrote {args.out}, {args.out.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
