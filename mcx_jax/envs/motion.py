"""Which motion an episode uses: tables on the device, and random windows drawn from them."""

from typing import Literal

import jax
import jax.numpy as jnp
from flax import struct

from mcx_jax.config.delay import CONTROL_DT_S, SUBSTEPS
from mcx_jax.config.task import MotionConfig
from mcx_jax.console.notice import notice
from mcx_jax.envs.sampler import KNOT_STEPS
from mcx_jax.errors import UserError

NAMED_SEAS = ("Wa", "Wb", "Wc", "Wd")
LOOK_AHEAD_STEPS = 100
"""Control steps that stay readable after an episode's end (2 s), for the `preview` bound."""

APART_STEPS = 750
"""Control steps (15 s) after which a vessel's motion has forgotten itself (`SPLIT_GAP_S`): two
vessels that take windows of one short recording are kept that far apart."""
ENOUGH_WINDOWS = 20
"""Independent windows of motion below which test errors are called uncertain."""


@struct.dataclass
class Motion:
    """Tables of vessel motion and how episodes draw windows from them."""

    knots_a: jax.Array
    """(tables, knots + 1, 12): x y z m, roll pitch yaw rad, their rates; one knot each 0.1 s."""
    knots_b: jax.Array
    """The same for vessel B; the same array unless they share one wave field in some sea."""
    seas: tuple[str, ...] = struct.field(pytree_node=False)
    """Name of each sea; tables are ordered [sea, seed]."""
    seeds: int = struct.field(pytree_node=False)
    """Tables per sea."""
    last_start: int = struct.field(pytree_node=False)
    """Latest window start, control steps of 20 ms (inclusive); the earliest is 0."""
    coupled: tuple[bool, ...] = struct.field(pytree_node=False)
    """Of each sea: both vessels use the same window (one wave field)."""
    apart_steps: int = struct.field(pytree_node=False, default=0)
    """Control steps by which the starts of the two windows differ at least. 0 in generated seas: in
    an hour of waves fewer than 1 % of the pairs are nearer than 15 s."""

    def independent_windows(self, episode_steps: int) -> int:
        """How many windows of an episode's length, but of 15 s at least, a table holds one after
        the other."""
        return self.last_start // max(episode_steps, APART_STEPS) + 1


@struct.dataclass
class Track:
    """The windows of motion that one episode uses."""

    table: jax.Array
    """() int32: row of the tables."""
    start_a: jax.Array
    """() int32: vessel A's first physics step (2 ms) in the table, a multiple of 10."""
    start_b: jax.Array
    """() int32: vessel B's."""


def draw_track(motion: Motion, uniform: jax.Array, sea: jax.Array | int | None = None) -> Track:
    """Independent random windows of one table for the two vessels, `motion.apart_steps` apart.

    Args:
        uniform: (4,) numbers in [0, 1): sea, seed, start of A, start of B. One draw serves a
            whole reset: every further use of the generator costs 1,500 lines of XLA program.
        sea: index into motion.seas; None draws one.
    """
    if sea is None:
        sea = _pick(uniform[0], len(motion.seas))
    seed = _pick(uniform[1], motion.seeds)
    starts = motion.last_start + 1
    a = _pick(uniform[2], starts)
    start_a = SUBSTEPS * a
    if motion.apart_steps:
        start_b = SUBSTEPS * _pick_apart(uniform[3], a, motion)
    else:
        start_b = SUBSTEPS * _pick(uniform[3], starts)
    if any(motion.coupled):
        start_b = jnp.where(jnp.asarray(motion.coupled)[sea], start_a, start_b)
    table = jnp.asarray(sea * motion.seeds + seed, jnp.int32)
    return Track(table=table, start_a=start_a, start_b=start_b)


def _pick(uniform: jax.Array, count: int | jax.Array) -> jax.Array:
    """An int32 in [0, count); float32 has 2^23 steps, forty times an hour of starts."""
    return jnp.minimum(jnp.floor(uniform * count).astype(jnp.int32), count - 1)


