"""The compiled program piece by piece: environment, rollout, learner, whole training iteration."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from mcx_jax.arm import ik, lag
from mcx_jax.bench.timing import REPEATS, median_s, samples_s
from mcx_jax.compute.fusion import stage
from mcx_jax.compute.sharding import env_mesh, put
from mcx_jax.config.delay import CONTROL_DT_S, SUBSTEPS
from mcx_jax.config.training import TrainConfig
from mcx_jax.envs import observe, vessels
from mcx_jax.envs.state import ArmState, EnvState
from mcx_jax.envs.v2v import V2VEnv
from mcx_jax.ppo import rollout, trainer
from mcx_jax.ppo.experience import judge
from mcx_jax.ppo.update import learn
from mcx_jax.runs.programs import prepare
from mcx_jax.spatial import unpack

RESET_ENVS = 256
STEPS = 10
"""Control steps in a timed call of the environment."""


def reset(env: V2VEnv, envs: int) -> EnvState:
    """Environments at the start of an episode, over the devices, leaves (..., envs).

    A few different ones, repeated: compiled once for all sizes.
    """
    few = jax.jit(rollout.reset_all, static_argnums=2)(env, jax.random.key(0), RESET_ENVS)
    repeated = jax.tree.map(lambda x: jnp.concatenate([x] * (envs // RESET_ENVS), -1), few)
    return put(env_mesh(envs), repeated, -1)


def breakdown_us(env: V2VEnv, state: EnvState) -> dict[str, float]:
    """Microseconds that each part of a control step takes alone; in the whole they share work and
    caches, so they need not add up to it."""
    return {name: environment_us(env, state, part) for name, part in PARTS.items()}


def environment_us(env: V2VEnv, state: EnvState, step=V2VEnv.step) -> float:
    """Microseconds of one control step of one environment, no policy."""
    envs = state.step.shape[0]
    mesh = env_mesh(envs)
    env, action = put(mesh, (env, jnp.zeros((6,))))

    def many(env, state):
        one = jax.vmap(partial(step, env), in_axes=(-1, None), out_axes=-1)
        return jax.lax.fori_loop(0, STEPS, lambda _, s: one(s, action), state)

    run = jax.jit(many)
    return 1e6 * median_s(lambda: jax.block_until_ready(run(env, state))) / (STEPS * envs)


def _arm(env: V2VEnv, state: EnvState, _) -> EnvState:
    deck, _ = env._segments(state.track, state.step)
    rate = jnp.zeros_like(state.reference)
    arm = env._simulate(state.arm, state.reference, rate, deck, SUBSTEPS, state.conditions)
    return replace(state, arm=arm)


def _ik(env: V2VEnv, state: EnvState, _) -> EnvState:
    found = ik.solve(env.model, state.arm.q, state.measured.pose, ik.WARM_ITERATIONS, env.wall)
    return replace(state, arm=ArmState(q=found.q, qd=state.arm.qd))


def _vessels(env: V2VEnv, state: EnvState, _) -> EnvState:
    a, b = env._segments(state.track, state.step)
    _, position = stage(env.wall, vessels.goal_in_base, a, b, state.goal_m, SUBSTEPS)
    measured = replace(state.measured, position=jnp.stack(position))
    return replace(state, measured=measured, step=state.step + 1)


def _lag(env: V2VEnv, state: EnvState, _) -> EnvState:
    late, reference = lag.apply_one(env.delays, None, state.lag, state.arm.q)
    rate = (reference - state.reference) / CONTROL_DT_S
    return replace(state, lag=late, reference=reference + 0.0 * rate)


def _observe(env: V2VEnv, state: EnvState, _) -> EnvState:
    goal = state.measured.pose
    tool = ik.tool_pose(env.model, unpack(state.arm.q, env.model.nq), env.wall)
    errors = stage(env.wall, observe.tracking_error, goal, tool)
    return replace(state, obs=observe.observe(goal, tool, errors), reward=-(errors[0] + errors[1]))


PARTS = {"arm": _arm, "ik": _ik, "vessels": _vessels, "lag": _lag, "observe": _observe}


@dataclass(frozen=True)
class TrainingSpeed:
    """Control steps/s, and the learner's rate, to compare with the machine's matrix products."""

    rollout_steps_per_s: float
    training_steps_per_s: float
    learner_us_per_step: float
    learner_gflops: float
    """Useful floating-point operations of the learner's matrix products, 1e9/s."""


