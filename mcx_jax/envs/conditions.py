"""Per-episode disturbances (sampled) and the resulting goal measurement.

Everything here is None, and costs nothing, where the configuration leaves it out.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from flax import struct

from mcx_jax.arm.plant import Plant
from mcx_jax.config.delay import CONTROL_DT_S
from mcx_jax.config.task import ConditionsConfig, EnvConfig, Range
from mcx_jax.spatial import Mat, Vec, exp_rotation, matmul, unpack, unpack_matrix, vadd, vscale

CONDITIONS_STREAM = 1
"""Folded into an episode's key: its windows of motion and its goal do not depend on conditions."""


@struct.dataclass
class Noise:
    """White noise of the measured goal, new at every control step."""

    position_m: jax.Array
    """() standard deviation of each axis."""
    angle_rad: jax.Array
    """() standard deviation about each axis."""
    key: jax.Array
    """() PRNG key of the episode."""


@struct.dataclass
class Conditions:
    """Constant within an episode; None = as the configuration says, the same in all."""

    plant: Plant | None
    noise: Noise | None
    latency: jax.Array | None
    """() int32 age of the measured goal, control steps."""
    delay: jax.Array | None
    """() int32 which of the environment's delays."""
    path_start: jax.Array | None
    """() int32 physics step of the goal's path at the episode's beginning."""

    @property
    def age_s(self) -> jax.Array | float:
        """() age of the measured goal, as its time stamp says."""
        return 0.0 if self.latency is None else CONTROL_DT_S * self.latency


def draw(config: EnvConfig, key: jax.Array, path_steps: int) -> Conditions:
    """The conditions of an episode.

    Args:
        key: of the episode.
        path_steps: physics steps after which the goal's path repeats itself; 0 = starts at 0.
    """
    asked, delays = config.conditions, len(config.delays)
    moving = config.goal != "static"
    drawn = asked != ConditionsConfig() or delays > 1 or moving or config.integrator == "mixed"
    if not drawn:
        return Conditions(plant=None, noise=None, latency=None, delay=None, path_start=None)
    key = jax.random.fold_in(key, CONDITIONS_STREAM)
    uniform = jax.random.uniform(key, (8,))
    ranges = asked.ranges
    plant = noise = latency = delay = None
    if asked.changes_plant or config.integrator == "mixed":
        plant = Plant(
            payload_kg=_between(ranges["payload_kg"], uniform[0]),
            wrist_inertia=_between_logs(ranges["wrist_inertia"], uniform[1]),
            quiet=jnp.round(uniform[2]),
        )
    if asked.noisy:
        noise = Noise(
            position_m=1e-3 * _between_roots(ranges["noise_mm"], uniform[3]),
            angle_rad=1e-3 * _between_roots(ranges["noise_mrad"], uniform[4]),
            key=key,
        )
    if ranges["latency_steps"].high > 0:
        low, high = ranges["latency_steps"].low, ranges["latency_steps"].high
        latency = _whole(uniform[5], high - low + 1) + int(low)
    if delays > 1:
        delay = _whole(uniform[6], delays)
    start = _whole(uniform[7], max(path_steps, 1)) if moving else None
    return Conditions(plant=plant, noise=noise, latency=latency, delay=delay, path_start=start)


def _between(bounds: Range, uniform: jax.Array) -> jax.Array:
    return bounds.low + (bounds.high - bounds.low) * uniform


def _between_roots(bounds: Range, uniform: jax.Array) -> jax.Array:
    """Uniform in the root: with 0 to 3 mm a third of the episodes has less than 0.3 mm. Drawn
    evenly, hardly one is clean, and what learns from them never trusts a measurement."""
    low, high = bounds.low**0.5, bounds.high**0.5
    return (low + (high - low) * uniform) ** 2


def _between_logs(bounds: Range, uniform: jax.Array) -> jax.Array:
    """Uniform in the logarithm: 0.02 to 0.14 is as likely as 0.14 to 1."""
    return bounds.low * (bounds.high / bounds.low) ** uniform


def _whole(uniform: jax.Array, count: float) -> jax.Array:
    """() int32 from 0 to count - 1."""
    return jnp.minimum((uniform * count).astype(jnp.int32), int(count) - 1)


@struct.dataclass
class Measurement:
    """The goal's pose T_G^B as measured, and what is on its way."""

    rotation: jax.Array
    """(3, 3) R_B_G."""
    position: jax.Array
    """(3,) p_B_G, m."""
    queue: jax.Array
    """(k, 12) true poses of the last k control steps, oldest first; k the largest latency."""

    @property
    def pose(self) -> tuple[Mat, Vec]:
        """(R_B_G, p_B_G) as scalars."""
        return unpack_matrix(self.rotation), unpack(self.position, 3)  # type: ignore[return-value]


def first_measurement(
    conditions: Conditions, config: EnvConfig, goal: tuple[Mat, Vec]
) -> Measurement:
    """At the beginning of an episode; before it the goal was where it is."""
    flat = jnp.stack(_flat(goal))
    slots = int(config.conditions.ranges["latency_steps"].high)
    queue = jnp.broadcast_to(flat, (slots, 12))
    return measure(conditions, queue, goal, jnp.int32(0))


def measure(
    conditions: Conditions, queue: jax.Array, goal: tuple[Mat, Vec], step: jax.Array
) -> Measurement:
    """What a sensor reports of the true pose `goal` at the end of control step `step`."""
    rotation, position = goal
    if conditions.latency is not None:
        poses = jnp.concatenate([queue, jnp.stack(_flat(goal))[None]])
        age = jnp.arange(len(poses))[::-1]
        # A sum over the few slots instead of a gather, which vmap makes slow.
        chosen = jnp.sum(jnp.where((age == conditions.latency)[:, None], poses, 0.0), axis=0)
        queue = poses[1:]
        rotation, position = unpack_matrix(chosen[:9].reshape(3, 3)), unpack(chosen[9:], 3)
    if conditions.noise is not None:
        noise = conditions.noise
        normal = unpack(jax.random.normal(jax.random.fold_in(noise.key, step), (6,)), 6)
        position = vadd(position, vscale(noise.position_m, normal[:3]))  # type: ignore[arg-type]
        turn = vscale(noise.angle_rad, normal[3:])  # type: ignore[arg-type]
        rotation = matmul(rotation, exp_rotation(turn))
    return Measurement(stack_matrix(rotation), jnp.stack(position), queue)


def stack_matrix(m: Mat) -> jax.Array:
    """(3, 3) array of a matrix of scalars."""
    return jnp.stack([jnp.stack(row) for row in m])


def _flat(goal: tuple[Mat, Vec]) -> Sequence[jax.Array]:
    return [jnp.asarray(x) for x in (*goal[0][0], *goal[0][1], *goal[0][2], *goal[1])]
