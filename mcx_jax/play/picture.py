"""One picture of an episode: a panel for each controller, a close-up in it, the errors so far."""

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mcx_jax import palette
from mcx_jax.play.episode import Take
from mcx_jax.play.renderer import Painter, Stage
from mcx_jax.play.waves import Surface

WIDTH_PX, HEIGHT_PX = 1280, 720
TITLE_PX, PANEL_PX, GAP_PX = 46, 430, 4
CLOSE_UP_PX = 180
PLOT_BOX_PX = (62, 516, 1252, 682)
"""Left, top, right, bottom of the axes."""
LABEL_PX = 20
"""Size of the plot's letters and of the scale's."""
WIDE_BAR_M, CLOSE_BAR_M = 0.5, 0.02
"""Lengths of the scale bars, at the goal's distance."""
INK, MUTED, GRID, PAPER = (palette.LIGHT[name] for name in ("ink", "muted", "grid", "paper"))
TICKS_MM = (0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200)
"""Distances of grid lines to choose from."""


class Picture:
    """Draws the frames of one take."""

    def __init__(self, take: Take, surface: Surface, stage: Stage, painter: Painter, title: str):
        """
        Args:
            surface: at the instants of the frames.
            title: the line at the top.
        """
        self._take, self._surface, self._stage, self._painter = take, surface, stage, painter
        self._title = title
        self._colours = list(palette.controllers(take.names).values())
        # Round numbers; a diverged episode must not flatten the rest.
        highest = max(np.nanquantile(1e3 * p.pos_error_m, 0.995) for p in take.poses)
        self._tick_mm = next((t for t in TICKS_MM if highest <= 4.5 * t), TICKS_MM[-1])
        self._top_mm = 1.15 * highest

    def frame(self, frame: int, step: int) -> np.ndarray:
        """(720, 1280, 3) uint8.

        Args:
            frame: index into the surface's instants.
            step: the same instant as a control step of the take.
        """
        image = Image.new("RGB", (WIDTH_PX, HEIGHT_PX), PAPER)
        draw = ImageDraw.Draw(image)
        draw.rectangle((0, 0, WIDTH_PX, TITLE_PX), fill=INK)
        draw.text((16, TITLE_PX / 2), self._title, "white", font(22), anchor="lm")
        clock = f"{self._take.time_s[step]:.1f} s"
        draw.text((WIDTH_PX - 16, TITLE_PX / 2), clock, "white", font(22), anchor="rm")
        self._stage.set_sea(self._surface, frame, self._take.poses[0], step)
        self._painter.upload_sea()
        count = len(self._take.names)
        width = (WIDTH_PX - GAP_PX * (count - 1)) // count
        for i in range(count):
            image.paste(self._panel(i, step, width), (i * (width + GAP_PX), TITLE_PX))
        self._plot(draw, step)
        return np.asarray(image)

    def _panel(self, i: int, step: int, width: int) -> Image.Image:
        poses, name = self._take.poses[i], self._take.names[i]
        self._stage.place(poses, step)
        label = "IK baseline" if name == "ik" else name
        camera = "hero" if len(self._take.names) == 1 else "pair"
        errors = poses.pos_error_m[step], poses.ang_error_rad[step]
        return panel(self._painter, (width, PANEL_PX), camera, (label, self._colours[i]), errors)

    def _plot(self, draw: ImageDraw.ImageDraw, step: int) -> None:
        left, top, right, bottom = PLOT_BOX_PX
        time_s = self._take.time_s
        across = (right - left) / time_s[-1]
        up = (bottom - top) / self._top_mm
        for mm in np.arange(0, self._top_mm, self._tick_mm):
            y = bottom - up * mm
            draw.line((left, y, right, y), MUTED if mm == 0 else GRID, 1)
            draw.text((left - 8, y), f"{mm:g}", INK, font(LABEL_PX), anchor="rm")
        what = "position error, mm, over time, s"
        draw.text((14, top - 22), what, INK, font(LABEL_PX), anchor="lm")
        every_s = max(1, round(time_s[-1] / 10))
        for second in np.arange(0, time_s[-1] + 1e-9, every_s):
            x = left + across * second
            draw.text((x, bottom + 8), f"{second:g}", INK, font(LABEL_PX), anchor="mt")
        for i, poses in enumerate(self._take.poses):
            mm = np.nan_to_num(1e3 * poses.pos_error_m[: step + 1], nan=self._top_mm)
            y = bottom - up * np.clip(mm, 0, self._top_mm)
            line = list(zip(left + across * time_s[: step + 1], y, strict=True))
            if len(line) > 1:
                draw.line(line, self._colours[i], 3, joint="curve")
            x, y = line[-1]
            draw.ellipse((x - 5, y - 5, x + 5, y + 5), fill=self._colours[i])


