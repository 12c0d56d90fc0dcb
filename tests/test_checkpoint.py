"""Checkpoints: exact, two kept, and one clear line for one that cannot be read."""

import gc
import json
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from mcx_jax import checkpoint
from mcx_jax.errors import UserError


@struct.dataclass
class State:
    """What a training state has: nested arrays, keys, an empty array, something absent."""

    weights: dict
    keys: jax.Array
    empty: jax.Array
    count: jax.Array
    flag: jax.Array
    absent: None = None


def _state(seed=0):
    key = jax.random.key(seed)
    return State(
        weights={"a": jax.random.normal(key, (3, 4)), "b": {"c": jnp.arange(3)}},
        keys=jax.random.split(key, 5),
        empty=jnp.zeros((0, 5)),
        count=jnp.int32(seed),
        flag=jnp.asarray(True),
    )


def _same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert x.dtype == y.dtype
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        np.testing.assert_array_equal(x, y)


def test_restored_exactly(tmp_path):
    checkpoint.save(tmp_path, 3, _state(1))
    _same(checkpoint.restore_latest(tmp_path, _state(2)), _state(1))
    shapes = jax.eval_shape(_state)
    _same(checkpoint.restore_latest(tmp_path, shapes), _state(1))


def test_the_newest_of_two(tmp_path):
    assert checkpoint.latest(tmp_path) is None
    for iteration in (2, 5, 9):
        checkpoint.save(tmp_path, iteration, _state(iteration))
    assert checkpoint.latest(tmp_path) == 9
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir()) == ["5", "9"]
    assert checkpoint.restore_latest(tmp_path, _state()).count == 9


def test_nothing_to_restore(tmp_path):
    with pytest.raises(UserError) as error:
        checkpoint.restore_latest(tmp_path, _state())
    assert str(error.value) == f"{tmp_path}: no checkpoint to go on from; start without --resume"


def test_unfinished_checkpoint_is_not_taken(tmp_path):
    checkpoint.save(tmp_path, 2, _state(2))
    (tmp_path / "checkpoints" / "4.orbax-checkpoint-tmp-17").mkdir()
    assert checkpoint.latest(tmp_path) == 2
    assert checkpoint.restore_latest(tmp_path, _state()).count == 2


def test_of_another_format(tmp_path):
    checkpoint.save(tmp_path, 2, _state())
    meta = tmp_path / "checkpoints" / "2" / "meta" / "metadata"
    assert json.loads(meta.read_text())["format"] == 1
    meta.write_text(json.dumps({"format": 9}))
    with pytest.raises(UserError, match="checkpoint of format 9; this version reads 1"):
        checkpoint.restore_latest(tmp_path, _state())
    meta.unlink()
    with pytest.raises(UserError, match="not a checkpoint of mcx_jax, or damaged"):
        checkpoint.restore_latest(tmp_path, _state())


def test_of_another_shape(tmp_path):
    checkpoint.save(tmp_path, 2, _state())
    where = f"{tmp_path / 'checkpoints' / '2'}: cannot be restored: "
    for change, message in [
        ({"count": jnp.zeros((7,), jnp.int32)}, ".count is int32[] there and int32[7] here"),
        ({"flag": jnp.zeros(())}, ".flag is bool[] there and float32[] here"),
        ({"absent": jnp.zeros(3)}, ".absent is nothing there and float32[3] here"),
        ({"count": None}, ".count is int32[] there and nothing here"),
    ]:
        with pytest.raises(UserError) as error:
            checkpoint.restore_latest(tmp_path, _state().replace(**change))
        assert str(error.value) == where + message


def test_damaged(tmp_path, monkeypatch):
    # When one array cannot be read, orbax's threads for the others report to an event loop that is
    # closed by then; that reaches this hook only, now or a moment later.
    monkeypatch.setattr(sys, "unraisablehook", lambda _: None)
    checkpoint.save(tmp_path, 2, _state())
    for file in (tmp_path / "checkpoints" / "2" / "state").rglob("*"):
        if file.is_file() and file.name != "_METADATA":
            file.write_bytes(b"")
    with pytest.raises(UserError, match="cannot be restored"):
        checkpoint.restore_latest(tmp_path, _state())
    time.sleep(0.5)
    gc.collect()
