"""Vessel-to-vessel motion compensation: sea, arm, delay, policy and training in one JAX program.

Public names are loaded when they are first used, because XLA's flags (`configure`) have to be set
before JAX is imported. The functions that the commands `train` and `evaluate` run are not among
them: `mcx_jax.train` and `mcx_jax.evaluate` are those commands' modules.
"""

__version__ = "0.1.0"

_HOME = {
    "ConditionsConfig": "mcx_jax.config.task",
    "EnvConfig": "mcx_jax.config.task",
    "MotionConfig": "mcx_jax.config.task",
    "TrainConfig": "mcx_jax.config.training",
    "UserError": "mcx_jax.errors",
    "configure": "mcx_jax.compute.startup",
    "load_controller": "mcx_jax.controllers.by_name",
    "load_policy": "mcx_jax.policy.file",
    "make_env": "mcx_jax.envs.v2v",
    "step": "mcx_jax.integrations.mjx_step",
}
"""{public name: the module that defines it}."""

__all__ = sorted(_HOME)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    """Load a public name."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    """Public names, whether or not they are loaded."""
    return sorted({*globals(), *_HOME})
