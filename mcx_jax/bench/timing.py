"""Repeated runs, timed."""

import statistics
import time
from collections.abc import Callable
from typing import Any

REPEATS = 5
MIN_S = 0.15
"""A timed call is repeated inside until it takes at least this long, so that clock and dispatch
vanish."""


def samples_s(call: Callable[[], Any], repeats: int = REPEATS) -> list[float]:
    """Seconds of one call, `repeats` times, after one call that is not counted.

    Args:
        call: runs to the end before it returns (block on JAX results inside).
    """
    call()
    once = _elapsed_s(call, 1)
    count = max(1, round(MIN_S / max(once, 1e-9)))
    samples = [once] if count == 1 else []
    while len(samples) < repeats:
        samples.append(_elapsed_s(call, count) / count)
    return samples


def median_s(call: Callable[[], Any], repeats: int = REPEATS) -> float:
    """Median of `samples_s`."""
    return statistics.median(samples_s(call, repeats))


def _elapsed_s(call: Callable[[], Any], count: int) -> float:
    begun = time.perf_counter()
    for _ in range(count):
        call()
    return time.perf_counter() - begun
