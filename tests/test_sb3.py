"""Stable-Baselines3's PPO trains on the Gymnasium environment.

Slow set: the extra `sb3` brings PyTorch, 3 GB on Linux; without it the test is skipped.
"""

import numpy as np
import pytest

from mcx_jax.integrations.gym import ENV_ID

STEPS = 16
SETTINGS = {"delay": "E1", "sea": "Wa", "integrator": "implicitfast", "episode_steps": STEPS}


@pytest.mark.slow
# SB3 recommends actions in [-1, 1]; ours are in cm and crad.
@pytest.mark.filterwarnings("ignore:.*recommend.*symmetric and normalized:UserWarning")
def test_ppo_trains():
    sb3 = pytest.importorskip("stable_baselines3")
    import torch
    from stable_baselines3.common.env_checker import check_env
    from stable_baselines3.common.env_util import make_vec_env

    venv = make_vec_env(ENV_ID, n_envs=2, seed=0, env_kwargs=SETTINGS)
    check_env(venv.envs[0].unwrapped)  # pyright: ignore[reportAttributeAccessIssue]
    torch.set_num_threads(1)
    model = sb3.PPO("MlpPolicy", venv, n_steps=2 * STEPS, batch_size=32, seed=0, device="cpu")
    before = [p.detach().clone() for p in model.policy.parameters()]
    model.learn(4 * 2 * STEPS)
    assert model.num_timesteps == 4 * 2 * STEPS
    after = list(model.policy.parameters())
    assert all(torch.isfinite(p).all() for p in after)
    assert sum(bool((a != b).any()) for a, b in zip(after, before, strict=True)) == len(after)
    episodes = list(model.ep_info_buffer)
    assert [episode["l"] for episode in episodes] == [STEPS] * 8
    rewards = np.array([episode["r"] for episode in episodes])
    print("reward a step", rewards / STEPS)
    assert np.all(rewards < 0) and np.all(rewards / STEPS > -0.1)  # m + rad, sigma 1 cm and crad
