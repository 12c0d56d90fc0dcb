"""Checkpoints: exact, two kept, and one clear line for one that cannot be read."""

import errno
import json
import os
import re
import resource
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from mcx_jax.errors import UserError
from mcx_jax.runs import checkpoint

CONFIG = '{\n "seed": 0,\n "seeds": 1\n}\n'


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


def test_restored_exactly(tmp_path, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--these")
    checkpoint.save(tmp_path, 3, _state(1))
    assert checkpoint.check(tmp_path, 3)["xla_flags"] == "--these"
    _same(checkpoint.restore(tmp_path, _state(2)), _state(1))
    shapes = jax.eval_shape(_state)
    _same(checkpoint.restore(tmp_path, shapes), _state(1))


@pytest.mark.parametrize("name", ["r[1]", "a*b", "a?b", "a\\b", "a b", "$x", "\udcff", "{a}#%20"])
def test_a_directory_of_any_name(name, tmp_path):
    """In place, not in another directory whose name a pattern matches (a\\b was a/b)."""
    run, other = tmp_path / name, tmp_path / "aXb"
    checkpoint.save(other, 3, _state(2))
    checkpoint.save(run, 3, _state(1))
    assert sorted(tmp_path.iterdir()) == sorted([run, other])
    _same(checkpoint.restore(run, _state(2)), _state(1))


def test_the_newest_of_two(tmp_path):
    assert checkpoint.latest(tmp_path) is None
    for iteration in (2, 5, 9):
        checkpoint.save(tmp_path, iteration, _state(iteration))
    assert checkpoint.latest(tmp_path) == 9
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir()) == ["5", "9"]
    assert checkpoint.restore(tmp_path, _state()).count == 9


def test_nothing_to_restore(tmp_path):
    with pytest.raises(UserError) as error:
        checkpoint.restore(tmp_path, _state())
    assert str(error.value) == f"{tmp_path}: no checkpoint to go on from; start without --resume"


def test_unfinished_checkpoint_is_not_taken(tmp_path):
    checkpoint.save(tmp_path, 2, _state(2))
    left = tmp_path / "checkpoints" / ".4.partial"
    (left / "state").mkdir(parents=True)
    assert checkpoint.latest(tmp_path) == 2
    assert checkpoint.restore(tmp_path, _state()).count == 2
    checkpoint.save(tmp_path, 4, _state(4))
    assert not left.exists() and checkpoint.restore(tmp_path, _state()).count == 4


def test_says_what_it_is(tmp_path):
    checkpoint.save(tmp_path, 2, _state(), CONFIG)
    content = checkpoint.check(tmp_path, 2, CONFIG)
    assert content["config"] == CONFIG and content["iteration"] == 2
    assert content["packages"]["jax"] == jax.__version__
    assert content["leaves"][".weights['a']"] == "float32[3, 4]"
    with pytest.raises(UserError) as error:
        checkpoint.check(tmp_path, 2, CONFIG.replace("0", "1"))
    assert '2: of another run: "seed": 0 there and "seed": 1 here; there is no' in str(error.value)


@pytest.mark.parametrize("found", [0, 1])
def test_of_an_old_format(found, tmp_path):
    """Formats 0 and 1 had their version in meta/metadata and no manifest."""
    meta = tmp_path / "checkpoints" / "2" / "meta"
    meta.mkdir(parents=True)
    (meta / "metadata").write_text(json.dumps({"format": found, "iteration": 2}))
    with pytest.raises(UserError) as error:
        checkpoint.restore(tmp_path, _state())
    assert f"2: checkpoint of format {found}; this version reads 3; go on with the version" in (
        str(error.value)
    )
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("found", [2, 9])
def test_of_another_format_with_a_manifest(found, tmp_path):
    checkpoint.save(tmp_path, 2, _state())
    (tmp_path / "checkpoints" / "2" / "manifest.json").write_text(f'{{"format": {found}}}')
    with pytest.raises(UserError, match=f"checkpoint of format {found}; this version reads 3"):
        checkpoint.restore(tmp_path, _state())


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
            checkpoint.restore(tmp_path, _state().replace(**change))
        assert str(error.value) == where + message


def _flip(content):
    return content[:-1] + bytes([content[-1] ^ 1]) if content else b"?"


