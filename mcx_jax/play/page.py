"""The scene in the browser: the bodies of MuJoCo's model as viser nodes, and patches of water."""

import math
from typing import Any

import mujoco
import numpy as np
import trimesh
import viser

from mcx_jax.play.renderer import CLOSE_UP, Stage
from mcx_jax.play.scene import water_level_m

View = tuple[Any, Any]
"""A camera's position and what it looks at, page axes, m."""
APART_M = 1.9
"""From one controller's vessels to the other's, along -y."""
WATER_X_M, WATER_Y_M = (-1.75, 2.4), (-0.85, 0.85)
"""The patch of sea around two vessels, world frame."""
WATER_GRID = (56, 22)
WATER_RGB = (34, 98, 124)
DRAWN_GROUPS = 2
"""Highest geom group that MuJoCo draws by default."""
SEGMENTS = 28
"""Of everything round."""


class Tableau:
    """Two vessels, water, arm, goal and tool of one controller, under one node."""

    def __init__(self, server: viser.ViserServer, stage: Stage, root: str, place: int):
        """
        Args:
            root: name of the node, e.g. "/ik".
            place: 0 = at the back, 1 = in front of it.
        """
        y_m = -APART_M * place
        self._y_m_on_page = y_m
        self.root = server.scene.add_frame(root, show_axes=False, position=(0.0, y_m, 0.0))
        self._frames = {
            body: _add_body(server, stage.model, body, root)
            for body in range(stage.model.nbody)
            if stage.model.body(body).name != "world"
        }
        self._x_m, self._y_m = np.meshgrid(
            np.linspace(*WATER_X_M, WATER_GRID[0]), np.linspace(*WATER_Y_M, WATER_GRID[1])
        )
        self._water = server.scene.add_mesh_simple(
            f"{root}/water",
            vertices=self._water_vertices(np.full(self._x_m.shape, water_level_m(stage.model))),
            faces=_grid_faces(*self._x_m.shape),
            color=WATER_RGB,
            side="double",
            cast_shadow=False,
        )
        self.label = server.scene.add_label(
            f"{root}/label",
            "",
            # In front of the front vessels, not over those behind.
            position=(0.325, 0.0, 1.12) if place == 0 else (0.325, -0.95, -0.2),
            anchor="bottom-center" if place == 0 else "top-center",
            font_screen_scale=1.4,
        )

    def close_up(self, stage: Stage) -> View:
        """Where the film's close-up is seen from: the goal is in the middle."""
        distance_m, azimuth, elevation = CLOSE_UP[0], *map(math.radians, CLOSE_UP[1:])
        goal = stage.data.body("goal").xpos + (0.0, self._y_m_on_page, 0.0)
        level = math.cos(elevation)
        ahead = (level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation))
        return tuple(goal - distance_m * np.array(ahead)), tuple(goal)

    def place(self, stage: Stage) -> None:
        """Every body where the stage has it now."""
        for body, frame in self._frames.items():
            frame.position = stage.data.xpos[body]
            frame.wxyz = stage.data.xquat[body]

    def set_water(self, height_m: np.ndarray) -> None:
        """The surface at `points_m`, world frame."""
        self._water.vertices = self._water_vertices(height_m)

    @property
    def points_m(self) -> tuple[np.ndarray, np.ndarray]:
        """x and y of the water's points, world frame."""
        return self._x_m, self._y_m

    def _water_vertices(self, height_m: np.ndarray) -> np.ndarray:
        points = np.stack([self._x_m, self._y_m, height_m], axis=-1)
        return points.reshape(-1, 3).astype(np.float32)


def add_light(server: viser.ViserServer) -> None:
    """Sky and sun."""
    server.scene.set_up_direction("+z")
    server.scene.configure_default_lights(enabled=True, cast_shadow=False)
    sky = np.linspace((158, 190, 224), (228, 236, 242), 64)
    server.scene.set_background_image(np.repeat(sky[:, None], 4, axis=1).astype(np.uint8))


