"""What is not finite is reset, left out, counted, and after ten iterations the end of the run."""

import functools
import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from probe_envs import ProbeEnv, make_probe
from test_first_order import CONFIG as FIRST_ORDER
from test_ppo_trainer import CONFIG as PPO

from mcx_jax.compute.sharding import env_mesh
from mcx_jax.config.task import EnvConfig
from mcx_jax.config.training import TrainConfig
from mcx_jax.errors import UserError
from mcx_jax.ppo.rollout import replace_broken
from mcx_jax.runs import checkpoint, divergence
from mcx_jax.runs.loop import train
from mcx_jax.runs.programs import Training, prepare
from mcx_jax.runs.run_dir import open_existing, open_new

# Two blocks of environments in both: environment 5 is not the one renewed first.
FIRST_ORDER = replace(FIRST_ORDER, env=EnvConfig(episode_steps=32))
CONFIGS = {"ppo": PPO, "first-order": FIRST_ORDER}
BROKEN = 5


@struct.dataclass
class Faulty:
    """The probe with faults: where its draw from a "motion table" is NaN, and what it makes of an
    action of its own (a NaN that a faulty policy would send)."""

    probe: ProbeEnv
    table: jax.Array
    """(4,) factors of the target; an episode uses one of them."""
    bad_action_at: jax.Array
    """Step of an episode whose action arrives as NaN, in the episodes of entry 0, ()."""

    obs_size = property(lambda self: self.probe.obs_size)
    action_size = property(lambda self: self.probe.action_size)

    def _entry(self, state):
        return jax.random.bits(state.key, dtype=jnp.uint32) % 4

    def reset(self, key):
        state = self.probe.reset(key)
        factor = self.table[self._entry(state)]
        return state.replace(obs=state.obs * factor, target=state.target * factor)

    def step(self, state, action):
        bad = (state.t == self.bad_action_at) & (self._entry(state) == 0)
        after = self.probe.step(state, jnp.where(bad, jnp.nan, action))
        finite = jnp.isfinite(after.queue).all() & jnp.isfinite(after.target)
        valid = state.metrics.valid & finite
        # The state stays broken until it is reset, as an arm's does.
        obs = jnp.where(finite, after.obs, jnp.nan)
        queue = jnp.where(finite, after.queue, jnp.nan)
        return after.replace(obs=obs, queue=queue, metrics=after.metrics.replace(valid=valid))


def faulty(table=(1.0, 1.0, 1.0, 1.0), bad_action_at=-1):
    probe = make_probe(scale=0.01, hold=True)
    return Faulty(probe, jnp.asarray(table, jnp.float32), jnp.int32(bad_action_at))


@functools.cache
def _training(algo) -> Training:
    return prepare(CONFIGS[algo], faulty(), env_mesh(1))


def _run(algo, iterations, env=None, plant=None):
    """States and metrics of some iterations; `plant` changes the first state."""
    training = replace(_training(algo), env=env or faulty())
    state = training.start()
    state = plant(state) if plant else state
    rows = []
    for i in range(iterations):
        state, metrics = training.iterate(state, i)
        rows.append({name: float(value) for name, value in vars(metrics).items()})
    return state, rows


def _learned(state):
    """Weights, optimisers and statistics."""
    return checkpoint.flatten(state.replace(actors=None))


def _assert_finite(state):
    for path, leaf in _learned(state).items():
        assert np.isfinite(leaf).all(), path


@pytest.mark.parametrize("algo", CONFIGS)
def test_nothing_is_reset_without_a_fault(algo):
    _, rows = _run(algo, 3)
    assert [row["reset_envs"] for row in rows] == [0.0] * 3
    assert [row["lost"] for row in rows] == [0.0] * 3


