"""Medians of repeated runs."""

import statistics
import time
from collections.abc import Callable
from typing import Any

REPEATS = 5
MIN_S = 0.15
"""A timed call is repeated inside until it takes at least this long, so that clock and dispatch
vanish."""


def median_s(call: Callable[[], Any], repeats: int = REPEATS) -> float:
    """Median seconds of one call, after one call that is not counted.

    Args:
        call: runs to the end before it returns (block on JAX results inside).
    """
    call()
    once = _elapsed_s(call, 1)
    count = max(1, round(MIN_S / max(once, 1e-9)))
    samples = [once] if count == 1 else []
    while len(samples) < repeats:
        samples.append(_elapsed_s(call, count) / count)
    return statistics.median(samples)


def _elapsed_s(call: Callable[[], Any], count: int) -> float:
    begun = time.perf_counter()
    for _ in range(count):
        call()
    return time.perf_counter() - begun
