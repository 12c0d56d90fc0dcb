"""A trained policy by itself: what it is, how it acts, and its file.

The file is a plain `.npz` without pickles: weights under their names (`policy/net/head/kernel`),
the observation statistics, and two JSON strings: `metadata` (format version, network, configuration
of the training run) and `interface` (`mcx_jax.policy.interface`: inputs and outputs, their names,
units and frames). NumPy alone reads it; `mcx_jax.policy.numpy_policy` runs it.
"""

import dataclasses
import io
import json
import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct, traverse_util

from mcx_jax.assets import policy_file
from mcx_jax.envs.observe import OBS_SIZE
from mcx_jax.errors import UserError
from mcx_jax.policy import interface
from mcx_jax.policy.networks import CELLS, Carry, Params, PolicyNet, init_params, step
from mcx_jax.policy.networks import init_carry as zero_carry
from mcx_jax.policy.normalise import RunningStats, init_stats, normalise_obs

FORMAT = 1
"""Version of the file."""
KIND = "mcx_jax policy"
MAX_SIZE = 2**16
"""Of an observation, an action and a layer; a file that says more is damaged."""
LARGEST = 1e30
"""Of any number in a file: with `MAX_SIZE` of them and inputs of at most 10, no float32 sum in the
network overflows, so that whatever is loaded acts with finite numbers."""


@dataclasses.dataclass(frozen=True)
class PolicyMeta:
    """What a policy is besides its weights; hashable, so static under jit."""

    obs_size: int
    """Length of the observation."""
    action_size: int
    """Length of the action."""
    hidden: int
    """Width of the network."""
    cell: str = "lstm"
    """Its recurrent cell."""
    config: str = "{}"
    """Configuration of the training run, JSON (`cli.config_from_json`)."""
    iteration: int = 0
    """Training iterations behind it."""
    seed: int = 0
    """Seed that it was trained with."""

    @property
    def net(self) -> PolicyNet:
        """The network, without weights."""
        return PolicyNet(self.hidden, self.action_size, cell=self.cell)

    @property
    def interface(self) -> dict[str, Any]:
        """What goes in and out, as JSON can hold it."""
        return interface.describe(self.net, self.obs_size, self.config)


@struct.dataclass
class Policy:
    """A policy that acts.

    Attributes:
        params: weights of the policy network.
        obs_stats: statistics that observations are normalised with, (F,).
        meta: the rest; static.
    """

    params: Params
    obs_stats: RunningStats
    meta: PolicyMeta = struct.field(pytree_node=False)


def init_carry(policy: Policy, batch: tuple[int, ...] = ()) -> Carry:
    """Memory at the start of an episode, for one environment or a batch (in front)."""
    return zero_carry(policy.meta.net, batch)


def act(policy: Policy, carry: Carry, obs: jax.Array) -> tuple[Carry, jax.Array]:
    """The greedy action.

    Args:
        carry: memory, leaves (..., H).
        obs: not normalised, (..., F).

    Returns:
        Memory, and the mean of the action distribution, (..., A) cm and crad.
    """
    seen = normalise_obs(policy.obs_stats, obs)
    carry, mean, _ = step(policy.meta.net, policy.params, carry, seen)
    return carry, mean


@struct.dataclass
class PolicyController:
    """A policy with the two functions of a controller (`controllers.classical`), ONE episode."""

    policy: Policy

    def init(self, env: Any, state: Any) -> Carry:
        """Memory at the beginning of an episode."""
        del env, state
        return init_carry(self.policy)

    def act(self, env: Any, state: Any, memory: Carry) -> tuple[Carry, jax.Array]:
        """(memory, (A,) action in cm and crad)."""
        del env
        return act(self.policy, memory, self._seen(state.obs))

    def _seen(self, obs: jax.Array) -> jax.Array:
        """What the policy knows of an observation, whose last entry may be the measurement's age: a
        policy trained without it does not look, to one trained with it a measurement is new."""
        size = self.policy.meta.obs_size
        return jnp.pad(obs, (0, max(size - len(obs), 0)))[:size]


def npz_bytes(policy: Policy) -> bytes:
    """The content of a policy file."""
    metadata = {"kind": KIND, "format": FORMAT, **dataclasses.asdict(policy.meta)}
    texts = {
        "metadata": json.dumps(metadata),
        "interface": json.dumps(policy.meta.interface, indent=1),
    }
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, **texts, **named_arrays(policy))
    return content.getvalue()


def save_policy(path: str | Path, policy: Policy) -> None:
    """Write a policy file; whole or not at all."""
    write_whole(Path(path), npz_bytes(policy))


