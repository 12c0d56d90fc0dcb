"""Whole episodes of controllers, as many as wanted in one compiled program."""

import functools

import jax
import jax.numpy as jnp

from mcx_jax.arm.model import torque_limits_nm
from mcx_jax.compute.sharding import env_mesh, put


def run_episodes(env, controller, keys, seas, gain, given=None):
    """Whole episodes, batch axis last inside.

    Args:
        env: V2VEnv.
        controller: see mcx_jax.controllers.classical.
        keys: (N,) PRNG keys.
        seas: (N,) int32 sea index per episode.
        gain: (N,) factor of the controller's actions: 0 makes an episode one of the IK baseline, so
            that baseline and controller share one program (compiling takes ten times the run).
        given: conditions in place of those that the episodes draw, leaves (..., N).

    Returns:
        dp (steps, N) m, da (steps, N) rad, valid (N,) bool, correction (steps, 6, N) in cm and
        crad, the largest share of its torque limit that a joint uses, (steps, N), and whether the
        goal was out of reach and a joint asked to be too fast (`V2VEnv.strain`), (steps, 2, N).
    """
    reset = jax.vmap(env.reset, in_axes=(0, 0, None if given is None else -1), out_axes=-1)
    step = jax.vmap(env.step, in_axes=-1, out_axes=-1)
    act = jax.vmap(functools.partial(controller.act, env), in_axes=-1, out_axes=-1)
    state = reset(keys, seas, given)
    memory = jax.vmap(functools.partial(controller.init, env), in_axes=-1, out_axes=-1)(state)

    def body(carry, _):
        state, memory = carry
        memory, action = act(state, memory)
        action = env.bounded(gain * action)
        after = step(state, action)
        share = jnp.max(jnp.abs(torques(state, after)) / limits, axis=0)
        errors = after.metrics.pos_error_m, after.metrics.ang_error_rad
        strain = jnp.stack(strained(state, after))
        return (after, memory), (*errors, action, share, strain)

    limits = torque_limits_nm(env.model)[:, None]
    torques = jax.vmap(env.joint_torques, in_axes=-1, out_axes=-1)
    strained = jax.vmap(env.strain, in_axes=-1, out_axes=-1)
    (state, _), series = jax.lax.scan(body, (state, memory), None, env.episode_steps)
    dp, da, action, share, strain = series
    return dp, da, state.metrics.valid, action, share, strain


@functools.cache
def _compiled():
    """One jitted `run_episodes` per process, so that repeated evaluations trace once."""
    return jax.jit(run_episodes)


def episode_errors(env, controller, gains: tuple[float, ...], episodes: int, seed: int):
    """Errors of `episodes` test episodes for each gain and each of the env's seas (NumPy).

    The episodes of every gain and sea have the same windows of motion and the same goals, so that
    a difference is the controller's or the sea's alone.

    Returns:
        dp m, da rad, valid, correction cm and crad, torque share, strain as `run_episodes` returns
        them, with (gains, seas, episodes) for N.
    """
    shape = (len(gains), len(env.motion.seas), episodes)
    keys = jnp.tile(jax.random.split(jax.random.key(seed), episodes), shape[0] * shape[1])
    seas = jnp.broadcast_to(jnp.arange(shape[1], dtype=jnp.int32)[:, None], shape).ravel()
    gain = jnp.broadcast_to(jnp.asarray(gains)[:, None, None], shape).ravel()
    found = run_everywhere(env, controller, keys, seas, gain)
    return tuple(x.reshape(*x.shape[:-1], *shape) for x in found)


def run_everywhere(env, controller, keys, seas, gain, given=None):
    """`run_episodes`, compiled, over all devices; returns NumPy arrays."""
    mesh = env_mesh(keys.size)
    env, controller = put(mesh, (env.replace(whole_batches=True), controller))
    keys, seas, gain = put(mesh, (keys, seas, gain), 0)
    given = None if given is None else put(mesh, given, -1)
    with jax.set_mesh(mesh):
        return jax.device_get(_compiled()(env, controller, keys, seas, gain, given))
