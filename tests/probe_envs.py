"""Toy tasks with the environment's protocol, each of which isolates one thing the learner must do.

Their states carry typed PRNG keys, so that windows, resets and checkpoints are tried with them.
"""

import jax
import jax.numpy as jnp
from flax import struct

OBS_SIZE = 4
ACTION_SIZE = 2
QUEUE = 4


@struct.dataclass
class ProbeMetrics:
    """The fields that the trainer reads; all ()."""

    pos_error_m: jax.Array
    ang_error_rad: jax.Array
    valid: jax.Array


@struct.dataclass
class ProbeState:
    """One probe environment.

    Attributes:
        obs: (OBS_SIZE,).
        reward: ().
        done: () bool.
        metrics: errors and validity.
        t: steps since the reset, () int32.
        target: what the action should be now, ().
        queue: errors on their way to the reward, (QUEUE,), the newest first.
        key: PRNG key.
    """

    obs: jax.Array
    reward: jax.Array
    done: jax.Array
    metrics: ProbeMetrics
    t: jax.Array
    target: jax.Array
    queue: jax.Array
    key: jax.Array


@struct.dataclass
class ProbeEnv:
    """Reward constant_reward - scale * (action[0] - target)^2.

    Every setting is an array, so that one compiled trainer serves all probes.

    Attributes:
        constant_reward: ().
        scale: 0 = the action does not matter, ().
        hold: the target stays in an episode and is seen in its first observation only, () bool.
        delay: the reward of an action comes that many steps later (0 to QUEUE - 1), () int32.
        fail_at: the state is invalid and NaN from that step on, () int32.
    """

    constant_reward: jax.Array
    scale: jax.Array
    hold: jax.Array
    delay: jax.Array
    fail_at: jax.Array
    obs_size: int = struct.field(pytree_node=False, default=OBS_SIZE)
    action_size: int = struct.field(pytree_node=False, default=ACTION_SIZE)

    def reset(self, key: jax.Array) -> ProbeState:
        """A new episode."""
        key, draw = jax.random.split(key)
        target = jax.random.uniform(draw, minval=-1.0, maxval=1.0)
        zero = jnp.zeros(())
        return ProbeState(
            obs=self._observe(target, jnp.zeros((), jnp.int32)),
            reward=zero,
            done=jnp.zeros((), bool),
            metrics=ProbeMetrics(zero, zero, jnp.ones((), bool)),
            t=jnp.zeros((), jnp.int32),
            target=target,
            queue=jnp.zeros(QUEUE),
            key=key,
        )

    def step(self, state: ProbeState, action: jax.Array) -> ProbeState:
        """One step."""
        key, draw = jax.random.split(state.key)
        t = state.t + 1
        queue = jnp.concatenate([(action[:1] - state.target) ** 2, state.queue[:-1]])
        drawn = jax.random.uniform(draw, minval=-1.0, maxval=1.0)
        target = jnp.where(self.hold, state.target, drawn)
        failed = t >= self.fail_at
        reward = self.constant_reward - self.scale * queue[self.delay]
        return ProbeState(
            obs=jnp.where(failed, jnp.nan, self._observe(target, t)),
            reward=jnp.where(failed, jnp.nan, reward),
            done=jnp.zeros((), bool),
            metrics=ProbeMetrics(queue[0], jnp.abs(action[1]), ~failed),
            t=t,
            target=target,
            queue=queue,
            key=key,
        )

    def _observe(self, target: jax.Array, t: jax.Array) -> jax.Array:
        """Target (with `hold` only at t = 0), whether t = 0, a constant, and nothing."""
        first = t == 0
        seen = jnp.where(self.hold & ~first, 0.0, target)
        return jnp.stack([seen, first.astype(jnp.float32), jnp.ones(()), jnp.zeros(())])


def make_probe(
    constant_reward: float = 0.0,
    scale: float = 1.0,
    hold: bool = False,
    delay: int = 0,
    fail_at: int = 1_000_000,
) -> ProbeEnv:
    """A probe environment; see `ProbeEnv`."""
    return ProbeEnv(
        constant_reward=jnp.float32(constant_reward),
        scale=jnp.float32(scale),
        hold=jnp.asarray(hold),
        delay=jnp.int32(delay),
        fail_at=jnp.int32(fail_at),
    )
