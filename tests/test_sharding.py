"""Environments over devices: the number of devices does not change what is computed."""

import json
import os
import subprocess
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mcx_jax.compute.sharding import ENV_AXIS, env_mesh, over_envs, put
from mcx_jax.config.task import EnvConfig
from mcx_jax.config.training import PPOConfig, TrainConfig, preset_config

RUN = """
import sys
from mcx_jax.compute import startup
startup.configure("cpu", cores=int(sys.argv[1]))
import jax, json
from probe_envs import make_probe
from mcx_jax.runs.programs import prepare
from test_sharding import CONFIGS
rows = []
for config in CONFIGS:
    training = prepare(config, make_probe())
    state = training.start()
    for i in range(3):
        state, metrics = training.iterate(state, i)
    obs = state.actors.env_state.obs
    layout = [len(x.sharding.device_set) for x in (obs, state.actors.policy_carry.h)]
    values = {k: jax.device_get(v).tolist() for k, v in vars(metrics).items()}
    rows.append({"devices": layout, "shape": list(obs.addressable_shards[0].data.shape), **values})
print(json.dumps(rows))
"""
PPO = TrainConfig(
    num_envs=64,
    env=EnvConfig(episode_steps=32),
    ppo=PPOConfig(window_steps=16, sequence_steps=8, minibatches=2, hidden=16),
)
CONFIGS = [
    replace(PPO, seeds=2),
    replace(
        preset_config("fast", "first-order"),
        num_envs=32,
        env=EnvConfig(episode_steps=200),
        ppo=PPO.ppo,
    ),
]


@pytest.fixture(scope="module")
def runs(repo_root):
    """Metrics of the same runs on one and on eight devices."""
    out = {}
    for cores in (1, 8):
        path = os.pathsep.join([str(repo_root), str(repo_root / "tests")])
        quick = "--xla_backend_optimization_level=0"  # two algorithms compiled twice
        environment = {**os.environ, "XLA_FLAGS": quick, "PYTHONPATH": path}
        command = [sys.executable, "-c", RUN, str(cores)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        out[cores] = json.loads(done.stdout)
    return out


@pytest.mark.parametrize("k", range(len(CONFIGS)), ids=["ppo, two seeds", "first-order"])
def test_eight_devices_compute_what_one_does(runs, k):
    one, eight = runs[1][k], runs[8][k]
    assert one.pop("devices") == [1, 1] and eight.pop("devices") == [8, 8]
    whole, part = one.pop("shape"), eight.pop("shape")
    assert part[:-1] == whole[:-1] and 8 * part[-1] == whole[-1]
    for name, value in one.items():
        if name == "first_ratio_deviation":  # itself a rounding
            continue
        # Sums in another order: 1e-7 at first, which 24 to 60 Adam steps amplify.
        np.testing.assert_allclose(eight[name], value, rtol=2e-3, atol=1e-4, err_msg=name)


def test_shards_are_whole_blocks_and_minibatches():
    assert TrainConfig().shards == 64  # 2048 environments: 32 a shard, one of them in each block
    assert preset_config("fast", "first-order").shards == 16  # 256: 16 a shard, blocks of two
    assert replace(TrainConfig(), num_envs=16).shards == 1  # fewer environments than blocks
    assert PPO.shards == 32
    for config in (TrainConfig(), PPO, preset_config("paper"), CONFIGS[1]):
        envs = config.num_envs // config.shards
        assert envs * config.shards == config.num_envs and envs >= config.reset_groups
        assert config.block_envs % config.shards == 0


def test_a_mesh_of_what_divides():
    assert env_mesh(7).size == 1 or 7 % env_mesh(7).size == 0
    mesh = env_mesh(1)
    assert mesh.axis_names == (ENV_AXIS,) and mesh.size == 1


def test_outside_a_mesh_nothing_is_laid_out():
    x = jnp.ones((3, 4))
    assert over_envs(x, -1) is x
    placed = put(env_mesh(1), {"a": x, "empty": jnp.ones((0, 4))}, -1)
    assert jax.tree.map(jnp.shape, placed) == {"a": (3, 4), "empty": (0, 4)}
