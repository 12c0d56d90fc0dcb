"""Off-screen OpenGL: which of the two ways works here; MuJoCo may be imported already."""

import functools
import importlib
import os
import subprocess
import sys
from typing import Any

from mcx_jax.errors import UserError, reason

BACKENDS = ("egl", "osmesa")
_TRY = "from mujoco.{} import GLContext; c = GLContext(16, 16); c.make_current(); c.free()"
MISSING = (
    "no off-screen OpenGL works here: apt-get install libosmesa6 (any machine) "
    "or libegl1 (with a GPU)"
)


def choose() -> str:
    """What draws here, egl or osmesa; MUJOCO_GL wins if it names one of them.

    Raises:
        UserError: neither draws.
    """
    asked = os.environ.get("MUJOCO_GL", "").lower()
    return _first_that_draws((asked,) if asked in BACKENDS else BACKENDS)


@functools.cache
def _first_that_draws(backends: tuple[str, ...]) -> str:
    """A driver that is there and does not work leaves PyOpenGL unusable, hence a process for each
    try."""
    for backend in backends:
        done = subprocess.run(
            [sys.executable, "-c", _TRY.format(backend)],
            env=os.environ | {"MUJOCO_GL": "disable", "PYOPENGL_PLATFORM": backend},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            check=False,
        )
        if done.returncode == 0:
            return backend
    raise UserError(MISSING)


def context(width_px: int, height_px: int) -> Any:
    """An off-screen OpenGL context, made current.

    Raises:
        UserError: there is none.
    """
    backend = choose()
    # PyOpenGL reads it once, when it is imported.
    os.environ["PYOPENGL_PLATFORM"] = backend
    try:
        made = importlib.import_module(f"mujoco.{backend}").GLContext(width_px, height_px)
        made.make_current()
    except Exception as error:  # of PyOpenGL, of MuJoCo, of the driver
        raise UserError(f"off-screen OpenGL ({backend}) fails: {reason(error)}") from None
    return made
