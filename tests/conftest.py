"""Order of the tests, JAX set-up before its import, fixtures shared by several files."""

import os
import signal
from pathlib import Path

import numpy as np
import pytest

# Before any test file imports jax: XLA reads its flags once. MuJoCo reads MUJOCO_GL on import; no
# test draws, and the default would look for a display.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("MUJOCO_GL", "disable")
# Tests compile for minutes to compute for seconds. Without LLVM's optimisation, which changes speed
# and last bits only, they compile in two thirds of the time. A level that is set stays: `make
# test-slow` compiles as the commands do. Processes that tests start inherit it.
if "xla_backend_optimization_level" not in os.environ.get("XLA_FLAGS", ""):
    quick = "--xla_backend_optimization_level=0"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {quick}".strip()

# A shell starts background jobs (nohup, some CI runners) with SIGINT ignored, and children inherit
# it; the tests of Ctrl-C would then wait for an interrupt that never comes.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

try:
    from mcx_jax.compute.startup import configure
except ImportError as error:  # a broken start-up module must fail its own tests, not all of them
    START_UP = [f"mcx_jax.compute.startup is missing: {error}"]
else:
    # One device, as a library user has it; tests of several start processes of their own.
    START_UP = [*configure(mjx=True, cores=1), f"XLA_FLAGS={os.environ.get('XLA_FLAGS', '')}"]

CHEAP = (
    "test_assets",
    "test_packaging",
    "test_readme",
    "test_config",
    "test_cli",
    "test_spatial",
    "test_batch_last",
    "test_results",
    "test_policy",
    "test_observe",
    "test_sea_recording",
    "test_sea_spectrum",
    "test_sea_sampler",
    "test_sea_tables",
    "test_ppo_math",
    "test_checkpoint",
    "test_lag",
    "test_ppo_networks",
)
"""File stems that take seconds, cheapest first, so that a mistake shows early."""

EXPENSIVE = (
    *(
        "test_play",
        "test_physics",
        "test_report",
        "test_train_command",
        "test_v2v",
        "test_sharding",
    ),
    *("test_determinism", "test_gym", "test_ppo_trainer", "test_mjx_step", "test_conditions"),
    *("test_lowering", "test_evaluate", "test_export", "test_laws", "test_docs", "test_progress"),
)
"""File stems that take longest on two cores, the longest first, so that two workers end together.
Files in neither list come last."""


def pytest_report_header() -> list[str]:
    """What the start-up set, so that a log says under which flags it was made."""
    return [f"mcx_jax start-up: {line}" for line in START_UP]


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Cheap files, expensive files, unlisted files by name; within a file slow tests last."""

    def rank(item: pytest.Item) -> tuple[int, int, str, bool]:
        stem, slow = item.path.stem, item.get_closest_marker("slow") is not None
        if stem in CHEAP:
            return 0, CHEAP.index(stem), stem, slow
        if stem in EXPENSIVE:
            return 1, EXPENSIVE.index(stem), stem, slow
        return 2, 0, stem, slow

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