def _pick_apart(uniform: jax.Array, a: jax.Array, motion: Motion) -> jax.Array:
    """An int32 in [0, last_start], at least apart_steps from a; all such are equally likely."""
    before = jnp.maximum(a - motion.apart_steps + 1, 0)
    after = jnp.maximum(motion.last_start - (a + motion.apart_steps) + 1, 0)
    k = _pick(uniform, before + after)
    return jnp.where(k < before, k, k - before + a + motion.apart_steps)


def load_motion(
    config: MotionConfig, episode_steps: int, split: Literal["train", "test"]
) -> Motion:
    """Tables for training ("train") or evaluation ("test"), generated or from a recording.

    Raises:
        UserError: unknown sea, or a recording that cannot be used.
    """
    needed_steps = episode_steps + LOOK_AHEAD_STEPS
    if config.motion:
        names, knots_a, knots_b, coupled = _recorded(config, split)
    else:
        names, knots_a, knots_b, coupled = _generated(config, split)
    last_start = (knots_a.shape[1] - 1) * KNOT_STEPS // SUBSTEPS - needed_steps - 1
    if last_start < 0:
        raise UserError(
            f"--episode-steps {episode_steps}: an episode of {episode_steps * CONTROL_DT_S:g} s "
            f"and 2 s of look-ahead do not fit into {knots_a.shape[1] * 0.1:g} s of motion"
        )
    device_a = jnp.asarray(knots_a, jnp.float32)
    # Shorter ones have starts that are near all others.
    long = bool(config.motion) and last_start >= 2 * APART_STEPS
    motion = Motion(
        knots_a=device_a,
        knots_b=device_a if knots_b is None else jnp.asarray(knots_b, jnp.float32),
        seas=names,
        seeds=knots_a.shape[0] // len(names),
        last_start=last_start,
        coupled=coupled,
        apart_steps=APART_STEPS if long else 0,
    )
    if config.motion and split == "test":
        _tell_windows(config.motion, motion, episode_steps)
    return motion


def _tell_windows(path: str, motion: Motion, episode_steps: int) -> None:
    """Say how much motion the test episodes of a recording have, whatever their number."""
    count = motion.independent_windows(episode_steps)
    episode_s = max(episode_steps, APART_STEPS) * CONTROL_DT_S
    said = f"{path}: the test part holds {count} independent windows of {episode_s:g} s"
    if count < ENOUGH_WINDOWS:
        seconds = (ENOUGH_WINDOWS + 1) * episode_s
        said += (
            f"; below {ENOUGH_WINDOWS} the errors are those of these few, more episodes repeat "
            f"them: record longer (the last third should have {seconds:.0f} s of laboratory time)"
        )
    if not motion.apart_steps:
        said += "; both vessels move nearly alike, as it is too short for windows 15 s apart"
    notice(said)


def _generated(config: MotionConfig, split: Literal["train", "test"]):
    from mcx_jax.sea.spectrum import parse_sea
    from mcx_jax.sea.tables import build_tables, doubts

    names = NAMED_SEAS if config.sea == "all" else tuple(config.sea.split(","))
    seas = [parse_sea(name) for name in names]
    coupled = tuple(config.is_coupled(name) for name in names)
    for sea, together in zip(seas, coupled, strict=True):
        for line in doubts(sea, together):
            notice(line)
    tables = build_tables(seas, split, coupled=coupled, split=config.split)
    return tables.sea_names, tables.knots, tables.companion, coupled


def _recorded(config: MotionConfig, split: Literal["train", "test"]):
    from mcx_jax.sea.recording import load_recording, split_recording

    tables = load_recording(
        config.motion,
        length_unit=config.motion_length_unit,
        angle_unit=config.motion_angle_unit,
        scale=config.motion_scale,
        axes=config.motion_axes,
    )
    train, test = split_recording(tables)
    return ("motion",), (train if split == "train" else test).knots, None, (False,)