def panel(
    painter: Painter,
    size_px: tuple[int, int],
    camera: str,
    label: tuple[str, str],
    errors: tuple[float, float],
) -> Image.Image:
    """The painter's stage as it is now: through a camera, close up, errors as numbers.

    Args:
        label: text and colour of the upper left plate.
        errors: dp in m, da in rad.
    """
    image = Image.fromarray(painter.wide(*size_px, camera))
    close = Image.fromarray(painter.close_up(CLOSE_UP_PX))
    scale_bar(close, CLOSE_BAR_M * painter.close_up_px_per_m(CLOSE_UP_PX), "2 cm", 16)
    inset(image, np.asarray(close), size_px[0] - 10, 10)
    wide_bar_px = WIDE_BAR_M * painter.wide_px_per_m(size_px[1], camera)
    scale_bar(image, wide_bar_px, "0.5 m (5 m at full scale)", LABEL_PX)
    draw = ImageDraw.Draw(image)
    chip(draw, (10, 10), *label, 22)
    chip(draw, (10, 50), f"{1e3 * errors[0]:.2f} mm", INK, 20)
    chip(draw, (10, 88), f"{1e3 * errors[1]:.2f} mrad", INK, 20)
    return image


def inset(image: Image.Image, close_up: np.ndarray, right: int, top: int) -> None:
    """Put a close-up (size, size, 3) with its caption into a picture, its right upper corner so."""
    size = len(close_up)
    frame = (right - size - 2, top - 2, right + 1, top + size + 26)
    draw = ImageDraw.Draw(image)
    draw.rounded_rectangle(frame, 4, fill="white")
    image.paste(Image.fromarray(close_up), (right - size, top))
    caption = right - size / 2, top + size + 12
    draw.text(caption, "thick: goal, thin: tool", INK, font(17), anchor="mm")


def scale_bar(image: Image.Image, length_px: float, text: str, size: int) -> None:
    """A bar on a plate of white in the lower left corner, and what it is long."""
    draw, high = ImageDraw.Draw(image), image.height
    width = max(length_px, draw.textlength(text, font(size))) + 16
    draw.rounded_rectangle((6, high - size - 24, 6 + width, high - 6), 5, fill="white")
    draw.text((14, high - size - 20), text, INK, font(size), anchor="lt")
    draw.rectangle((14, high - 14, 14 + length_px, high - 11), fill=INK)


def chip(draw: ImageDraw.ImageDraw, corner: Sequence[float], text: str, colour: str, size: int):
    """Text on a plate of white, its upper left corner at `corner` (pixels)."""
    x, y = corner
    box = draw.textbbox((x + 9, y + 6), text, font(size))
    plate = (x, y, box[2] + 9, y + size + 14)
    draw.rounded_rectangle(plate, 5, fill="white")
    draw.text((x + 9, y + (size + 14) / 2), text, colour, font(size), anchor="lm")


def font(size: int):
    """Pillow's own letters: nothing to find on the machine."""
    return ImageFont.load_default(size)
