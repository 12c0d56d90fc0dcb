"""Back-propagation through the environment, on probe environments (the real one in test_v2v)."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from probe_envs import ProbeEnv, make_probe

from mcx_jax.compute.sharding import env_mesh
from mcx_jax.config.task import EnvConfig
from mcx_jax.config.training import FirstOrderConfig, TrainConfig, preset_config
from mcx_jax.errors import UserError
from mcx_jax.first_order import trainer
from mcx_jax.runs.programs import prepare

CONFIG = replace(
    preset_config("fast", "first-order"),
    num_envs=32,
    total_steps=32 * 16 * 60,
    env=EnvConfig(episode_steps=16),
    first_order=FirstOrderConfig(horizon_steps=8, windows=2, learning_rate=3e-3),
    ppo=replace(TrainConfig().ppo, hidden=32),
)


@pytest.fixture(scope="module")
def training():
    return prepare(CONFIG, make_probe(), env_mesh(1))


def run(training, env, iterations=60):
    training = replace(training, env=env)
    state, errors = training.start(), []
    for i in range(iterations):
        state, metrics = training.iterate(state, i)
        errors.append(float(metrics.pos_error_mm) / 1e3)
    return state, metrics, errors


def test_learns_to_repeat_what_it_sees(training):
    _, _, errors = run(training, make_probe())
    # Targets are uniform in -1..1: the squared error of a zero action is 1/3.
    assert errors[0] > 0.2 and errors[-1] < 0.01, (errors[0], errors[-1])


def test_learns_to_remember_what_it_saw_first(training):
    """The second window of an episode has only the memory that the first one left."""
    _, _, errors = run(training, make_probe(hold=True), 120)
    assert errors[-1] < 0.1, errors[-1]


def loss_and_gradient(env, state):
    """params -> (loss of a window, its gradient), and params away from the kink of |action[1]| at
    0, where a new policy begins."""

    def window(params):
        return trainer.window_gradient(params, CONFIG, env, state.obs_stats, state.actors)[:2]

    return jax.jit(window), jax.tree.map(lambda p: p + 0.1, state.learner.policy.params)


def dot(a, b) -> float:
    return float(
        sum(jnp.vdot(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))
    )


def slope_along(direction, window, params) -> float:
    """Central difference of the loss along a direction, per unit of length."""
    size = 1e-2 / dot(direction, direction) ** 0.5
    ends = [jax.tree.map(lambda p, d, s=s: p + s * d, params, direction) for s in (size, -size)]
    return float((window(ends[0])[0] - window(ends[1])[0]) / 2e-2)


def test_gradient_equals_a_central_difference(training):
    window, params = loss_and_gradient(training.env, training.start())
    _, grads = window(params)
    # Along the gradient the slope is its norm. float32 rounding of the loss (6e-8 / 2e-2 = 3e-6)
    # and the third derivative times 1e-2 squared.
    want = dot(grads, grads) ** 0.5
    np.testing.assert_allclose(slope_along(grads, window, params), want, rtol=1e-2)


@struct.dataclass
class EchoEnv(ProbeEnv):
    """A probe whose next observation is shifted by the action."""

    integrator: str = struct.field(pytree_node=False, default="")

    def step(self, state, action):
        after = super().step(state, action)
        return after.replace(obs=after.obs.at[0].add(action[0]))


def test_the_gradient_through_what_is_seen_is_whole_where_servos_do_not_chatter(training):
    fields = {name: getattr(training.env, name) for name in ProbeEnv.__dataclass_fields__}
    state, grads = training.start(), {}
    for integrator in ("quiet-smooth", "euler-smooth"):
        window, params = loss_and_gradient(EchoEnv(**fields, integrator=integrator), state)
        grads[integrator] = window(params)[1]
    whole = grads["quiet-smooth"]
    left_out = jax.tree.map(jnp.subtract, whole, grads["euler-smooth"])
    length = dot(left_out, left_out) ** 0.5
    assert length > 1e-2
    # Along what the other one leaves out, by which its slope would be too small.
    slope = slope_along(left_out, window, params)
    assert abs(slope - dot(whole, left_out) / length) < 0.1 * length


def test_relative_loss_by_hand(training):
    """f log(1 + e / f) of every environment's mean errors; with a large f as without it."""
    env, state = training.env, training.start()

    def window(relative_mm):
        config = replace(CONFIG, first_order=replace(CONFIG.first_order, relative_mm=relative_mm))
        params = jax.tree.map(lambda p: p + 0.1, state.learner.policy.params)
        arguments = config, env, state.obs_stats, state.actors
        loss, _, (_, _, metrics) = trainer.window_gradient(params, *arguments)
        return float(loss), metrics

    plain, metrics = window(0.0)
    means = np.stack([np.mean(e, axis=0) for e in (metrics.pos_error_m, metrics.ang_error_rad)])
    np.testing.assert_allclose(plain, means.sum(0).mean(), rtol=1e-6)  # float32 sums
    relative = 0.05 * np.log(1 + means / 0.05)
    np.testing.assert_allclose(window(50.0)[0], relative.sum(0).mean(), rtol=1e-5)
    np.testing.assert_allclose(window(1e7)[0], plain, rtol=1e-3)  # e / 2f: 12 / 20,000 at most


def test_failed_environments_are_never_learned_from(training):
    state, metrics, _ = run(training, make_probe(fail_at=5), 3)
    # Both windows of 8 steps: invalid and NaN from step 5 on, and reset before the next.
    assert float(metrics.invalid_share) == 0.5 and float(metrics.reset_envs) == 32
    assert float(metrics.skipped_updates) == 2 and float(metrics.lost) == 1
    assert all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves(state.learner.policy.params))
    assert bool(jnp.isfinite(state.obs_stats.mean).all())


def test_the_world_gets_a_useful_derivative():
    class World:
        integrator = "euler"

        def replace(self, **changes):
            return changes

    assert trainer.training_env(World()) == {"integrator": "euler-smooth"}


def test_refuses_what_cannot_be_differentiated():
    with pytest.raises(UserError, match="--algo first-order needs --physics chain"):
        replace(CONFIG, env=replace(CONFIG.env, physics="mjx"))


def test_refuses_a_horizon_that_does_not_divide_the_episode():
    message = "--episode-steps 1000 must be a multiple of --horizon-steps times --windows 70"
    with pytest.raises(UserError, match=message):
        replace(preset_config("fast", "first-order"), first_order=FirstOrderConfig(7, 10))