def write_whole(path: Path, content: bytes) -> None:
    """Write a file under a temporary name beside it, then move it there."""
    partial = path.with_name(f".{path.name}.partial")
    try:
        with partial.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def load_run(run: str | Path) -> Policy:
    """The policy of a run directory, of a policy file, or of `shipped:DELAY`.

    Raises:
        UserError: as `load_policy`.
    """
    return load_policy(policy_file(str(run)))


def load_policy(path: str | Path) -> Policy:
    """Read a policy file.

    Raises:
        UserError: missing, not a policy file, cut short, of another format, with wrong shapes, or
            with numbers that no training gives.
    """
    path = Path(path)
    arrays = _read(path)
    meta = _meta(path, arrays.pop("metadata", None))
    expected = _named(_empty(meta))
    arrays = {name: _array(path, name, arrays, like.shape) for name, like in expected.items()}
    weights = {tuple(n.split("/")[1:]): jnp.asarray(arrays[n]) for n in expected if "obs/" not in n}
    stats = {field: jnp.asarray(arrays[f"obs/{field}"]) for field in ("count", "mean", "var")}
    return Policy(
        params={"params": traverse_util.unflatten_dict(weights)},
        obs_stats=RunningStats(**stats),
        meta=meta,
    )


def _array(
    path: Path, name: str, arrays: dict[str, np.ndarray], shape: tuple[int, ...]
) -> np.ndarray:
    """An array of the file as float32 of this machine's byte order, whatever wrote it."""
    if name not in arrays or arrays[name].shape != shape:
        raise UserError(f"{path}: not a whole policy file: {name} is missing or misshapen")
    x = arrays[name]
    # A NaN fails every comparison.
    if x.dtype.kind != "f" or not (np.abs(x) <= LARGEST).all():
        raise UserError(
            f"{path}: not a policy that can act: {name} has no finite numbers, or some beyond "
            f"{LARGEST:g}"
        )
    if name in ("obs/count", "obs/var") and (x < 0).any():
        raise UserError(f"{path}: not a policy that can act: {name} is negative")
    return x.astype(np.float32)


def require_task(path: str | Path, meta: PolicyMeta) -> None:
    """Refuse a policy that is not for this task, of 38 or 39 observed and 6 corrected numbers.

    Raises:
        UserError: it is not.
    """
    taken, given = (OBS_SIZE, OBS_SIZE + 1), interface.ACTION_SIZE
    if meta.obs_size not in taken or meta.action_size != given:
        raise UserError(
            f"{path}: reads {meta.obs_size} numbers and gives {meta.action_size}; a policy for "
            f"this task reads {taken[0]} or {taken[1]} and gives {given}"
        )


def named_arrays(policy: Policy) -> dict[str, np.ndarray]:
    """All arrays of a policy under the names that they have in the file."""
    return {name: np.asarray(x) for name, x in _named(policy).items()}


def _named(policy: Policy) -> dict[str, Any]:
    """Leaves of a policy, arrays or shapes, by name."""
    weights = traverse_util.flatten_dict(policy.params["params"], sep="/")
    named = {f"policy/{name}": x for name, x in weights.items()}
    stats = policy.obs_stats
    return {**named, "obs/count": stats.count, "obs/mean": stats.mean, "obs/var": stats.var}


def _empty(meta: PolicyMeta) -> Policy:
    """A policy's shapes."""
    key = jax.eval_shape(lambda: jax.random.key(0))
    params = jax.eval_shape(lambda k: init_params(meta.net, k, meta.obs_size), key)
    return Policy(params=params, obs_stats=init_stats((meta.obs_size,)), meta=meta)


def _read(path: Path) -> dict[str, np.ndarray]:
    if not os.path.isfile(path):
        raise UserError(
            f"no policy at {path}: train one (python -m mcx_jax.train), or name a policy .npz"
        )
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except Exception:  # a damaged zip raises nearly anything: zlib's, zipfile's, numpy's errors
        raise UserError(f"{path}: not a policy file of mcx_jax, or cut short") from None


def _meta(path: Path, text: np.ndarray | None) -> PolicyMeta:
    foreign = UserError(f"{path}: not a policy file of mcx_jax (no metadata of its kind)")
    try:
        values = json.loads(str(text))
        kind, version = values.pop("kind"), values.pop("format")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise foreign from None
    if kind != KIND:
        raise foreign
    if version != FORMAT:
        raise UserError(f"{path}: policy file of format {version}; this version reads {FORMAT}")
    try:
        meta = PolicyMeta(**values)
        known = isinstance(json.loads(meta.config), dict)
    except (TypeError, ValueError, RecursionError):
        raise foreign from None
    sizes = meta.obs_size, meta.action_size, meta.hidden
    counts = meta.iteration, meta.seed
    if (
        not known
        or meta.cell not in tuple(CELLS)
        or not all(type(n) is int and 0 < n <= MAX_SIZE for n in sizes)
        or not all(type(n) is int and n >= 0 for n in counts)
    ):
        raise foreign
    return meta
