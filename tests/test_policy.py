"""The policy file: same actions after loading, and one clear line for a file that is not one."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mcx_jax.controllers.by_name import load_controller
from mcx_jax.errors import UserError
from mcx_jax.policy.file import (
    LARGEST,
    Policy,
    PolicyController,
    PolicyMeta,
    act,
    init_carry,
    load_policy,
    require_task,
    save_policy,
)
from mcx_jax.policy.networks import init_params
from mcx_jax.policy.normalise import RunningStats


@pytest.fixture(scope="module")
def policy():
    meta = PolicyMeta(obs_size=5, action_size=3, hidden=8, config='{"a": 1}', iteration=7, seed=2)
    stats = RunningStats(jnp.ones(()), jnp.linspace(0, 1, 5), jnp.linspace(1, 2, 5))
    return Policy(init_params(meta.net, jax.random.key(0), 5), stats, meta)


@pytest.fixture
def saved(policy, tmp_path):
    path = tmp_path / "policy.npz"
    save_policy(path, policy)
    return path


def test_acts_the_same_after_loading(policy, saved):
    loaded = load_policy(saved)
    assert loaded.meta == policy.meta
    jax.tree.map(np.testing.assert_array_equal, loaded.params, policy.params)
    jax.tree.map(np.testing.assert_array_equal, loaded.obs_stats, policy.obs_stats)
    assert [p.name for p in saved.parent.iterdir()] == ["policy.npz"]


def test_one_environment_or_a_batch(policy):
    obs = jax.random.normal(jax.random.key(1), (4, 5))
    _, together = act(policy, init_carry(policy, (4,)), obs)
    for k in range(4):
        carry, alone = act(policy, init_carry(policy), obs[k])
        np.testing.assert_allclose(alone, together[k], atol=1e-6)
    assert alone.shape == (3,) and carry.h.shape == (8,)


def test_controller_under_vmap_with_the_batch_last(policy):
    class State:
        obs = None

    obs = jax.random.normal(jax.random.key(1), (5, 4))
    controller = PolicyController(policy)

    def one(memory, obs):
        state = State()
        state.obs = obs
        return controller.act(None, state, memory)

    memory = jax.tree.map(lambda x: jnp.stack([x] * 4, -1), controller.init(None, None))
    _, actions = jax.vmap(one, in_axes=-1, out_axes=-1)(memory, obs)
    np.testing.assert_allclose(
        actions.T, act(policy, init_carry(policy, (4,)), obs.T)[1], atol=1e-6
    )


def test_numpy_alone_reads_the_file(saved):
    with np.load(saved, allow_pickle=False) as file:
        metadata = json.loads(str(file["metadata"]))
        assert file["policy/net/head/kernel"].shape == (8, 3)
    assert metadata["format"] == 1 and metadata["obs_size"] == 5


def _refused(path, message):
    with pytest.raises(UserError) as error:
        load_policy(path)
    assert str(error.value) == message.format(path=path)


def test_missing(tmp_path):
    _refused(
        tmp_path / "none.npz",
        "no policy at {path}: train one (python -m mcx_jax.train), or name a policy .npz",
    )


@pytest.mark.parametrize("keep", [0, 10, 400, 0.5, 0.99])
def test_cut_short(saved, keep):
    whole = saved.read_bytes()
    saved.write_bytes(whole[: int(keep * len(whole)) if isinstance(keep, float) else keep])
    _refused(saved, "{path}: not a policy file of mcx_jax, or cut short")


def test_foreign(tmp_path):
    path = tmp_path / "other.npz"
    np.savez(path, x=np.zeros(3))
    _refused(path, "{path}: not a policy file of mcx_jax (no metadata of its kind)")
    for metadata in ("3", "[]"):
        np.savez(path, metadata=metadata)
        _refused(path, "{path}: not a policy file of mcx_jax (no metadata of its kind)")
    np.save(tmp_path / "array.npy", np.zeros(3))
    _refused(tmp_path / "array.npy", "{path}: not a policy file of mcx_jax, or cut short")


def _rewrite(path, **changes):
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    arrays.update(changes)
    np.savez(path, **{k: v for k, v in arrays.items() if v is not None})


def test_of_another_format(saved):
    with np.load(saved) as file:
        metadata = json.loads(str(file["metadata"]))
    _rewrite(saved, metadata=json.dumps({**metadata, "format": 9}))
    _refused(saved, "{path}: policy file of format 9; this version reads 1")


@pytest.mark.parametrize("cell", ["rnn", 3, ["lstm"]])
def test_of_an_unknown_cell(saved, cell):
    with np.load(saved) as file:
        metadata = json.loads(str(file["metadata"]))
    _rewrite(saved, metadata=json.dumps({**metadata, "cell": cell}))
    _refused(saved, "{path}: not a policy file of mcx_jax (no metadata of its kind)")


@pytest.mark.parametrize("value", [None, np.zeros(4)])
def test_without_a_weight(saved, value):
    _rewrite(saved, **{"policy/raw_sigma": value})
    _refused(saved, "{path}: not a whole policy file: policy/raw_sigma is missing or misshapen")


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("obs/var", np.array([1.0, 1.0, -1e-9, 1.0, 1.0]), "obs/var is negative"),
        ("obs/count", np.array(-1.0), "obs/count is negative"),
        *(
            ("obs/mean", np.array([0, 0, bad, 0, 0], np.float64), "obs/mean has no finite numbers")
            for bad in (np.nan, np.inf, 1e31, 1e300)
        ),
        ("policy/raw_sigma", np.zeros(3, int), "policy/raw_sigma has no finite numbers"),
        ("policy/raw_sigma", np.zeros(3, complex), "policy/raw_sigma has no finite numbers"),
    ],
)
def test_numbers_that_no_training_gives(saved, name, value, said):
    _rewrite(saved, **{name: value})
    with pytest.raises(UserError) as error:
        load_policy(saved)
    assert str(error.value).startswith(f"{saved}: not a policy that can act: {said}")


@pytest.mark.parametrize("dtype", [">f4", ">f8", "<f8", "longdouble"])
def test_every_kind_of_float_is_read_the_same(policy, saved, dtype):
    """Files of another machine: big-endian arrays ended in a TypeError."""
    with np.load(saved) as file:
        arrays = {name: file[name] for name in file.files}
    _rewrite(saved, **{k: v.astype(dtype) for k, v in arrays.items() if v.dtype.kind == "f"})
    loaded = load_policy(saved)
    jax.tree.map(np.testing.assert_array_equal, loaded.params, policy.params)
    jax.tree.map(np.testing.assert_array_equal, loaded.obs_stats, policy.obs_stats)


@pytest.mark.parametrize("cell", ["lstm", "gru"])
def test_the_largest_numbers_that_are_read_still_act(cell, tmp_path):
    meta = PolicyMeta(obs_size=5, action_size=3, hidden=8, cell=cell)
    params = init_params(meta.net, jax.random.key(0), 5)
    rng = np.random.default_rng(0)
    huge = lambda x: LARGEST * rng.choice([-1.0, 1.0], x.shape).astype(np.float32)  # noqa: E731
    stats = RunningStats(jnp.float32(LARGEST), jnp.full(5, LARGEST), jnp.full(5, 0.0))
    save_policy(tmp_path / "huge.npz", Policy(jax.tree.map(huge, params), stats, meta))
    loaded = load_policy(tmp_path / "huge.npz")
    carry = init_carry(loaded)
    for obs in (np.zeros(5), np.full(5, -1e30)):
        carry, action = act(loaded, carry, jnp.float32(obs))
        assert np.isfinite(action).all()


@pytest.mark.parametrize("change", [{"iteration": "7"}, {"iteration": -1}, {"seed": 0.5}])
def test_counts_that_are_none(saved, change):
    with np.load(saved) as file:
        metadata = json.loads(str(file["metadata"]))
    _rewrite(saved, metadata=json.dumps({**metadata, **change}))
    _refused(saved, "{path}: not a policy file of mcx_jax (no metadata of its kind)")


@pytest.mark.parametrize(("read", "given"), [(38, 3), (39, 7), (5, 6), (37, 6), (40, 6)])
def test_a_policy_of_another_task_is_refused_by_name(read, given):
    with pytest.raises(UserError) as error:
        require_task("other.npz", PolicyMeta(obs_size=read, action_size=given, hidden=4))
    assert str(error.value) == (
        f"other.npz: reads {read} numbers and gives {given}; a policy for this task reads 38 or 39 "
        "and gives 6"
    )


def test_no_command_takes_a_policy_of_another_task(saved):
    """One of three actions ended `evaluate` in a ValueError, after its compilation."""
    with pytest.raises(UserError, match="reads 5 numbers and gives 3; a policy for this task"):
        load_controller(str(saved))
    for observed in (38, 39):
        require_task("right.npz", PolicyMeta(obs_size=observed, action_size=6, hidden=4))