@pytest.mark.parametrize("algo", CONFIGS)
def test_a_broken_environment_is_reset_and_reaches_nobody(algo):
    """NaN in one environment's state: bit for bit the run in which somebody had put the fresh
    environment there by hand."""
    config, training = CONFIGS[algo], _training(algo)

    def plant(state):
        env_state = state.actors.env_state
        queue = env_state.queue.at[1, BROKEN].set(jnp.nan)
        actors = replace(state.actors, env_state=env_state.replace(queue=queue))
        return state.replace(actors=actors)

    def by_hand(state):
        per_shard = config.num_envs // config.shards
        shard, place = divmod(BROKEN, per_shard)
        size = config.block_envs // config.shards
        fresh = training._fresh(config.reset_groups)
        env_state = jax.tree.map(
            lambda old, new: old.at[..., BROKEN].set(new[..., shard * size + place % size]),
            state.actors.env_state,
            fresh,
        )
        return state.replace(actors=replace(state.actors, env_state=env_state))

    state, rows = _run(algo, 2, plant=plant)
    assert [row["reset_envs"] for row in rows] == [1.0, 0.0]
    _assert_finite(state)
    other, other_rows = _run(algo, 2, plant=by_hand)
    assert other_rows[0].pop("reset_envs") == 0.0 and rows[0].pop("reset_envs") == 1.0
    assert rows == other_rows
    flat, other = checkpoint.flatten(state), checkpoint.flatten(other)
    for path, leaf in flat.items():
        np.testing.assert_array_equal(leaf, other[path], err_msg=path)


@pytest.mark.parametrize("algo", CONFIGS)
def test_nan_in_a_motion_table(algo):
    """A quarter of the episodes are NaN from the reset on: a reset is no cure for those that draw
    the entry again, and nobody else is the worse for it."""
    state, rows = _run(algo, 6, faulty(table=(jnp.nan, 1.0, 1.0, 1.0)))
    _assert_finite(state)
    for row in rows:
        assert row["reset_envs"] > 0
        assert 0.0 < row["rejected_share"] < 0.6
    assert all(row["lost"] == 0 for row in rows) == (algo == "ppo")


@pytest.mark.parametrize("algo", CONFIGS)
def test_nan_in_an_action(algo):
    """In a quarter of the episodes, in the first window (PPO) or the second (first-order)."""
    state, rows = _run(algo, 6, faulty(bad_action_at=2 if algo == "ppo" else 10))
    _assert_finite(state)
    assert sum(row["reset_envs"] for row in rows) > 0
    assert max(row["rejected_share"] for row in rows) < 0.6
    if algo == "ppo":
        assert sum(row["skipped_updates"] for row in rows) == 0
    else:  # the whole window's gradient is not finite
        assert sum(row["skipped_updates"] for row in rows) > 0
        assert all(row["lost"] == 0 for row in rows)


def _nan_weight(state):
    """NaN in one of the policy's weights."""
    fitted = state.learner.policy
    params = jax.tree.map(jnp.copy, fitted.params)
    params["params"]["net"]["head"]["bias"] = params["params"]["net"]["head"]["bias"] * jnp.nan
    learner = replace(state.learner, policy=replace(fitted, params=params))
    return state.replace(learner=learner)


@pytest.mark.parametrize("algo", CONFIGS)
def test_a_gradient_that_is_not_finite_is_skipped_and_counted(algo):
    before = _nan_weight(_training(algo).start())
    state, (row,) = _run(algo, 1, plant=_nan_weight)
    config = CONFIGS[algo]
    updates = config.ppo.epochs * config.ppo.minibatches
    # All of the policy's; the value network, with nothing to learn from, has a gradient of 0.
    assert row["skipped_updates"] == (updates if algo == "ppo" else config.first_order.windows)
    assert row["lost"] == 1.0 and row["rejected_share"] == 1.0
    policy = before.learner.policy, state.learner.policy
    for one, other in zip(*map(jax.tree.leaves, policy), strict=True):
        np.testing.assert_array_equal(one, other)
    for path, leaf in _learned(state).items():
        assert "head']['bias']" in path or np.isfinite(leaf).all(), path


