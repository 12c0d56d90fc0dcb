"""An episode as a film or as a picture, without a display."""

import contextlib
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

import numpy as np

from mcx_jax.config.delay import CONTROL_DT_S
from mcx_jax.config.task import EnvConfig, MotionConfig
from mcx_jax.errors import UserError, reason
from mcx_jax.play.episode import Take, describe_sea
from mcx_jax.play.picture import HEIGHT_PX, WIDTH_PX, Picture
from mcx_jax.play.renderer import Painter, Stage
from mcx_jax.play.waves import surface

STRIDE = 2
"""Control steps from one frame of a film to the next: 25 frames a second."""
FPS = round(1 / (STRIDE * CONTROL_DT_S))


def title(take: Take) -> str:
    """What the picture shows."""
    what = "Tool on vessel A, goal on vessel B"
    sea = describe_sea(take.sea)
    return f"{what}  |  delay {take.delay}  |  sea {sea}, model 1:10"


def write_film(
    path: Path, take: Take, env: EnvConfig, motion: MotionConfig, say: Callable[[str], None]
) -> int:
    """Write an .mp4 of a whole episode in real time; whole or not at all.

    Args:
        say: receives the progress, every ten seconds.

    Returns:
        How many frames.
    """
    steps = np.arange(0, take.steps, STRIDE)
    # ffmpeg knows the format by the ending.
    partial = path.with_name(f".{path.stem}.partial.mp4")
    try:
        with _picture(take, env, motion, steps) as picture, _ffmpeg(partial) as film:
            begun = said = time.monotonic()
            for frame, step in enumerate(steps):
                film.write(picture.frame(frame, int(step)).tobytes())
                if (now := time.monotonic()) - said > 10:
                    said, left_s = now, (now - begun) * (len(steps) / (frame + 1) - 1)
                    say(f"frame {frame + 1} of {len(steps)}, about {left_s:.0f} s left")
        partial.replace(path)
    except OSError as error:
        raise UserError(f"--video {path}: cannot be written ({reason(error)})") from None
    finally:
        partial.unlink(missing_ok=True)
    return len(steps)


@contextlib.contextmanager
def _ffmpeg(path: Path) -> Iterator[IO[bytes]]:
    """Where raw frames go in, for an .mp4 that every browser plays.

    Raises:
        OSError: ffmpeg could not write the file.
    """
    import imageio_ffmpeg

    source = f"-f rawvideo -pix_fmt rgb24 -s {WIDTH_PX}x{HEIGHT_PX} -r {FPS} -i -".split()
    coding = "-an -c:v libx264 -crf 20 -pix_fmt yuv420p -movflags +faststart".split()
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error"]
    with subprocess.Popen(
        [*command, *source, *coding, str(path)],
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,  # Ctrl-C is ours to handle
    ) as process:
        assert process.stdin and process.stderr
        try:
            yield process.stdin
            process.stdin.close()
            if process.wait():
                said = process.stderr.read().decode(errors="replace").split("\n")[0]
                raise OSError(0, said or "ffmpeg failed")
        finally:
            process.kill()


def write_frame(path: Path, take: Take, env: EnvConfig, motion: MotionConfig, at_s: float) -> None:
    """Write the picture of one instant, seconds since the episode's beginning, as a PNG."""
    from PIL import Image

    step = int(np.abs(take.time_s - at_s).argmin())
    with _picture(take, env, motion, np.array([step]), fine=True) as picture:
        image = Image.fromarray(picture.frame(0, step))
    try:
        image.save(path)
    except OSError as error:
        raise UserError(f"--frame {path}: cannot be written ({reason(error)})") from None


@contextlib.contextmanager
def _picture(
    take: Take, env: EnvConfig, motion: MotionConfig, steps: np.ndarray, *, fine: bool = False
) -> Iterator[Picture]:
    """The pictures of these control steps; the renderer is given back at the end."""
    stage = Stage(env)
    water = surface(take, motion, take.time_s[steps])
    with Painter(stage, WIDTH_PX, HEIGHT_PX, fine=fine) as painter:
        yield Picture(take, water, stage, painter, title(take))
