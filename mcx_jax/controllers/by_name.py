"""Controllers by the name that the commands use. Needs no JAX until one is loaded."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mcx_jax.assets import policy_file
from mcx_jax.config.delay import parse_delay
from mcx_jax.config.task import EnvConfig, MotionConfig
from mcx_jax.console.terminal import silent
from mcx_jax.errors import UserError

WHO = ("ik", "extrapolate", "extrapolate-best", "fir", "preview")
FITTED = ("extrapolate-best", "fir")


def policy_path(who: str) -> Path | None:
    """The policy file of a run directory or a policy file; None for a controller's name.

    Needs no JAX, so that a mistyped name is reported immediately.
    """
    if who in WHO:
        return None
    path = policy_file(who)
    # os.path: also False where no file can have such a name.
    if not os.path.exists(path) and not os.path.isdir(who):
        raise UserError(
            f"unknown controller '{who}': use {', '.join(WHO)}, shipped:DELAY, a run directory or "
            "a policy .npz"
        )
    return path


def load_controller(who: str) -> tuple[str, Any]:
    """(name, controller) for a name, a run directory or a policy file; the controller is None for
    one of FITTED, which needs a task first (`fit_if_needed`).

    Raises:
        UserError: no such controller, a file that is no policy, or one for another task.
    """
    path = policy_path(who)
    if who in FITTED:
        return who, None
    if path is None:
        from mcx_jax.controllers.classical import CLASSICAL

        return who, CLASSICAL[who]
    from mcx_jax.policy.file import PolicyController, load_policy, require_task

    policy = load_policy(path)
    require_task(path, policy.meta)
    return who.rstrip("/"), PolicyController(policy)


def fit_if_needed(
    who: str,
    controller: Any,
    env_config: EnvConfig,
    motion_config: MotionConfig,
    known_delay: str,
    say: Callable[[str], None] = silent,
) -> Any:
    """The controller of `load_controller`, fitted on training motion if it is one of FITTED.

    Args:
        say: what happens is said to it (`mcx_jax.console.terminal.working`).
    """
    if controller is not None:
        return controller
    from mcx_jax.controllers.fitted import fitted
    from mcx_jax.envs.v2v import make_env

    env = informed(make_env(env_config, motion_config, split="train"), known_delay)
    return fitted(who, env, say)


def informed(env, known_delay: str):
    """The task in which controllers without learning assume another delay ("": the true one)."""
    return env.replace(known_delay=parse_delay(known_delay)) if known_delay else env
