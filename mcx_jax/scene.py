"""The scene for pictures and films: two vessels at sea, an arm on the first, a goal on the second.

Nothing here takes part in the simulation: the vessels and the goal are mocap bodies and the arm's
joints are set, not integrated. Poses come from the simulator, pixels from `mujoco.Renderer`.
"""

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from mcx_jax.assets import asset_path

START_POSE_RAD = (-0.1, -1.0, 2.4, -2.9, -1.5, 0.0)
"""Joint angles (6,) from which the first inverse kinematics starts (the authors' code)."""

REACH_POSE_RAD = (-0.271, -1.3039, 2.2268, -2.4937, -1.5708, -0.271)
"""Joint angles (6,) that put the tool on the goal of the scene's rest pose, for still pictures."""

SEA_COMPONENTS = (
    (2.9, 0.25, 0.26),
    (1.9, -0.45, 0.22),
    (1.1, 0.9, 0.16),
    (0.8, 2.0, 0.12),
    (0.55, 0.5, 0.09),
    (0.42, -0.9, 0.07),
)
"""Decoration, not a sea state: (length m, direction rad, weight) of the drawn surface's waves."""


def build_scene(arm: str | Path | None = None) -> mujoco.MjModel:
    """Compile `assets/scene.xml` with an arm on the deck of vessel A.

    Names of the arm get the prefix "arm/": `model.joint("arm/elbow")`, `data.site("arm/tool")`;
    mocap bodies are `vessel_a`, `vessel_b` and `goal`, cameras `hero` and `side`.

    Args:
        arm: MJCF of the arm; its root is put at the deck origin of vessel A. Default: the paper's.
    """
    scene = mujoco.MjSpec.from_file(str(asset_path("scene.xml")))
    child = mujoco.MjSpec.from_file(str(arm or asset_path("ur10e_paper.xml")))
    # Nothing is integrated here, and options that differ would make `attach` warn.
    scene.option = child.option
    scene.attach(child, site=scene.site("mount"), prefix="arm/")
    sea = scene.hfield("sea")
    sea.userdata = _drawn_sea(sea.nrow, sea.ncol, 2 * sea.size[0]).ravel()
    return scene.compile()


def pose_scene(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    q_rad: Sequence[float] | np.ndarray = START_POSE_RAD,
    **poses: tuple[np.ndarray, np.ndarray],
) -> None:
    """Set joint angles and mocap poses and update everything that the renderer reads.

    Args:
        model: from `build_scene`.
        data: of that model; changed in place.
        q_rad: joint angles, in the order of the arm's file.
        **poses: for `vessel_a`, `vessel_b`, `goal`: position (3,) in m and quaternion (4,) wxyz,
            both in the world frame. A body left out stays where it is.
    """
    data.qpos[:] = q_rad
    for name, (position_m, quat_wxyz) in poses.items():
        index = model.body(name).mocapid[0]
        data.mocap_pos[index] = position_m
        data.mocap_quat[index] = quat_wxyz
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)


def _drawn_sea(rows: int, columns: int, width_m: float) -> np.ndarray:
    """Surface elevation (rows, columns) of the drawn sea; MuJoCo scales it to 0..1."""
    y, x = np.meshgrid(
        np.linspace(-width_m / 2, width_m / 2, rows),
        np.linspace(-width_m / 2, width_m / 2, columns),
        indexing="ij",
    )
    elevation = np.zeros((rows, columns))
    for phase, (length_m, direction_rad, weight) in enumerate(SEA_COMPONENTS):
        along = x * np.cos(direction_rad) + y * np.sin(direction_rad)
        elevation += weight * np.sin(2 * np.pi * along / length_m + 1.7 * phase)
    return elevation
