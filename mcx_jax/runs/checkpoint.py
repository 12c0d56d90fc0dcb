"""Checkpoints of a training state: written whole or not at all, verified, restored exactly.

    checkpoints/ITERATION/state/          the arrays, by orbax
    checkpoints/ITERATION/manifest.json   format, configuration, package versions, XLA_FLAGS, type
                                          and shape of every array, SHA-256 of every file
                                          and of the manifest

A checkpoint is made in `.ITERATION.partial` and gets its name by one rename when all of it, the
manifest last, is on the disk. A state is stored as a flat dictionary {path of the leaf: array},
PRNG keys as their raw data, so that a checkpoint does not depend on how orbax treats our classes,
and a mismatch can be named. Leaves without elements (a delay line of length 0) are left out: orbax
refuses them. Nothing is unpickled or executed (docs/trust.md).
"""

import contextlib
import hashlib
import json
import logging
import os
import platform
import shutil
import sys
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from mcx_jax.compute import processes
from mcx_jax.errors import UserError, reason

FORMAT = 3
KEEP = 2
FOLDER = "checkpoints"
MANIFEST = "manifest.json"
STATE = "state"
PACKAGES = ("mcx_jax", "jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "numpy", "mujoco")


class _Refused(Exception):
    """Why a checkpoint cannot be used."""


def save(run_dir: Path, iteration: int, state: Any, config: str = "") -> None:
    """Write the state after `iteration` iterations; whole or not at all, and only once.

    Of several processes (`mcx_jax.compute.processes`) all must call this, and the first one writes.

    Args:
        config: the run's configuration (`cli.config_to_json`).

    Raises:
        UserError: it cannot be written; the checkpoints that were there still are.
    """
    folder = (run_dir / FOLDER).absolute()
    flat = processes.whole(flatten(state))
    if not processes.first() or latest(run_dir) == iteration:
        return
    partial = folder / f".{iteration}.partial"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for left in folder.glob(".*.partial"):  # by a killed process
            shutil.rmtree(left)
        partial.mkdir()
        ocp = _orbax()
        with _checkpointer(ocp) as writer, _plain_name(partial) as inside:
            writer.save(inside / STATE, args=ocp.args.StandardSave(flat))
        _write_manifest(partial, iteration, config, _types(flat))
        partial.rename(folder / str(iteration))
        _sync(folder)
        for old in _iterations(run_dir)[:-KEEP]:
            # Renamed first: half a directory must never look like a checkpoint.
            gone = (folder / str(old)).rename(folder / f".{old}.partial")
            shutil.rmtree(gone)
    except (OSError, ValueError) as error:  # ValueError: tensorstore's
        shutil.rmtree(partial, ignore_errors=True)
        last = latest(run_dir)
        kept = f"the checkpoint of iteration {last} is whole" if last else "there is none yet"
        raise UserError(
            f"{folder}: the checkpoint of iteration {iteration} cannot be written "
            f"({reason(error)}); {kept}: fix this, then continue with --resume"
        ) from None


def latest(run_dir: Path) -> int | None:
    """Iteration of the newest checkpoint; None if there is none. Needs no JAX device."""
    return max(_iterations(run_dir), default=None)


def check(run_dir: Path, iteration: int, config: str = "") -> dict[str, Any]:
    """The manifest of a checkpoint whose files are as they were written. Needs no JAX device.

    Args:
        config: the configuration that it must be of; "" = any.

    Raises:
        UserError: why it cannot be used, and from which one to go on instead.
    """
    where = run_dir / FOLDER / str(iteration)
    there = _iterations(run_dir)
    if iteration not in there:
        choice = f"there are: {', '.join(map(str, there))}" if there else "there is none"
        raise UserError(f"{run_dir}: no checkpoint of iteration {iteration}; {choice}")
    try:
        return _verified(where, config)
    except _Refused as refused:
        earlier = [i for i in reversed(there) if i < iteration and _usable(where.parent, i, config)]
        way_out = (
            f"go on from the one before it with --resume-from {earlier[0]}"
            if earlier
            else "there is no other to go on from; start again with another --run-dir"
        )
        raise UserError(f"{where}: {refused}; {way_out}") from None


def restore(run_dir: Path, like: Any, iteration: int | None = None) -> Any:
    """A state, bit for bit.

    Args:
        like: a state, or its shapes (`jax.eval_shape`); its shardings are where the arrays go.
        iteration: None = the newest.

    Raises:
        UserError: no checkpoint, a damaged one, or one of another shape.
    """
    iteration = latest(run_dir) if iteration is None else iteration
    if iteration is None:
        raise UserError(f"{run_dir}: no checkpoint to go on from; start without --resume")
    where = (run_dir / FOLDER / str(iteration)).absolute()
    wanted = flatten(like)
    _check_types(where, check(run_dir, iteration)["leaves"], _types(wanted))
    ocp = _orbax()
    # Read into the host's memory and laid out from there, which any number of processes can do.
    blank = {path: np.zeros(leaf.shape, leaf.dtype) for path, leaf in wanted.items()}
    try:
        with _checkpointer(ocp) as reader, _plain_name(where) as inside:
            stored = reader.restore(inside / STATE, args=ocp.args.StandardRestore(blank))
    except (ValueError, KeyError, OSError, TypeError) as error:
        raise UserError(f"{where}: cannot be restored ({reason(error)})") from None
    return _unflatten(like, {path: _laid_out(x, wanted[path]) for path, x in stored.items()})


def set_aside_after(run_dir: Path, iteration: int) -> None:
    """Give the checkpoints of later iterations names that are never restored: the run goes on from
    an earlier one and writes them again."""
    for later in _iterations(run_dir):
        if later > iteration:
            name = run_dir / FOLDER / f"{later}.set-aside"
            while name.exists():
                name = name.with_name(f"{name.name}+")
            (run_dir / FOLDER / str(later)).rename(name)


def flatten(tree: Any) -> dict[str, Any]:
    """{path: array or its shape}, keys as raw data, nothing without elements."""
    import jax

    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    flat = {jax.tree_util.keystr(path): _raw(leaf) for path, leaf in leaves}
    return {path: leaf for path, leaf in flat.items() if leaf.size}


def _iterations(run_dir: Path) -> list[int]:
    folder = run_dir / FOLDER
    return sorted(int(p.name) for p in folder.glob("*") if p.name.isdigit())


def _write_manifest(folder: Path, iteration: int, config: str, leaves: dict[str, str]) -> None:
    """The last file of a checkpoint; everything is on the disk when this returns."""
    files = [p for p in sorted(folder.rglob("*")) if p.is_file()]
    content = {
        "iteration": iteration,
        "config": config,
        "packages": _packages(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),  # on them the bits depend
        "leaves": leaves,
        "files": {p.relative_to(folder).as_posix(): _digest(p) for p in files},
    }
    whole = {"format": FORMAT, "sha256": _digest_of(content), "content": content}
    (folder / MANIFEST).write_text(json.dumps(whole, indent=1))
    for path in (*files, folder / MANIFEST, *(p for p in folder.rglob("*") if p.is_dir()), folder):
        _sync(path)


def _verified(folder: Path, config: str) -> dict[str, Any]:
    """The manifest's content, after every byte was compared with its checksum."""
    content = _manifest(folder)
    for name, digest in content["files"].items():
        path = folder / name
        if not os.path.isfile(path):
            raise _Refused(f"damaged: {name} is missing")
        if _digest(path) != digest:
            raise _Refused(f"damaged: {name} is not what was written")
    if config and content["config"] != config:
        theirs, ours = content["config"].splitlines(), config.splitlines()
        differ = [(a, b) for a, b in zip(theirs, ours, strict=False) if a != b] or [("?", "?")]
        there, here = (line.strip().rstrip(",") for line in differ[0])
        raise _Refused(f"of another run: {there} there and {here} here")
    return content


def _manifest(folder: Path) -> dict[str, Any]:
    try:
        whole = json.loads((folder / MANIFEST).read_text())
        found, content, digest = whole["format"], whole.get("content", {}), whole.get("sha256")
    except (OSError, ValueError, KeyError, AttributeError, TypeError, RecursionError):
        found, content, digest = _old_format(folder), {}, None
    if found is None:
        raise _Refused("not a checkpoint of mcx_jax, or damaged")
    if found != FORMAT:
        raise _Refused(
            f"checkpoint of format {found}; this version reads {FORMAT}; go on with the version of "
            "mcx_jax that wrote it"
        )
    if digest != _digest_of(content) or not _is_content(content):
        raise _Refused(f"damaged: {MANIFEST} is not what was written")
    return content


def _is_content(content: Any) -> bool:
    """Whether a manifest says what `_write_manifest` writes."""
    wanted = {"iteration": int, "config": str, "packages": dict, "leaves": dict, "files": dict}
    return isinstance(content, dict) and all(
        isinstance(content.get(name), kind) for name, kind in wanted.items()
    )


def _old_format(folder: Path) -> Any:
    """Format of a checkpoint from before there were manifests; None: not even that."""
    try:
        return json.loads((folder / "meta" / "metadata").read_text())["format"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


def _usable(folder: Path, iteration: int, config: str) -> bool:
    try:
        _verified(folder / str(iteration), config)
    except _Refused:
        return False
    return True


def _check_types(where: Path, found: dict[str, str], wanted: dict[str, str]) -> None:
    """Refuse what does not fit before orbax starts to read."""
    for path in sorted({*wanted, *found}):
        ours, theirs = wanted.get(path, "nothing"), found.get(path, "nothing")
        if ours != theirs:
            raise UserError(
                f"{where}: cannot be restored: {path} is {theirs} there and {ours} here"
            )


def _packages() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def _types(flat: dict[str, Any]) -> dict[str, str]:
    """Type and shape of every leaf, like float32[3, 4]."""
    return {path: f"{leaf.dtype}{list(leaf.shape)}" for path, leaf in flat.items()}


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _digest_of(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _sync(path: Path) -> None:
    """Wait until a file or a directory is on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _orbax() -> Any:
    """orbax.checkpoint, loaded late (it takes seconds) and quiet about its own workings."""
    import orbax.checkpoint as ocp

    # What goes wrong is raised here; orbax's threads and tasks log it as well, as tracebacks.
    for name in ("absl", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    if sys.unraisablehook is not _unraisable:
        _unraisable.before = sys.unraisablehook
        sys.unraisablehook = _unraisable
    return ocp


def _checkpointer(ocp: Any) -> Any:
    """A writer and reader that waits for no other process."""
    import jax

    me = jax.process_index()
    options = ocp.options.MultiprocessingOptions(primary_host=me, active_processes={me})
    return ocp.Checkpointer(ocp.StandardCheckpointHandler(), multiprocessing_options=options)


@contextlib.contextmanager
def _plain_name(folder: Path) -> Iterator[Path]:
    """Another name of a directory, for orbax: without characters of a user's directories.

    tensorstore takes a backslash for a slash (and writes somewhere else), orbax's search takes
    [, ], * and ? for patterns. Where there is no /proc the name stays what it is.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        name = Path(f"/proc/self/fd/{handle}")
        yield name if name.exists() else folder
    finally:
        os.close(handle)


def _unraisable(what: Any) -> None:
    """When one array fails, orbax's threads for the others report, now or a moment later, to an
    event loop that is closed by then. Everything else is shown as before."""
    if str(what.exc_value) != "Event loop is closed":
        _unraisable.before(what)


def _is_key(leaf: Any) -> bool:
    import jax

    return jax.numpy.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _raw(leaf: Any) -> Any:
    import jax

    if not isinstance(leaf, jax.ShapeDtypeStruct):
        return jax.random.key_data(leaf) if _is_key(leaf) else leaf
    if not _is_key(leaf):
        return leaf
    raw = jax.eval_shape(jax.random.key_data, leaf)
    sharding = leaf.sharding  # its axes are the raw data's first ones
    return jax.ShapeDtypeStruct(raw.shape, raw.dtype, sharding=sharding)


def _laid_out(stored: np.ndarray, like: Any) -> Any:
    """A stored array where its model lies."""
    import jax

    sharding = like.sharding or jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    return jax.make_array_from_callback(stored.shape, sharding, lambda part: stored[part])


def _unflatten(like: Any, flat: dict[str, Any]) -> Any:
    import jax

    def leaf_of(path: Any, leaf: Any) -> Any:
        stored = flat.get(jax.tree_util.keystr(path))
        if stored is None:
            return jax.numpy.zeros(leaf.shape, leaf.dtype)
        return jax.random.wrap_key_data(stored) if _is_key(leaf) else stored

    return jax.tree_util.tree_map_with_path(leaf_of, like)