def _add_body(server: viser.ViserServer, model: mujoco.MjModel, body: int, root: str):
    """A frame for a body and, below it, one mesh for each of its materials."""
    name = f"{root}/{model.body(body).name.replace('/', '_')}"
    frame = server.scene.add_frame(name, show_axes=False)
    by_material: dict[int, list[trimesh.Trimesh]] = {}
    for geom in range(model.ngeom):
        drawn = model.geom_group[geom] <= DRAWN_GROUPS
        if model.geom_bodyid[geom] == body and drawn and (shape := _shape(model, geom)):
            by_material.setdefault(int(model.geom_matid[geom]), []).append(shape)
    for material, shapes in by_material.items():
        rgba = model.mat_rgba[material] if material >= 0 else np.array([0.7, 0.7, 0.7, 1.0])
        mesh: Any = trimesh.util.concatenate(shapes)
        server.scene.add_mesh_simple(
            f"{name}/{material}",
            vertices=np.asarray(mesh.vertices, np.float32),
            faces=np.asarray(mesh.faces),
            color=np.round(255 * rgba[:3]).astype(np.uint8),
            opacity=float(rgba[3]) if rgba[3] < 1 else None,
            flat_shading=True,
        )
    return frame


def _shape(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh | None:
    """A geom in the axes of its body; None for what has no simple shape (the sea, meshes)."""
    kinds, size = mujoco.mjtGeom, model.geom_size[geom]
    match model.geom_type[geom]:
        case kinds.mjGEOM_BOX:
            shape = trimesh.creation.box(2 * size)
        case kinds.mjGEOM_CYLINDER:
            shape = trimesh.creation.cylinder(size[0], 2 * size[1], sections=SEGMENTS)
        case kinds.mjGEOM_CAPSULE:
            shape = trimesh.creation.capsule(2 * size[1], size[0], count=(SEGMENTS, SEGMENTS))
            # The origin as MuJoCo has it, whichever end trimesh puts it at.
            shape.apply_translation(-shape.bounds.mean(axis=0))
        case kinds.mjGEOM_SPHERE:
            shape = trimesh.creation.icosphere(subdivisions=2, radius=size[0])
        case kinds.mjGEOM_ELLIPSOID:
            shape = trimesh.creation.icosphere(subdivisions=2)
            shape.apply_scale(size)
        case _:
            return None
    turn = np.eye(4)
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    turn[:3, :3], turn[:3, 3] = rotation.reshape(3, 3), model.geom_pos[geom]
    shape.apply_transform(turn)
    return shape


def _grid_faces(rows: int, columns: int) -> np.ndarray:
    """Triangles (2 (rows - 1) (columns - 1), 3) of a grid, counter-clockwise from above."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b = index[:-1, :-1].ravel(), index[:-1, 1:].ravel()
    c, d = index[1:, 1:].ravel(), index[1:, :-1].ravel()
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def overview(tableaux: int, *, phone: bool = False) -> View:
    """Where all vessels are seen from.

    Args:
        phone: in a tall window's upper half; viser's panel covers the lower one, and no message
            folds it.
    """
    middle_y_m = -APART_M * (tableaux - 1) / 2
    back, drop_m = (2.6, 2.2) if phone else (1.0, 0.0)
    target = (0.325, middle_y_m, 0.12 - drop_m)
    return tuple(np.add(target, back * np.array([-1.225, -4.0, 1.78]))), target


def look_at(server: viser.ViserServer, tableaux: int) -> None:
    """The camera that new visitors get."""
    server.initial_camera.position, server.initial_camera.look_at = overview(tableaux)
    server.initial_camera.fov = math.radians(42)


def aim(client: viser.ClientHandle, view: View) -> None:
    """Move a visitor's camera."""
    with client.atomic():
        client.camera.position = view[0]  # which takes its target along
        client.camera.look_at = view[1]
