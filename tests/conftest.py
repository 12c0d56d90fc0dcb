"""Order of the tests, JAX set-up before its import, fixtures shared by several files."""

import os
from pathlib import Path

import numpy as np
import pytest

# Before any test file imports jax: XLA reads its flags once. MuJoCo reads MUJOCO_GL on import; no
# test draws, and the default would look for a display.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("MUJOCO_GL", "disable")

try:
    from mcx_jax.startup import configure
except ImportError as error:  # a broken start-up module must fail its own tests, not all of them
    START_UP = [f"mcx_jax.startup is missing: {error}"]
else:
    START_UP = configure()

ORDER = (
    # Seconds: no compilation, or little.
    "test_assets",
    "test_config",
    "test_cli",
    "test_spatial",
    "test_results",
    "test_policy",
    "test_lag",
    "test_observe",
    "test_sea_recording",
    "test_sea_spectrum",
    "test_sea_sampler",
    "test_sea_tables",
    "test_ppo_math",
    "test_ppo_networks",
    "test_checkpoint",
    # Tens of seconds: physics and learning.
    "test_ik",
    "test_physics",
    "test_v2v",
    "test_ppo_trainer",
)
"""File stems, cheapest first, so that a mistake shows early. Files not named here come next,
by name; LAST comes last."""

LAST = ("test_train_command", "test_packaging")
"""Whole commands in processes of their own."""


def pytest_report_header() -> list[str]:
    """What the start-up set, so that a log says under which flags it was made."""
    return [f"mcx_jax start-up: {line}" for line in START_UP]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort files by ORDER; within a file, slow tests last and otherwise as written."""

    def rank(item: pytest.Item) -> tuple[int, str, bool]:
        stem = item.path.stem
        if stem in ORDER:
            return ORDER.index(stem), "", item.get_closest_marker("slow") is not None
        if stem in LAST:
            return len(ORDER) + 1 + LAST.index(stem), "", False
        return len(ORDER), stem, False

    items.sort(key=rank)


@pytest.fixture(scope="session")
def repo_root() -> Path:
    """The root of the source tree."""
    return Path(__file__).resolve().parent.parent


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator with the same seed in every test; draw with `size=`."""
    return np.random.default_rng(20230207)


@pytest.fixture
def strict_promotion():
    """JAX refuses silent rank and dtype promotion inside the test.

    For our own maths only: mjx, distrax and optax do not pass it.
    """
    import jax

    with jax.numpy_rank_promotion("raise"), jax.numpy_dtype_promotion("strict"):
        yield
