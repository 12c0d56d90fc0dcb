"""Physics steps per second of every engine on the same arm: C MuJoCo (rollout and batch, all
cores), MJX and the chain engine.

Same task for all: the paper's arm, Euler, base at rest, servo references held, from random joint
angles; what one control step asks of the physics, ten steps of 2 ms, is the unit of a call.
"""

from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mcx_jax.arm import chain
from mcx_jax.arm.model import ChainModel, chain_model, load_mujoco
from mcx_jax.bench.timing import median_s
from mcx_jax.compute import machine
from mcx_jax.compute.sharding import env_mesh, put
from mcx_jax.compute.startup import needs_old_emitters
from mcx_jax.config.delay import SUBSTEPS

AT_REST = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 9.81))
"""`chain.BaseState` of a level base at rest."""
LARGE_STEPS = 100_000
"""Physics steps in a call, all environments together, at least, where a control step is less."""


class Work(NamedTuple):
    """What is timed of an engine."""

    call: Callable[[], Any]
    steps: int
    """Physics steps that a call takes, all environments together."""

    def steps_per_s(self, repeats: int) -> float:
        """By the median of so many repeats."""
        return self.steps / median_s(self.call, repeats)


def start(model: mujoco.MjModel, envs: int) -> tuple[np.ndarray, np.ndarray]:
    """(envs, nq) joint angles, rad, and (envs, nu) commands that hold them."""
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (envs, model.nq))
    ctrl = np.zeros((envs, model.nu))
    for i in range(model.nu):
        if model.actuator_biasprm[i, 1]:  # a position servo
            ctrl[:, i] = q[:, model.actuator_trnid[i, 0]]
    return q, ctrl


def c_rollout(envs: int) -> Work:
    """`mujoco.rollout` on all cores."""
    from mujoco import rollout

    model = load_mujoco("paper")
    threads = machine.cores()
    datas = [mujoco.MjData(model) for _ in range(threads)]
    q, ctrl = start(model, envs)
    state = np.zeros((envs, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    state[:, 1 : 1 + model.nq] = q  # time comes first
    steps = _steps_a_call(envs, 10_000)
    control = np.repeat(ctrl[:, None], steps, axis=1)
    pool = rollout.Rollout(nthread=threads)
    return Work(lambda: pool.rollout(model, datas, state, control), envs * steps)


def c_batch(envs: int) -> Work:
    """`mujoco.batch` on all cores."""
    from mujoco.batch import Batch

    model = load_mujoco("paper")
    batch = Batch(model, nsim=envs, nthread=machine.cores())
    q, ctrl = start(model, envs)
    batch.bind("qpos")[:], batch.bind("ctrl")[:] = q, ctrl
    steps = _steps_a_call(envs, 10_000)
    return Work(lambda: batch.step(nstep=steps), envs * steps)


def mjx(envs: int) -> Work:
    """MJX, without contact and constraint work."""
    from mcx_jax.arm.quiet_mjx import mjx as mj_x

    model = load_mujoco("paper")
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    m = mj_x.put_model(model)
    blank = mj_x.make_data(m)

    def run(q, v, ctrl):
        d = blank.replace(qpos=q, qvel=v, ctrl=ctrl)
        d = jax.lax.fori_loop(0, SUBSTEPS, lambda _, d: mj_x.step(m, d), d)
        return d.qpos, d.qvel

    q, ctrl = (np.asarray(x, np.float32) for x in start(model, envs))
    arrays = put(env_mesh(envs), (q, np.zeros_like(q), ctrl), 0)
    old_emitters = jax.default_backend() == "cpu" and needs_old_emitters(version("jaxlib"))
    options = {"xla_cpu_use_fusion_emitters": False} if old_emitters else None
    step = jax.jit(jax.vmap(run), compiler_options=options)
    return _jax_work(step, arrays, envs * SUBSTEPS)


def chain_engine(envs: int) -> Work:
    """This project's engine."""
    model, arrays = _chain_start(envs)
    steps = _steps_a_call(envs, LARGE_STEPS)
    step = jax.jit(partial(_chain_steps, model, "euler", steps))
    return _jax_work(step, arrays, envs * steps)


def _chain_start(envs: int) -> tuple[ChainModel, tuple]:
    """(model, (q, qd, ctrl, wall)), environments on the last axis, over the devices."""
    mj = load_mujoco("paper")
    mesh = env_mesh(envs)
    q, ctrl = (np.asarray(x.T, np.float32) for x in start(mj, envs))
    wall = put(mesh, jnp.asarray(True)) if jax.default_backend() == "cpu" else None
    return chain_model(mj, "tool"), (*put(mesh, (q, np.zeros_like(q), ctrl), -1), wall)


ENGINES: dict[str, Callable[[int], Work]] = {
    "c-rollout": c_rollout,
    "c-batch": c_batch,
    "mjx": mjx,
    "chain": chain_engine,
}


def gradient_over_forward(envs: int) -> float:
    """Time of the gradient of ten physics steps (implicitfast) by the state over the time of the
    steps themselves."""
    model, arrays = _chain_start(envs)
    run = partial(_chain_steps, model, "implicitfast", SUBSTEPS)

    def loss(q, v, ctrl, wall):
        q, v = run(q, v, ctrl, wall)
        return jnp.sum(q**2) + jnp.sum(v**2)

    both = jax.jit(run), jax.jit(jax.grad(loss, argnums=(0, 1)))
    forward, gradient = (median_s(_jax_work(step, arrays, 1).call) for step in both)
    return gradient / forward


def ratios(ours: Work, theirs: Work, rounds: int) -> list[float]:
    """How many times faster ours is, measured in turn so many times: on a machine that others use,
    or that changes its clock, one pair says little."""
    return [ours.steps_per_s(1) / theirs.steps_per_s(1) for _ in range(rounds)]


def _chain_steps(model: ChainModel, integrator: str, steps: int, q, v, ctrl, wall):
    """`steps` physics steps of environments on the last axis."""

    def one(q, v, ctrl):
        base = jax.tree.map(jnp.float32, AT_REST)
        return chain.substeps(model, integrator, q, v, ctrl, lambda _: base, steps, wall)

    return jax.vmap(one, in_axes=-1, out_axes=-1)(q, v, ctrl)


def _steps_a_call(envs: int, at_least: int) -> int:
    return SUBSTEPS * max(1, at_least // (SUBSTEPS * envs))


def _jax_work(step: Callable, arrays: tuple, steps: int) -> Work:
    return Work(lambda: jax.block_until_ready(step(*arrays)), steps)
