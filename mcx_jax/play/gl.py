"""Off-screen OpenGL: which of the two ways works here, found before MuJoCo is imported."""

import os
import subprocess
import sys

from mcx_jax.errors import UserError

BACKENDS = ("egl", "osmesa")
_TRY = "import mujoco; c = mujoco.GLContext(16, 16); c.make_current(); c.free()"


def choose() -> str:
    """Set MUJOCO_GL (and PyOpenGL's platform) to what draws here; MUJOCO_GL wins if it is set.

    A driver that is there and does not work leaves PyOpenGL unusable, hence a process for each try.

    Raises:
        UserError: neither draws.
    """
    asked = os.environ.get("MUJOCO_GL", "").lower()
    for backend in (asked,) if asked in BACKENDS else BACKENDS:
        choice = {"MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend}
        done = subprocess.run(
            [sys.executable, "-c", _TRY],
            env=os.environ | choice,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            check=False,
        )
        if done.returncode == 0:
            os.environ.update(choice)
            return backend
    raise UserError(
        "no off-screen OpenGL works here: apt-get install libosmesa6 (any machine) "
        "or libegl1 (with a GPU)"
    )
