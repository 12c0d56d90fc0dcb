"""The late answer of a real arm: a queue of control steps and a Butterworth filter on references.

Paper section 3 and table 2. Every lag is the same two stages, queue then filter; either may be
empty, so there is one code path. The filter runs as second-order sections (the same difference
equation as paper eq. 2b, but accurate in float32 for any order).
"""

import functools
import math

import jax
import jax.numpy as jnp
from flax import struct

from mcx_jax.config.delay import NYQUIST_HZ, Delay


@struct.dataclass
class LagState:
    """What the lag remembers."""

    queue: jax.Array
    """(k, nq) joint references of the last k control steps, oldest first, rad."""
    sections: jax.Array
    """(sections, 2, nq) transposed direct form II state of each second-order section, rad."""


@functools.cache
def sections(delay: Delay) -> tuple[tuple[float, ...], ...]:
    """Second-order sections (b0, b1, b2, a1, a2) of the delay's filter; empty without one.

    The analogue Butterworth poles lie on a circle, a conjugate pair s^2 + d s + 1 with d = 2 sin(t)
    each (for an odd order one real pole besides); the bilinear transform with the cutoff prewarped
    gives a section of unit gain at 0 Hz. (scipy.signal gives the same and takes 1 s to import.)
    """
    k = math.tan(0.5 * math.pi * delay.cutoff_hz / NYQUIST_HZ)
    rows = []
    for i in range(delay.order // 2):
        d = 2.0 * math.sin(math.pi * (2 * i + 1) / (2 * delay.order))
        scale = 1.0 / (1.0 + d * k + k * k)
        b = k * k * scale
        rows.append((b, 2.0 * b, b, 2.0 * (k * k - 1.0) * scale, (1.0 - d * k + k * k) * scale))
    if delay.order % 2:
        b = k / (1.0 + k)
        rows.append((b, b, 0.0, (k - 1.0) / (k + 1.0), 0.0))
    return tuple(rows)


def init_all(delays: tuple[Delay, ...], first: jax.Array) -> tuple[LagState, ...]:
    """`init` of every delay."""
    return tuple(init(delay, first) for delay in delays)


def apply_one(
    delays: tuple[Delay, ...], which: jax.Array | None, states: tuple[LagState, ...], x: jax.Array
) -> tuple[tuple[LagState, ...], jax.Array]:
    """`apply` of delay number `which`, () int32 (None where there is one only).

    All of them run: beside a physics step a filter costs nothing.
    """
    found = [apply(delay, state, x) for delay, state in zip(delays, states, strict=True)]
    late = found[0][1]
    for number, (_, other) in enumerate(found[1:], 1):
        late = jnp.where(which == number, other, late)
    return tuple(state for state, _ in found), late


def init(delay: Delay, first: jax.Array) -> LagState:
    """Settled on the first input: a queue full of it, and the filter in steady state.

    Until k references have arrived the queue thus returns its oldest entry, the first one.

    Args:
        first: (nq,) joint reference, rad.
    """
    # Steady state of TDF-II; every section has gain 1 at 0 Hz, so the same input.
    settled = [
        jnp.stack([(1.0 - b0) * first, (b2 - a2) * first]) for b0, _, b2, _, a2 in sections(delay)
    ]
    return LagState(
        queue=jnp.broadcast_to(first, (delay.steps, *first.shape)),
        sections=jnp.stack(settled) if settled else jnp.zeros((0, 2, *first.shape), first.dtype),
    )


def apply(delay: Delay, state: LagState, x: jax.Array) -> tuple[LagState, jax.Array]:
    """One control step: reference in, late reference out.

    Args:
        x: (nq,) joint reference, rad.

    Returns:
        (new state, (nq,) the reference that the arm's servo sees, rad).
    """
    queue = state.queue
    if delay.steps:
        x, queue = queue[0], jnp.concatenate([queue[1:], x[None]])
    new = []
    for (b0, b1, b2, a1, a2), z in zip(sections(delay), state.sections, strict=True):
        y = b0 * x + z[0]
        new.append(jnp.stack([b1 * x - a1 * y + z[1], b2 * x - a2 * y]))
        x = y
    filtered = jnp.stack(new) if new else state.sections
    return LagState(queue=queue, sections=filtered), x