@pytest.mark.parametrize("spoil", [_flip, lambda content: content[:-1]], ids=["bit", "cut"])
def test_every_damaged_file_is_refused(spoil, tmp_path):
    """Whatever happens to whatever file of a checkpoint, and the one before it is offered."""
    for iteration in (2, 4):
        checkpoint.save(tmp_path, iteration, _state(iteration))
    folder = tmp_path / "checkpoints" / "4"
    files = [p for p in folder.rglob("*") if p.is_file()]
    assert len(files) > 5
    for file in files:
        good = file.read_bytes()
        if not good and spoil is not _flip:
            continue
        file.write_bytes(spoil(good))
        with pytest.raises(UserError) as error:
            checkpoint.restore(tmp_path, _state())
        message = str(error.value)
        assert message.startswith(f"{folder}: damaged: ") or "not a checkpoint" in message
        assert message.endswith("go on from the one before it with --resume-from 2")
        file.write_bytes(good)
    assert checkpoint.restore(tmp_path, _state()).count == 4
    next(folder.glob("state/d/*")).unlink()
    with pytest.raises(UserError, match="damaged: state/d/.* is missing"):
        checkpoint.restore(tmp_path, _state())
    _same(checkpoint.restore(tmp_path, _state(), 2), _state(2))


def test_no_whole_checkpoint_left(tmp_path):
    for iteration in (2, 4):
        checkpoint.save(tmp_path, iteration, _state(iteration))
        (tmp_path / "checkpoints" / str(iteration) / "manifest.json").unlink()
    with pytest.raises(UserError) as error:
        checkpoint.restore(tmp_path, _state())
    assert str(error.value).endswith(
        "4: not a checkpoint of mcx_jax, or damaged; there is no other to go on from; start again "
        "with another --run-dir"
    )
    with pytest.raises(UserError, match="no checkpoint of iteration 3; there are: 2, 4"):
        checkpoint.check(tmp_path, 3)


@pytest.mark.parametrize("room", [0, 100, 500, 1500, "rename"])
def test_full_disk(room, tmp_path, monkeypatch, capfd):
    """A limit on the size of files fails in whatever writes, orbax's C++ included; 1500 bytes are
    too few for the manifest only."""
    checkpoint.save(tmp_path, 2, _state(2))
    if room == "rename":

        def full(self, target):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        monkeypatch.setattr(type(tmp_path), "rename", full)
    else:
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
    try:
        with pytest.raises(UserError) as error:
            checkpoint.save(tmp_path, 4, _state(4))
    finally:
        monkeypatch.undo()
        if room != "rename":
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    message = str(error.value)
    assert "\n" not in message and "the checkpoint of iteration 4 cannot be written (" in message
    after = "the checkpoint of iteration 2 is whole: fix this, then continue with --resume"
    assert after in message
    assert checkpoint.latest(tmp_path) == 2
    _same(checkpoint.restore(tmp_path, _state()), _state(2))
    checkpoint.save(tmp_path, 4, _state(4))
    _same(checkpoint.restore(tmp_path, _state()), _state(4))
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir()) == ["2", "4"]
    assert capfd.readouterr() == ("", "")


def test_nothing_is_unpickled(tmp_path):
    """Neither a checkpoint nor a policy nor a file that says it is one; in a process of its own,
    because an audit hook stays for ever."""
    np.savez(tmp_path / "evil.npz", metadata=np.array([print], dtype=object))
    done = subprocess.run(
        [sys.executable, "-c", NO_PICKLE, str(tmp_path)],
        cwd=Path(__file__).parent,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == "refused 0 1\n"


NO_PICKLE = """
import pickle, sys
from pathlib import Path
import jax, jax.numpy as jnp
from test_checkpoint import _same, _state
from mcx_jax.runs import checkpoint
from mcx_jax.errors import UserError
from mcx_jax.policy.file import Policy, PolicyMeta, load_policy, save_policy
from mcx_jax.policy.networks import init_params
from mcx_jax.policy.normalise import init_stats

run = Path(sys.argv[1])
checkpoint.save(run, 4, _state(4))
meta = PolicyMeta(obs_size=5, action_size=3, hidden=8)
params = init_params(meta.net, jax.random.key(0), 5)
save_policy(run / "policy.npz", Policy(params, init_stats((5,)), meta))

def forbidden(*args, **kwargs):
    raise AssertionError("unpickled")

found, loads, said = [], pickle.loads, []
sys.addaudithook(lambda event, args: found.append(args) if event == "pickle.find_class" else None)
pickle.load = pickle.loads = pickle.Unpickler = forbidden
_same(checkpoint.restore(run, _state()), _state(4))
load_policy(run / "policy.npz")
try:
    load_policy(run / "evil.npz")
except UserError:
    said.append("refused")
said.append(len(found))
loads(pickle.dumps(print))
print(*said, len(found))
"""


def test_nothing_in_the_package_unpickles_or_executes(repo_root):
    # A policy as .npz and a checkpoint are all that is read from a run besides JSON.
    bad = re.compile(
        r"import c?l?o?u?d?pickle|allow_pickle=True|(?<![.\w])(eval|exec)\(|joblib|dill"
    )
    for path in (repo_root / "mcx_jax").rglob("*.py"):
        assert not bad.search(path.read_text()), path
    assert bad.search("import pickle") and bad.search("x = eval(y)")
    assert not bad.search("policy_eval(x)") and not bad.search("jax.eval(x)")
