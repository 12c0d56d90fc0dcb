"""Pictures of environments while they are stepped: what `render` of the Gymnasium ones returns."""

from typing import Any, Literal

import jax
import numpy as np

from mcx_jax.config.delay import CONTROL_DT_S
from mcx_jax.config.task import MotionConfig
from mcx_jax.envs.state import EnvState
from mcx_jax.envs.v2v import V2VEnv
from mcx_jax.play.episode import Poses, Take, name_delay, poses_now
from mcx_jax.play.picture import INK, panel
from mcx_jax.play.renderer import Painter, Stage
from mcx_jax.play.waves import surface

SIZE_PX = (640, 360)
"""Even, as video encoders want it."""


@jax.jit
def _poses(env: V2VEnv, state: EnvState) -> Poses:
    """Axis 0 = environment."""
    return jax.vmap(poses_now, in_axes=(None, -1))(env, state)


class Live:
    """One renderer for all environments of a task."""

    def __init__(self, env: V2VEnv, motion: MotionConfig, role: Literal["train", "test"]):
        """
        Args:
            motion: of the environment.
            role: whose motion it is.

        Raises:
            UserError: no off-screen OpenGL works here.
        """
        self._env, self._motion = env, motion
        self._role: Literal["train", "test"] = role
        self._painter = Painter(Stage(env.config), *SIZE_PX)

    def pictures(self, state: EnvState) -> tuple[np.ndarray, ...]:
        """(360, 640, 3) uint8 of each environment; leaves of the state are (..., N)."""
        # A diverged arm is drawn at zero: MuJoCo cannot draw a NaN.
        poses = jax.tree.map(np.nan_to_num, jax.device_get(_poses(self._env, state)))
        tables, steps = np.asarray(state.track.table), np.asarray(state.step)
        seas = [self._env.motion.seas[table // self._env.motion.seeds] for table in tables]
        return tuple(
            self._picture(jax.tree.map(lambda x, i=i: x[i : i + 1], poses), sea, int(steps[i]))
            for i, sea in enumerate(seas)
        )

    def _picture(self, poses: Any, sea: str, step: int) -> np.ndarray:
        time_s = CONTROL_DT_S * step
        take = Take(("agent",), (poses,), name_delay(self._env, poses), sea)
        water = surface(take, self._motion, np.array([time_s]), self._role)
        stage = self._painter.stage
        stage.set_sea(water, 0, poses, 0)
        self._painter.upload_sea()
        stage.place(poses, 0)
        errors = float(poses.pos_error_m[0]), float(poses.ang_error_rad[0])
        return np.array(panel(self._painter, SIZE_PX, "hero", (f"{time_s:.1f} s", INK), errors))

    def close(self) -> None:
        """Give the renderer back."""
        self._painter.close()