@pytest.mark.parametrize("shards", [1, 2])
def test_who_is_replaced_by_whom(shards):
    """Environment i of a shard by number i mod n of the shard's fresh ones."""
    state = _training("ppo").start()
    actors, envs, size = state.actors, PPO.num_envs, 4
    obs = actors.env_state.obs.at[2, jnp.asarray([0, 3, 62])].set(jnp.inf)
    memory = actors.policy_carry.replace(h=actors.policy_carry.h.at[7, 1].set(jnp.nan))
    memory = jax.tree.map(lambda x: x.at[8].set(3.0), memory)
    actors = replace(actors, env_state=actors.env_state.replace(obs=obs), policy_carry=memory)
    fresh = jax.tree.map(lambda x: x[..., : shards * size], state.actors.env_state)
    fresh = fresh.replace(t=100 + jnp.arange(shards * size))
    new, count = jax.jit(replace_broken, static_argnums=2)(actors, fresh, shards)
    expected = np.zeros(envs, int)
    for i in (0, 3, 7, 62):
        shard, place = divmod(i, envs // shards)
        expected[i] = 100 + shard * size + place % size
    np.testing.assert_array_equal(new.env_state.t, expected)
    assert float(count) == 4
    assert bool((new.policy_carry.h[7] == 0).all()) and bool((new.policy_carry.c[8] == 3).all())
    kept = [i for i in range(envs) if i not in (0, 3, 7, 62)]
    np.testing.assert_array_equal(new.env_state.obs[:, kept], obs[:, kept])


def _make(**faults):
    def make_env(env_config, motion_config, split):
        return faulty(**faults)

    return make_env


@pytest.mark.parametrize("algo", CONFIGS)
def test_ten_lost_iterations_end_the_run(algo, tmp_path, monkeypatch, capsys):
    """Weights that become NaN (planted after iteration 3) are never saved; the checkpoints of
    before stay, and what happened is in a file."""
    iterate, path = Training.iterate, tmp_path / "run"

    def spoilt(self, state, iteration):
        return iterate(self, _nan_weight(state) if iteration == 3 else state, iteration)

    monkeypatch.setattr(Training, "iterate", spoilt)
    config = CONFIGS[algo]
    with pytest.raises(UserError) as error:
        train(open_new(path, config), _make(), checkpoint_interval_s=0.0)
    message = str(error.value)
    # PPO: the other half was just renewed. First-order: half in the first window, then all.
    skipped, reset = (8, 32) if algo == "ppo" else (2, 48)
    what = "windows" if algo == "ppo" else "steps"
    assert message == (
        f"{path}: stopped at iteration 13: nothing was learned in 10 iterations in a row (in the "
        f"last one 100 % of the {what} were left out, {skipped} updates skipped, "
        f"{reset} environments reset); the checkpoint of iteration 3 is kept, the states "
        f"are in {path / 'diverged-13.npz'}; start another run with a smaller step size or another "
        "--seed"
    )
    assert sorted(p.name for p in (path / "checkpoints").iterdir()) == ["2", "3"]
    state = checkpoint.restore(path, _training(algo).like)
    _assert_finite(state)
    with np.load(path / "diverged-13.npz", allow_pickle=False) as dump:
        assert json.loads(str(dump["rows"]))[0]["iteration"] == 13
        assert int(dump["before.iteration"]) == 12 and int(dump["after.iteration"]) == 13
        assert dump["before.action"].shape == (config.num_envs, 2)
        assert np.isnan(dump["before.action"]).all()
        for name in ("before", "after"):
            assert f"{name}.actors.env_state.obs" in dump
            assert f"{name}.learner.policy.params['params']['raw_sigma']" in dump
    # Gone on with, without the fault, it is the run that never had one.
    monkeypatch.undo()
    assert open_existing(path, config).start_iteration == 3


def test_weights_that_are_not_finite_are_not_saved_at_the_end(tmp_path, monkeypatch):
    config, path = replace(PPO, total_steps=2 * PPO.steps_per_iteration), tmp_path / "run"
    iterate = Training.iterate

    def spoilt(self, state, iteration):
        state, metrics = iterate(self, state, iteration)
        return _nan_weight(state), metrics

    monkeypatch.setattr(Training, "iterate", spoilt)
    with pytest.raises(UserError, match=r"stopped at iteration 2: .*\['bias'\] is not finite; the"):
        train(open_new(path, config), _make())
    assert checkpoint.latest(path) is None and not (path / "policy.npz").exists()
    assert (path / "diverged-2.npz").exists()


def test_lost_iterations_are_counted_across_a_resume(tmp_path):
    config: TrainConfig = PPO
    run = open_new(tmp_path / "run", config)
    with run.held():
        run.create()
        for i, lost in enumerate([1.0, 0.0, 1.0, 1.0, 1.0]):
            run.append([{"iteration": i + 1, "lost": lost}])
        assert divergence.Watch(run).lost == 3
