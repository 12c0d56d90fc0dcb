"""The programs of a training run lowered for GPU and TPU, which no machine of the tests has.

Nothing is compiled or computed: shapes stand for arrays. What a machine without a GPU can show is
that every operation exists there and that nothing would run on the host, or in float64.
"""

import functools
import re
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AbstractMesh

from mcx_jax.compute.sharding import ENV_AXIS
from mcx_jax.config.task import MotionConfig
from mcx_jax.config.training import preset_config
from mcx_jax.envs.v2v import make_env
from mcx_jax.ppo.rollout import step_all
from mcx_jax.runs import programs
from mcx_jax.train import smoke_config

PLATFORMS = ("cuda", "tpu")
LIBRARIES = {"cusolver_potrf_ffi"}
"""Calls out of a program that stay on the device: CUDA's Cholesky factors, in MJX's step."""
TWO_DEVICES = AbstractMesh((2,), (ENV_AXIS,))
SEED = jax.ShapeDtypeStruct((), jnp.int32)


def lower(f, *args: Any) -> tuple[str, Any]:
    """The program for both platforms, as text, and the shapes of its results.

    Raises:
        NotImplementedError: one of them lacks an operation.
    """
    traced = jax.jit(f).trace(*args)
    return traced.lower(lowering_platforms=PLATFORMS).as_text(), traced.out_info


def faults(program: str) -> list[str]:
    """What a program has that a GPU or TPU would not run, or not run well."""
    calls = set(re.findall(r"custom_call @([\w.]+)", program)) - LIBRARIES
    types = re.findall(r"\bf64\b|xf64>|\bcomplex<f64>", program)
    return [*sorted(calls), *types[:1], *re.findall(r"\w*callback\w*", program)[:1]]


def of_a_gpu(algo: str, physics: str):
    """(configuration, environment as shapes) as on a machine with a GPU."""
    config = smoke_config(preset_config("fast", algo))
    config = replace(config, env=replace(config.env, physics=physics))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax, "default_backend", lambda: "gpu")
        env = make_env(config.env, MotionConfig(sea="Wd"), split="test")
    assert env.wall is None
    return config, as_shapes(replace(env, whole_batches=True))


def as_shapes(tree: Any) -> Any:
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)), tree)


@functools.cache
def reset(physics: str) -> tuple[str, Any]:
    """The program that resets a block of environments, and the block; of either algorithm."""
    config, env = of_a_gpu("ppo", physics)
    with jax.sharding.use_abstract_mesh(TWO_DEVICES):
        return lower(partial(programs.reset, config), env, SEED, SEED)


def check_a_run(algo: str, physics: str) -> None:
    """The three programs of `programs.prepare`, laid out over two devices."""
    config, env = of_a_gpu(algo, physics)
    trainer = programs.algorithm(config)
    program, fresh = reset(physics)
    assert faults(program) == []
    with jax.sharding.use_abstract_mesh(TWO_DEVICES):
        blocks = [fresh] * config.reset_groups
        program, state = lower(partial(trainer.init, config), env, SEED, blocks)
        assert faults(program) == []
        program, _ = lower(partial(trainer.iterate, config), env, state, fresh)
        assert faults(program) == []
    assert len(program) > 1e5


@pytest.mark.parametrize("algo", ["ppo", pytest.param("first-order", marks=pytest.mark.slow)])
def test_a_training_iteration_has_nothing_that_a_gpu_or_tpu_lacks(algo):
    check_a_run(algo, "chain")


@pytest.mark.slow
def test_a_training_iteration_with_mjx_has_nothing_that_a_gpu_or_tpu_lacks():
    check_a_run("ppo", "mjx")


def test_a_control_step_with_mjx_has_nothing_that_a_gpu_or_tpu_lacks():
    config, env = of_a_gpu("ppo", "mjx")
    _, state = reset("chain")  # the same with mjx, and quicker to trace
    action = jax.ShapeDtypeStruct((config.block_envs, env.action_size), jnp.float32)
    program, _ = lower(step_all, env, state, action)
    assert faults(program) == []
    assert "cusolver_potrf_ffi" in program


def on_host(x):
    return jax.pure_callback(np.sin, x, x)


def with_lapack(x):
    return jnp.linalg.eigvals(x)


@pytest.mark.parametrize("f", [on_host, with_lapack])
def test_what_runs_on_the_host_is_found(f):
    try:
        program, _ = lower(f, jax.ShapeDtypeStruct((3, 3), jnp.float32))
    except NotImplementedError:
        return
    assert faults(program)


def test_float64_is_found():
    with jax.enable_x64(True):
        program, _ = lower(jnp.sin, jax.ShapeDtypeStruct((3,), jnp.float64))
    assert faults(program) == ["xf64>"]
