"""A real browser for tests of pages: what it complains of, what it shows; and what to install.

Playwright drives the Chromium that the system has: no browser is downloaded.
"""

import contextlib
import io
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
from PIL import Image

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
"""`--disable-gpu` leaves WebGL, drawn by the processor."""


def missing(what: str, package: str) -> NoReturn:
    """Skip the test and say what to install; under CI, which installs it, fail."""
    text = f"{what} is not installed here: apt-get install {package}"
    if os.environ.get("CI", "").lower() in ("1", "true"):
        pytest.fail(f"{text} (CI is set, so this is no reason to skip)")
    pytest.skip(text)


def executable() -> str:
    """Path of a Chromium; without one the test is skipped, or fails under CI."""
    found = next(filter(None, map(shutil.which, BROWSERS)), None)
    return found or missing("a Chromium browser", "chromium")


def off_screen_opengl() -> None:
    """Return if MuJoCo can draw off screen; otherwise the test is skipped, or fails under CI."""
    code = "from mcx_jax.play import gl; gl.choose()"
    environment = {k: v for k, v in os.environ.items() if k != "MUJOCO_GL"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, check=False
    )
    if done.returncode:
        missing("off-screen OpenGL", "libosmesa6")


@dataclass
class Tab:
    """One open page."""

    page: Any
    """Playwright's `Page`."""
    complaints: list[str] = field(default_factory=list)
    """Errors and warnings of the console, exceptions, requests that failed."""

    def picture(self, path: Path | None = None, whole: bool = False) -> np.ndarray:
        """(height, width, 3) uint8 of what the window shows, or of the whole page."""
        data = self.page.screenshot(path=path, full_page=whole)
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))

    def sideways_px(self) -> int:
        """By how much the page is wider than the window."""
        return self.page.evaluate(
            "() => document.documentElement.scrollWidth - document.documentElement.clientWidth"
        )


@contextlib.contextmanager
def tab(
    profile: Path, width_px: int = 1280, height_px: int = 900, *, dark: bool = False
) -> Iterator[Tab]:
    """A tab of a browser of its own.

    Args:
        profile: a new or an empty directory for the browser's files.
        dark: the system asks for dark colours.
    """
    from playwright.sync_api import sync_playwright

    path = executable()
    with sync_playwright() as playwright:
        context = playwright.chromium.launch_persistent_context(
            profile,
            executable_path=path,
            args=FLAGS,
            viewport={"width": width_px, "height": height_px},
            color_scheme="dark" if dark else "light",
        )
        with contextlib.closing(context):
            opened = Tab(context.pages[0])
            _listen(opened)
            yield opened


def _listen(opened: Tab) -> None:
    said, page = opened.complaints, opened.page
    page.on(
        "console",
        lambda m: said.append(f"{m.type}: {m.text}") if m.type in ("error", "warning") else None,
    )
    page.on("pageerror", lambda error: said.append(f"exception: {error}"))
    page.on("requestfailed", lambda r: said.append(f"request failed: {r.url[:200]} {r.failure}"))


def blank(picture: np.ndarray) -> bool:
    """Whether a picture shows (nearly) nothing: fewer than 1 in 1000 pixels differ from the
    commonest colour."""
    colours, counts = np.unique(picture.reshape(-1, 3), axis=0, return_counts=True)
    return len(colours) == 1 or counts.max() > 0.999 * counts.sum()