def training_speed(config: TrainConfig, env: V2VEnv, repeats: int) -> TrainingSpeed:
    """Time the rollout, the learner and the whole iteration of PPO."""
    # The KL stop would skip policy steps: here every planned step is computed.
    config = replace(config, ppo=replace(config.ppo, target_kl=1e6))
    ppo, nets = config.ppo, trainer.networks_of(config.ppo, env.action_size)
    mesh = env_mesh(config.shards)
    training = prepare(config, env, mesh)
    env, key = training.env, put(mesh, jax.random.key(1))
    state = training.start()

    @jax.jit
    def collect(env, state, key):
        params = state.learner.policy.params
        return rollout.collect(
            env, nets, params, state.obs_stats, state.actors, trainer._step_keys(ppo, key)
        )

    @jax.jit
    def prepare_batch(state, window):
        value, carry = state.learner.value.params, state.actors.value_carry
        return judge(ppo, nets, value, carry, state.obs_stats, state.value_stats, window).batch

    @jax.jit
    def learn_once(learner, batch, key):
        rates = jnp.float32(ppo.policy_lr), jnp.float32(ppo.value_lr)
        return learn(ppo, nets, rates, learner, batch, key, config.shards)

    def iterate():
        nonlocal state
        state, metrics = training.iterate(state, 0)
        jax.block_until_ready(metrics)

    steps = config.steps_per_iteration
    with jax.set_mesh(mesh):
        rollout_s = median_s(lambda: jax.block_until_ready(collect(env, state, key)), repeats)
        batch = prepare_batch(state, collect(env, state, key)[1])
        learner = state.learner
        learn_s = median_s(lambda: jax.block_until_ready(learn_once(learner, batch, key)), repeats)
    iteration_s = median_s(iterate, repeats)
    flops = steps * ppo.epochs * learner_flops(env.obs_size, ppo.hidden, (env.action_size, 1))
    return TrainingSpeed(
        rollout_steps_per_s=steps / rollout_s,
        training_steps_per_s=steps / iteration_s,
        learner_us_per_step=1e6 * learn_s / steps,
        learner_gflops=1e-9 * flops / learn_s,
    )


def learner_flops(inputs: int, hidden: int, outputs: tuple[int, ...]) -> int:
    """Floating-point operations of the matrix products of one gradient of networks with these
    outputs, for one step: forward, by the weights, and by the inputs of all layers but the first.
    """
    total = 0
    for head in outputs:
        first = inputs * hidden
        rest = hidden * hidden + 2 * hidden * 4 * hidden + hidden * head
        total += 2 * (2 * first + 3 * rest)
    return total


SHAPES = (
    (512, 512, 512),
    (1024, 1024, 1024),
    (2048, 2048, 2048),
    (2048, 256, 512),
    (8192, 128, 512),
)
"""(rows on a device, inner, columns) of the matrix products; the last two are the network's."""


def matmul_gflops(repeats: int = REPEATS) -> float:
    """The machine's own rate in float32, 1e9/s: the best repeat of the best shape, on one device or
    on all at once."""
    meshes = [env_mesh(1), env_mesh(jax.local_device_count())]
    return max(_matmul_gflops(mesh, shape, repeats) for mesh in meshes for shape in SHAPES)


def _matmul_gflops(mesh: Mesh, shape: tuple[int, int, int], repeats: int) -> float:
    inner, columns = shape[1:]
    rows = shape[0] * mesh.size
    a = put(mesh, jax.random.normal(jax.random.key(0), (rows, inner)), 0)
    b = put(mesh, jax.random.normal(jax.random.key(1), (inner, columns)))
    product: Any = jax.jit(jnp.matmul)
    seconds = min(samples_s(lambda: jax.block_until_ready(product(a, b)), repeats))
    return 2e-9 * rows * inner * columns / seconds
