"""MuJoCo MJX without the lines that its import prints about warp, which nothing here uses: on
standard output they would stand before a command's JSON."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):
    import mujoco.mjx as mjx

__all__ = ["mjx"]
