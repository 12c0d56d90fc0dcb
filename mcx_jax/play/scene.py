"""The scene for pictures and films: two vessels at sea, an arm on the first, a goal on the second.

Nothing here takes part in the simulation: vessels, goal and tool marker are mocap bodies and the
arm's joints are set, not integrated. Poses come from the simulator, pixels from `mcx_jax.play`.
"""

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from mcx_jax.arm.load import START_POSE_RAD
from mcx_jax.assets import asset_path

HULL_M = (0.24, -1.0, 0.35)
"""Outline of the hulls in `assets/scene.xml`, vessel axes: blunt end with its fender, middle of the
round end, half the beam."""
FREEBOARD_M = 0.08
"""The least that is drawn, at the deck: below the rub rails, and below what a mesh of 11 cm rounds
off."""
GIVE_WAY = 0.7
"""How steeply the water rises from there, m per m off the hull."""
REACH_POSE_RAD = (-0.271, -1.3039, 2.2268, -2.4937, -1.5708, -0.271)
"""Joint angles (6,) that put the tool on the goal of the scene's rest pose, for still pictures."""


def build_scene(arm: str | Path | None = None) -> mujoco.MjModel:
    """Compile `assets/scene.xml` with an arm on the deck of vessel A, in calm water.

    Names of the arm get the prefix "arm/": `model.joint("arm/elbow")`, `data.site("arm/tool")`;
    mocap bodies are `vessel_a`, `vessel_b`, `goal` and `tool`, cameras `hero` and `pair`.

    Args:
        arm: MJCF of the arm; its root is put at the deck origin of vessel A. Default: the paper's.
    """
    scene = mujoco.MjSpec.from_file(str(asset_path("scene.xml")))
    child = mujoco.MjSpec.from_file(str(arm or asset_path("ur10e_paper.xml")))
    # Nothing is integrated here, and options that differ would make `attach` warn.
    scene.option = child.option
    scene.attach(child, site=scene.site("mount"), prefix="arm/")
    sea = scene.hfield("sea")
    sea.userdata = np.zeros(sea.nrow * sea.ncol)
    ripples = scene.texture("ripples")
    ripples.nchannel = 3
    ripples.data = np.repeat(_ripples(ripples.width)[..., None], 3, axis=2).tobytes()
    model = scene.compile()
    set_sea(model, np.zeros(sea_points_m(model)[0].shape))
    return model


def sea_points_m(model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """x and y, (rows, columns) each, of the points of the sea's surface in the world, m."""
    sea = model.hfield("sea")
    x_half_m, y_half_m = sea.size[:2]
    x, y = np.meshgrid(
        np.linspace(-x_half_m, x_half_m, int(sea.ncol[0])),
        np.linspace(-y_half_m, y_half_m, int(sea.nrow[0])),
    )
    centre = model.geom("sea").pos
    return x + centre[0], y + centre[1]


def set_sea(model: mujoco.MjModel, elevation_m: np.ndarray) -> None:
    """Write the surface into the model; a renderer has to upload it (`mujoco.mjr_uploadHField`).

    Args:
        model: from `build_scene`; changed in place.
        elevation_m: height over the mean water level at `sea_points_m`. What the height field
            cannot hold, half its range (0.6 m) up or down, is cut off.
    """
    range_m = model.hfield("sea").size[2]
    model.hfield("sea").data[:] = np.clip(elevation_m / range_m + 0.5, 0, 1)


def water_level_m(model: mujoco.MjModel) -> float:
    """Height of the mean water level in the world frame, m."""
    return float(model.geom("sea").pos[2] + model.hfield("sea").size[2] / 2)


def below_decks_m(
    height_m: np.ndarray,
    x_m: np.ndarray,
    y_m: np.ndarray,
    decks: Sequence[tuple[np.ndarray, np.ndarray]],
) -> np.ndarray:
    """Height of the drawn water, m: lowered at the hulls, which are smaller than those whose motion
    it is and follow a steep wave less, so that no deck is awash.

    Args:
        height_m: of the surface in the world frame, at points (x_m, y_m), all of one shape.
        decks: position (3,) in m and rotation (3, 3) of each vessel in the world frame.
    """
    for position_m, rotation in decks:
        x, y = x_m - position_m[0], y_m - position_m[1]
        along_m = rotation[0, 0] * x + rotation[1, 0] * y
        across_m = rotation[0, 1] * x + rotation[1, 1] * y
        deck_m = position_m[2] - (rotation[0, 2] * x + rotation[1, 2] * y) / rotation[2, 2]
        off_m = _off_hull_m(along_m, across_m)
        height_m = np.minimum(height_m, deck_m - FREEBOARD_M + GIVE_WAY * off_m)
    return height_m


def _off_hull_m(along_m: np.ndarray, across_m: np.ndarray) -> np.ndarray:
    """Horizontal distance from the outline of a hull of `assets/scene.xml`; 0 inside."""
    blunt_m, middle_m, half_m = HULL_M
    beyond_m = np.maximum(along_m - blunt_m, 0)
    aft_m = np.minimum(along_m - middle_m, 0)  # the far end is round
    beside_m = np.hypot(aft_m, across_m) - half_m
    return np.hypot(beyond_m, np.maximum(beside_m, 0))


def pose_scene(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    q_rad: Sequence[float] | np.ndarray = START_POSE_RAD,
    tool_site: str = "tool",
    **poses: tuple[np.ndarray, np.ndarray],
) -> None:
    """Set joint angles and mocap poses and update everything that the renderer reads.

    Args:
        model: from `build_scene`.
        data: of that model; changed in place.
        q_rad: joint angles, in the order of the arm's file.
        tool_site: the arm's site that the marker of frame E is put on.
        **poses: for `vessel_a`, `vessel_b`, `goal`: position (3,) in m and quaternion (4,) wxyz,
            both in the world frame. A body left out stays where it is.
    """
    data.qpos[:] = q_rad
    for name, (position_m, quat_wxyz) in poses.items():
        index = model.body(name).mocapid[0]
        data.mocap_pos[index] = position_m
        data.mocap_quat[index] = quat_wxyz
    mujoco.mj_kinematics(model, data)
    marker, site = model.body("tool").mocapid[0], data.site(f"arm/{tool_site}")
    data.mocap_pos[marker] = site.xpos
    mujoco.mju_mat2Quat(data.mocap_quat[marker], site.xmat)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)


def _ripples(pixels: int) -> np.ndarray:
    """Grey pattern (pixels, pixels) uint8 that repeats without a seam: paint, not a sea state.

    The waves of the motion tables end at a length of 0.6 m; bare, the water between looks solid.
    """
    rng = np.random.default_rng(7)
    steps = 2 * np.pi * np.arange(pixels) / pixels
    pattern = np.zeros((pixels, pixels))
    for _ in range(90):
        across, along = rng.integers(-14, 15), rng.integers(3, 27)
        phase, weight = rng.uniform(0, 2 * np.pi), 1 / (1 + 0.04 * np.hypot(across, along))
        pattern += weight * np.sin(across * steps[:, None] + along * steps + phase)
    # Sharp crests, broad troughs.
    bright = np.exp(0.9 * pattern / pattern.std())
    return np.clip(178 + 32 * bright / bright.mean() ** 0.5, 0, 255).astype(np.uint8)
