"""Parametric hull of a 25.5 x 12 m workboat as quadrilateral panels (numpy only).

NOT the real vessel: only length and beam are published for a boat of the class meant by the paper
(AQS Loke, 25.5 x 12 m); draught and form are guesses for such a boat. Axes: x forward, y to port,
z up, origin amidships on the waterline; lengths in metres, full scale.
"""

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Hull:
    """Form and weight; every value but `length_m` and `beam_m` is a guess."""

    length_m: float = 25.5  # on the waterline
    beam_m: float = 12.0
    draught_m: float = 3.0
    section_exponent_mid: float = 2.6  # superellipse |y/b|^n + |z/t|^n = 1 from stern to midship
    section_exponent_bow: float = 2.2  # at the stem, linear in between
    bow_exponent: float = 2.3  # waterline from midship forward: superellipse of this exponent
    transom_width: float = 0.85  # part of the beam; parabolic narrowing from midship
    stern_rise: float = 0.8  # part of the draught, power 1.5 from `stern_rise_from`
    stern_rise_from: float = -0.2  # part of L/2
    bow_rise: float = 0.5  # parabolic from `bow_rise_from`
    bow_rise_from: float = 0.45
    centre_of_gravity_z_m: float = 1.0  # above the waterline; LCG = LCB
    gyration_roll: float = 0.38  # part of the beam
    gyration_pitch: float = 0.24  # part of the length
    gyration_yaw: float = 0.26  # part of the length


def half_beam_m(hull: Hull, xi: np.ndarray) -> np.ndarray:
    """Half-breadth of the waterline at xi = 2x/L in [-1, 1]."""
    fore = np.clip(1 - np.clip(xi, 0, 1) ** hull.bow_exponent, 0, 1) ** (1 / hull.bow_exponent)
    aft = 1 - (1 - hull.transom_width) * np.clip(-xi, 0, 1) ** 2
    return hull.beam_m / 2 * np.where(xi > 0, fore, aft)


def section_draught_m(hull: Hull, xi: np.ndarray) -> np.ndarray:
    """Depth of the keel line below the waterline at xi."""
    aft = np.clip((hull.stern_rise_from - xi) / (1 + hull.stern_rise_from), 0, 1)
    fore = np.clip((xi - hull.bow_rise_from) / (1 - hull.bow_rise_from), 0, 1)
    return hull.draught_m * (1 - hull.stern_rise * aft**1.5 - hull.bow_rise * fore**2)


def _section_points(hull: Hull, xi: np.ndarray, girth: int) -> np.ndarray:
    """Port half of every station from waterline to keel: (stations, girth + 1, 3)."""
    slope = hull.section_exponent_bow - hull.section_exponent_mid
    exponent = (hull.section_exponent_mid + slope * np.clip(xi, 0, 1))[:, None]
    # Angles in the superellipse's own parameter, eased so that panels stay even around the bilge.
    angle = np.linspace(0, np.pi / 2, girth + 1)[None, :]
    y = half_beam_m(hull, xi)[:, None] * np.cos(angle) ** (2 / exponent)
    z = -section_draught_m(hull, xi)[:, None] * np.sin(angle) ** (2 / exponent)
    x = np.broadcast_to(hull.length_m / 2 * xi[:, None], y.shape)
    points = np.stack([x, y, z], axis=-1)
    points[:, 0, 2] = 0.0
    points[:, -1, 1] = 0.0
    return points


def _grid_panels(points: np.ndarray) -> np.ndarray:
    """Quads of a (rows, columns, 3) grid of points: (panels, 4, 3)."""
    a, b = points[:-1, :-1], points[1:, :-1]
    c, d = points[1:, 1:], points[:-1, 1:]
    return np.stack([a, b, c, d], axis=2).reshape(-1, 4, 3)


def _oriented(panels: np.ndarray, inside_m: tuple[float, float, float]) -> np.ndarray:
    """Panels turned so that their normals point away from an inner point (the hull is convex)."""
    normal = np.cross(panels[:, 2] - panels[:, 0], panels[:, 3] - panels[:, 1])
    outward = np.einsum("pi,pi->p", normal, panels.mean(axis=1) - np.asarray(inside_m)) > 0
    return np.where(outward[:, None, None], panels, panels[:, ::-1])


def port_panels(hull: Hull, stations: int = 36, girth: int = 9) -> np.ndarray:
    """Wetted port half with its share of the transom: (panels, 4, 3), normals into the water."""
    # Denser towards the blunt bow, where the waterline turns quickly.
    xi = np.concatenate(
        [
            np.linspace(-1, 0, stations // 2 + 1)[:-1],
            np.sin(np.linspace(0, np.pi / 2, stations // 2 + 1)),
        ]
    )
    shell_points = _section_points(hull, xi, girth)
    columns = np.linspace(0, 1, 4)[:, None, None]
    transom = shell_points[0] * np.where(np.arange(3) == 1, columns, 1.0)
    panels = np.concatenate([_grid_panels(shell_points), _grid_panels(transom)])
    panels = panels[_areas(panels) > 1e-6]
    return _oriented(panels, (0.0, 0.0, -0.3 * hull.draught_m))


def port_lid_panels(hull: Hull, stations: int = 36, across: int = 5) -> np.ndarray:
    """Port half of the waterplane, normals down: the lid that suppresses irregular frequencies."""
    xi = np.concatenate(
        [
            np.linspace(-1, 0, stations // 2 + 1)[:-1],
            np.sin(np.linspace(0, np.pi / 2, stations // 2 + 1)),
        ]
    )
    y = half_beam_m(hull, xi)[:, None] * np.linspace(0, 1, across + 1)[None, :]
    x = np.broadcast_to(hull.length_m / 2 * xi[:, None], y.shape)
    panels = _grid_panels(np.stack([x, y, np.zeros_like(y)], axis=-1))
    panels = panels[_areas(panels) > 1e-6]
    return _oriented(panels, (0.0, 0.0, hull.length_m))


def _areas(panels: np.ndarray) -> np.ndarray:
    cross = np.cross(panels[:, 2] - panels[:, 0], panels[:, 3] - panels[:, 1])
    return 0.5 * np.linalg.norm(cross, axis=1)


def mass_matrix(hull: Hull, mass_kg: float, centre_x_m: float) -> np.ndarray:
    """Rigid-body inertia about the origin amidships on the waterline: (6, 6), kg, kg m, kg m2."""
    centre = np.array([centre_x_m, 0.0, hull.centre_of_gravity_z_m])
    radii = np.array(
        [
            hull.gyration_roll * hull.beam_m,
            hull.gyration_pitch * hull.length_m,
            hull.gyration_yaw * hull.length_m,
        ]
    )
    x, y, z = centre
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    inertia = mass_kg * (np.diag(radii**2) - cross @ cross)
    return np.block([[mass_kg * np.eye(3), -mass_kg * cross], [mass_kg * cross, inertia]])
