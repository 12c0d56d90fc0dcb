"""Checkpoints of a training state, by orbax: atomic, the last two kept, restored exactly.

A state is stored as a flat dictionary {path of the leaf: array}, PRNG keys as their raw data, so
that a checkpoint does not depend on how orbax treats our classes, and a mismatch can be named.
Leaves without elements (a delay line of length 0) are left out: orbax refuses them.
"""

import json
import logging
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from mcx_jax.errors import UserError

FORMAT = 1
KEEP = 2
FOLDER = "checkpoints"


def save(run_dir: Path, iteration: int, state: Any) -> None:
    """Write the state after `iteration` iterations; whole or not at all, and only once."""
    if latest(run_dir) == iteration:
        return
    args, flat = _orbax().args, _flatten(state)
    meta = {"format": FORMAT, "iteration": iteration, "leaves": _types(flat)}
    items = args.Composite(state=args.StandardSave(flat), meta=args.JsonSave(meta))
    with _manager(run_dir) as manager:
        manager.save(iteration, args=items, force=True)
        manager.wait_until_finished()


def latest(run_dir: Path) -> int | None:
    """Iteration of the newest whole checkpoint; None if there is none. Needs no JAX device."""
    folder = run_dir / FOLDER
    # An unfinished checkpoint has another name until it is renamed.
    steps = [int(p.name) for p in folder.glob("*") if p.name.isdigit()] if folder.is_dir() else []
    return max(steps, default=None)


def restore_latest(run_dir: Path, like: Any) -> Any:
    """The newest state.

    Args:
        like: a state, or its shapes (`jax.eval_shape`).

    Raises:
        UserError: no checkpoint, an unreadable one, or one of another shape.
    """
    iteration = latest(run_dir)
    if iteration is None:
        raise UserError(f"{run_dir}: no checkpoint to go on from; start without --resume")
    where = f"{run_dir / FOLDER / str(iteration)}"
    wanted = _flatten(like)
    _check(where, _meta(Path(where)), _types(wanted))
    args = _orbax().args
    try:
        with _manager(run_dir) as manager:
            items = args.Composite(state=args.StandardRestore(wanted))
            stored = manager.restore(iteration, args=items).state
    except (ValueError, KeyError, OSError, TypeError) as error:
        reason = (str(error).strip() or type(error).__name__).splitlines()[0][:120]
        raise UserError(f"{where}: cannot be restored ({reason})") from None
    return _unflatten(like, stored)


def _types(flat: dict[str, Any]) -> dict[str, str]:
    """Type and shape of every leaf, like float32[3, 4]."""
    return {path: f"{leaf.dtype}{list(leaf.shape)}" for path, leaf in flat.items()}


def _meta(folder: Path) -> dict[str, Any]:
    try:
        meta = json.loads((folder / "meta" / "metadata").read_text())
        return {"format": meta["format"], "leaves": meta.get("leaves", {})}
    except (OSError, ValueError, KeyError, AttributeError, TypeError):
        raise UserError(f"{folder}: not a checkpoint of mcx_jax, or damaged") from None


def _check(where: str, meta: dict[str, Any], wanted: dict[str, str]) -> None:
    """Refuse what does not fit before orbax starts to read."""
    if meta["format"] != FORMAT:
        raise UserError(
            f"{where}: checkpoint of format {meta['format']}; this version reads {FORMAT}"
        )
    found = meta["leaves"]
    for path in sorted({*wanted, *found}):
        ours, theirs = wanted.get(path, "nothing"), found.get(path, "nothing")
        if ours != theirs:
            raise UserError(
                f"{where}: cannot be restored: {path} is {theirs} there and {ours} here"
            )


def _orbax() -> Any:
    """orbax.checkpoint, loaded late (it takes seconds) and quiet about its own workings."""
    import orbax.checkpoint as ocp

    logging.getLogger("absl").setLevel(logging.ERROR)
    return ocp


def _manager(run_dir: Path) -> Any:
    ocp = _orbax()
    options = ocp.CheckpointManagerOptions(max_to_keep=KEEP, enable_async_checkpointing=False)
    return ocp.CheckpointManager((run_dir / FOLDER).absolute(), options=options)


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _flatten(tree: Any) -> dict[str, Any]:
    """{path: array or its shape}, keys as raw data, nothing without elements."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    flat = {jax.tree_util.keystr(path): _raw(leaf) for path, leaf in leaves}
    return {path: leaf for path, leaf in flat.items() if leaf.size}


def _raw(leaf: Any) -> Any:
    if not isinstance(leaf, jax.ShapeDtypeStruct):
        return jax.random.key_data(leaf) if _is_key(leaf) else leaf
    if _is_key(leaf):
        leaf = jax.eval_shape(jax.random.key_data, leaf)
    sharding = leaf.sharding or jax.sharding.SingleDeviceSharding(jax.devices()[0])
    return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding)


def _unflatten(like: Any, flat: dict[str, Any]) -> Any:
    def leaf_of(path: Any, leaf: Any) -> Any:
        stored = flat.get(jax.tree_util.keystr(path))
        if stored is None:
            return jnp.zeros(leaf.shape, leaf.dtype)
        return jax.random.wrap_key_data(stored) if _is_key(leaf) else stored

    return jax.tree_util.tree_map_with_path(leaf_of, like)
