"""The picture at the head of the README: an instant of a test episode, drawn by `mcx_jax.play`.

    python experiments/hero.py

Controller `extrapolate`, delay B4_4, sea Wd. Needs the extra `viz` and an off-screen OpenGL
(Debian: libosmesa6).
"""

from pathlib import Path

import numpy as np

from mcx_jax.compute import startup
from mcx_jax.config.task import EnvConfig, MotionConfig
from mcx_jax.play import gl

EPISODE, AT_S = 0, 12.5


def main() -> None:
    gl.choose()
    startup.configure("cpu")
    from PIL import Image

    from mcx_jax.controllers.classical import CLASSICAL
    from mcx_jax.envs.v2v import make_env
    from mcx_jax.play.episode import simulate
    from mcx_jax.play.picture import inset
    from mcx_jax.play.renderer import Painter, Stage
    from mcx_jax.play.waves import surface

    task, motion = EnvConfig(), MotionConfig(sea="Wd")
    env = make_env(task, motion, split="test")
    take = simulate(env, "extrapolate", CLASSICAL["extrapolate"], sea=0, episode=EPISODE)
    step = int(np.abs(take.time_s - AT_S).argmin())
    stage = Stage(task)
    stage.place(take.poses[1], step)
    stage.set_sea(surface(take, motion, take.time_s[[step]]), 0)
    with Painter(stage, 1280, 720, fine=True) as painter:
        painter.upload_sea()
        image = Image.fromarray(painter.wide(1280, 720, "hero"))
        inset(image, painter.close_up(240), 1280 - 16, 16)
    path = Path(__file__).parents[1] / "docs" / "hero.png"
    image.save(path, optimize=True)
    print(f"wrote {path.name}")


if __name__ == "__main__":
    startup.run_command(main)
