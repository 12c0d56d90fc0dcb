"""What an exported policy reads and writes, as plain data: names, order, units, frames, memory.

Every exported form carries or follows this one description (`python -m mcx_jax.export`).
"""

import json
from typing import Any

import jax

from mcx_jax.config.delay import CONTROL_DT_S, parse_delay
from mcx_jax.envs.observe import AGE, OBS_SIZE, OBS_TABLE, ObservationRow
from mcx_jax.errors import UserError
from mcx_jax.policy.networks import PolicyNet, init_carry
from mcx_jax.policy.normalise import CLIP, STD_FLOOR

FRAMES = (
    "I inertial, B arm base, E tool, G goal; R_B_G, p_B_G: orientation (maps coordinates in G to "
    "coordinates in B) and position of G in B"
)
ACTION_TABLE = (
    ObservationRow("shift_G", 3, "cm", "translation of the goal G, in G's own axes x y z"),
    ObservationRow("turn_G", 3, "crad", "rotation vector (axis times angle) of G, in its own axes"),
)
"""Order of the action."""
ACTION_SIZE = sum(row.size for row in ACTION_TABLE)
ACTION_USE = (
    "the arm aims its tool at (R_B_G exp(0.01 turn_G), p_B_G + R_B_G 0.01 shift_G) in B, by "
    "inverse kinematics, in place of the goal; an action of zero is no correction"
)


def describe(net: PolicyNet, obs_size: int, config: str) -> dict[str, Any]:
    """The interface of a policy, as JSON can hold it.

    Args:
        obs_size: length of the observation.
        config: JSON of the training run's configuration; fields missing from it are omitted.
    """
    known = {OBS_SIZE: OBS_TABLE, OBS_SIZE + 1: (*OBS_TABLE, AGE)}
    observation = known.get(obs_size, _unnamed("observation", obs_size))
    action = ACTION_TABLE if net.actions == ACTION_SIZE else _unnamed("action", net.actions)
    return {
        "frames": FRAMES,
        "rate_hz": round(1.0 / CONTROL_DT_S),
        "trained_for": _trained_for(config),
        "observation": _rows(observation),
        "action": _rows(action),
        "action_use": ACTION_USE,
        "cell": net.cell,
        "state": state_sizes(net),
        "state_use": "zeros at the start of an episode; what comes out goes into the next step",
        "normalisation": {
            "formula": "clip((observation - mean) / max(sqrt(var), std_floor), -clip, clip)",
            "std_floor": STD_FLOOR,
            "clip": CLIP,
        },
    }


def state_sizes(net: PolicyNet) -> dict[str, int]:
    """Length of each array of the memory by its name, in the order of the carry's leaves."""
    # Not eval_shape of a lambda: every checkpoint of a run asks, and JAX would trace and keep each.
    leaves, _ = jax.tree.flatten_with_path(init_carry(net, ()))
    return {_leaf_name(path): leaf.shape[-1] for path, leaf in leaves}


def _leaf_name(path: tuple[Any, ...]) -> str:
    """`c` for the leaf carry.c; `h` for a carry that is one bare array."""
    return jax.tree_util.keystr(path, simple=True, separator="_") or "h"


def _rows(table: tuple[ObservationRow, ...]) -> list[dict[str, Any]]:
    rows, start = [], 0
    for row in table:
        index = [start, start + row.size - 1]
        rows.append({"index": index, "name": row.name, "unit": row.unit, "meaning": row.meaning})
        start += row.size
    return rows


def _unnamed(name: str, size: int) -> tuple[ObservationRow, ...]:
    return (ObservationRow(name, size, "", "as the task defines it"),)


def _trained_for(config: str) -> dict[str, str]:
    """Arm and delay that the policy has learnt to correct; {} if the configuration is no run's."""
    try:
        env = json.loads(config)["env"]
        delays = [parse_delay(name).describe() for name in env["delay"].split(",")]
        return {"arm": env["arm"], "delay": "; ".join(delays)}
    except (ValueError, KeyError, TypeError, AttributeError, UserError):
        return {}
