"""Mean errors against measurement noise.

The noise is an input of the program, not a part of it: one compiled program a controller.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mcx_jax.envs import conditions
from mcx_jax.envs.v2v import V2VEnv
from mcx_jax.evaluation.episodes import run_everywhere
from mcx_jax.evaluation.statistics import WARM_UP_STEPS, finite_episodes

LEVELS = (0.0, 0.3, 1.0, 3.0)
"""Standard deviation of each axis, mm, and about each axis, mrad: the same number of both."""
EPISODES = 10
"""At most: the report's first ones. A mean is then good to a few per cent, for a second's run."""


@dataclass(frozen=True)
class Sweep:
    """Mean errors of one controller at every level."""

    label: str
    levels: tuple[float, ...]
    """Noise, mm and mrad."""
    pos_mm: np.ndarray
    """(levels,) mean dp; NaN where every episode diverged."""
    ang_mrad: np.ndarray
    """(levels,) mean da."""
    invalid: np.ndarray
    """(levels,) invalid episodes, counted like the others where they are finite."""
    episodes: int
    """At every level."""

    def rows(self, sea: str) -> list[dict[str, Any]]:
        """For results.json, one a level."""
        return [
            {
                "who": self.label,
                "sea": sea,
                "noise_mm": level,
                "noise_mrad": level,
                "episodes": self.episodes,
                "invalid_episodes": int(self.invalid[i]),
                "pos_mm": _or_none(self.pos_mm[i]),
                "ang_mrad": _or_none(self.ang_mrad[i]),
            }
            for i, level in enumerate(self.levels)
        ]


def _or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def noise_sweep(
    env: V2VEnv,
    controller: Any,
    labels: tuple[str, ...],
    *,
    sea: int,
    episodes: int,
    seed: int,
    levels: Sequence[float] = LEVELS,
) -> list[Sweep]:
    """Sweeps of the IK baseline and of a controller, on the same episodes.

    What else the environment's conditions ask for stays; its own noise does not count.

    Args:
        labels: of both; one alone: the baseline only.
        sea: index into env.motion.seas.
        episodes: of the evaluation; the first EPISODES of them run.
        seed: of the evaluation.
    """
    count = min(episodes, EPISODES)
    shape = (len(labels), len(levels), count)
    keys = jax.random.split(jax.random.key(seed), episodes)[:count]
    every = jnp.tile(keys, shape[0] * shape[1])
    level = jnp.broadcast_to(jnp.asarray(levels, jnp.float32)[:, None], shape).ravel()
    gain = jnp.broadcast_to(jnp.arange(shape[0], dtype=jnp.float32)[:, None, None], shape).ravel()
    noisy = _with_noise(env)
    path_steps = env.goal_path.period_steps if env.goal_path else 0
    draw = jax.vmap(lambda key: conditions.draw(noisy.config, key, path_steps), out_axes=-1)
    given = draw(every)  # with the random numbers of `evaluate --noise-mm X --noise-mrad X`
    assert given.noise is not None
    noise = replace(given.noise, position_m=1e-3 * level, angle_rad=1e-3 * level)
    given = replace(given, noise=noise)
    seas = jnp.full(every.size, sea, jnp.int32)
    dp, da, valid, *_ = run_everywhere(noisy, controller, every, seas, gain, given)
    dp, da = (x.reshape(-1, *shape) for x in (dp, da))
    valid = valid.reshape(shape)
    return [
        Sweep(label, tuple(levels), *_means(dp[:, k], da[:, k]), (~valid[k]).sum(axis=1), count)
        for k, label in enumerate(labels)
    ]


def _with_noise(env: V2VEnv) -> V2VEnv:
    """The same task, its observation made of what is measured. Any noise but 0 asks for that, and
    always the same one, since another setting would be compiled again."""
    asked = replace(env.config.conditions, noise_mm="1", noise_mrad="1")
    return replace(env, config=replace(env.config, conditions=asked))


def _means(dp: np.ndarray, da: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(levels,) means in mm and in mrad of (steps, levels, episodes) m and rad after the warm-up;
    episodes with a number that is not finite are left out."""
    means = np.full((2, dp.shape[1]), np.nan)
    for i in range(dp.shape[1]):
        inside = finite_episodes(dp[:, i], da[:, i])
        if inside.any():
            means[:, i] = [1e3 * x[WARM_UP_STEPS:, i, inside].mean() for x in (dp, da)]
    return means[0], means[1]
