"""The picture at the head of the README.

    MUJOCO_GL=osmesa PYOPENGL_PLATFORM=osmesa python experiments/hero.py

Needs an off-screen OpenGL (Debian: libosmesa6) and matplotlib.
"""

from pathlib import Path

import mujoco
from matplotlib import image

from mcx_jax.scene import REACH_POSE_RAD, build_scene, pose_scene


def main() -> None:
    model = build_scene()
    data = mujoco.MjData(model)
    pose_scene(model, data, REACH_POSE_RAD)
    with mujoco.Renderer(model, 720, 1280) as renderer:
        renderer.update_scene(data, "hero")
        path = Path(__file__).parents[1] / "docs" / "hero.png"
        image.imsave(path, renderer.render())
    print(f"wrote {path.name}")


if __name__ == "__main__":
    main()
