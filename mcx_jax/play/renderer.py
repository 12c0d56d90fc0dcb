"""An episode put on the stage: the scene's model posed at an instant, and MuJoCo's pixels of it."""

import math
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

from mcx_jax.arm.model import ARMS
from mcx_jax.assets import asset_path
from mcx_jax.config.task import EnvConfig
from mcx_jax.play import gl
from mcx_jax.play.episode import Poses
from mcx_jax.play.scene import (
    below_decks_m,
    build_scene,
    pose_scene,
    sea_points_m,
    set_sea,
    water_level_m,
)
from mcx_jax.play.waves import Surface

CLOSE_UP = (0.24, 75.0, 12.0)
"""The close-up's camera about the goal: distance m, azimuth and elevation deg. From below, since
the flange hides the tool's point from above."""
FILM_QUALITY = {"shadowsize": 1024, "offsamples": 0, "numslices": 20, "numstacks": 6}
FILM_OVERSIZE = 1.5
"""Films are drawn so many times larger and reduced, which smooths edges for less than four samples
a pixel: without a GPU a panel takes 0.11 s of one core, with those and MuJoCo's 28 slices and 16
stacks of everything round 0.29 s."""


class Stage:
    """The scene with one arm; `place` puts it where an episode says."""

    def __init__(self, env: EnvConfig):
        arm = asset_path(ARMS[env.arm]) if env.arm in ARMS else Path(env.arm)
        self.model = build_scene(arm)
        self.data = mujoco.MjData(self.model)
        self.tool_site = env.tool_site
        self._sea_points_m = sea_points_m(self.model)
        self._level_m = water_level_m(self.model)

    def place(self, poses: Poses, step: int) -> None:
        """Vessels, goal, arm and tool marker at the end of a control step, 0 = the first."""
        pose_scene(
            self.model,
            self.data,
            poses.q_rad[step],
            self.tool_site,
            vessel_a=(poses.a_m[step], quaternion(poses.a_rotation[step])),
            vessel_b=(poses.b_m[step], quaternion(poses.b_rotation[step])),
            goal=(poses.goal_m[step], quaternion(poses.goal_rotation[step])),
        )

    def set_sea(self, surface: Surface, frame: int, poses: Poses, step: int) -> None:
        """The sea at one of the surface's instants, which is this control step."""
        height_m = self.water_m(surface, frame, poses, step, *self._sea_points_m)
        set_sea(self.model, height_m - self._level_m)

    def water_m(
        self,
        surface: Surface,
        frame: int,
        poses: Poses,
        step: int,
        x_m: np.ndarray,
        y_m: np.ndarray,
    ) -> np.ndarray:
        """Height of the drawn water in the world frame at points of one shape, m."""
        decks = [
            (poses.a_m[step], poses.a_rotation[step]),
            (poses.b_m[step], poses.b_rotation[step]),
        ]
        height_m = self._level_m + surface.elevation_m(frame, x_m, y_m)
        return below_decks_m(height_m, x_m, y_m, decks)


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """(4,) wxyz of a rotation matrix (3, 3)."""
    wxyz = np.zeros(4)
    mujoco.mju_mat2Quat(wxyz, np.asarray(rotation, float).ravel())
    return wxyz


def _px_per_m(height_px: int, fovy_deg: float, away_m: float) -> float:
    return height_px / (2 * away_m * math.tan(math.radians(fovy_deg) / 2))


class Painter:
    """Pixels of a stage. Use as a context, or `close` it."""

    def __init__(self, stage: Stage, width_px: int, height_px: int, *, fine: bool = False):
        """Args: the largest picture that will be asked for; fine = the scene file's quality."""
        model = stage.model
        self._oversize = 1.0 if fine else FILM_OVERSIZE
        width_px, height_px = self._drawn_px(width_px), self._drawn_px(height_px)
        for name, value in {} if fine else FILM_QUALITY.items():
            setattr(model.vis.quality, name, value)
        model.vis.global_.offwidth, model.vis.global_.offheight = width_px, height_px
        self.stage = stage
        self._gl = gl.context(width_px, height_px)
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._scene = mujoco.MjvScene(model, maxgeom=1000)
        self._option = mujoco.MjvOption()

    def __enter__(self) -> "Painter":
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def close(self) -> None:
        """Give the context back."""
        self._gl.make_current()
        self._context.free()
        self._gl.free()

    def upload_sea(self) -> None:
        """Tell the renderer that the stage's sea has changed."""
        self._gl.make_current()
        mujoco.mjr_uploadHField(self.stage.model, self._context, self.stage.model.hfield("sea").id)

    def wide(self, width_px: int, height_px: int, camera: str) -> np.ndarray:
        """(height, width, 3) uint8 through one of the scene's cameras."""
        view = mujoco.MjvCamera()
        view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        view.fixedcamid = self.stage.model.camera(camera).id
        return self._draw(view, width_px, height_px)

    def wide_px_per_m(self, height_px: int, camera: str) -> float:
        """Pixels to a metre across at the goal's distance."""
        seen = self.stage.data.camera(camera)
        away = seen.xmat.reshape(3, 3)[:, 2] @ (seen.xpos - self.stage.data.body("goal").xpos)
        return _px_per_m(height_px, float(self.stage.model.camera(camera).fovy[0]), float(away))

    def close_up_px_per_m(self, size_px: int) -> float:
        """Pixels to a metre across at the goal."""
        return _px_per_m(size_px, float(self.stage.model.vis.global_.fovy), CLOSE_UP[0])

    def close_up(self, size_px: int) -> np.ndarray:
        """(size, size, 3) uint8: the goal in the middle."""
        view = mujoco.MjvCamera()
        view.lookat = self.stage.data.body("goal").xpos
        view.distance, view.azimuth, view.elevation = CLOSE_UP
        # The arm's own shadow covers most of it, and a shadow costs as much again as the rest.
        return self._draw(view, size_px, size_px, shadow=False)

    def _draw(
        self, view: mujoco.MjvCamera, width_px: int, height_px: int, *, shadow: bool = True
    ) -> np.ndarray:
        self._gl.make_current()  # another painter may have drawn in between
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW.value] = shadow
        every = mujoco.mjtCatBit.mjCAT_ALL.value
        model, data = self.stage.model, self.stage.data
        mujoco.mjv_updateScene(model, data, self._option, None, view, every, self._scene)
        width, height = self._drawn_px(width_px), self._drawn_px(height_px)
        rect = mujoco.MjrRect(0, 0, width, height)
        pixels = np.empty((height, width, 3), np.uint8)
        mujoco.mjr_render(rect, self._scene, self._context)
        mujoco.mjr_readPixels(pixels, None, rect, self._context)
        drawn = Image.fromarray(pixels[::-1])
        return np.asarray(drawn.resize((width_px, height_px), Image.Resampling.BOX))

    def _drawn_px(self, size_px: int) -> int:
        return round(size_px * self._oversize)
