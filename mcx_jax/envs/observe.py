"""What the policy sees: 38 numbers (paper, section 4), their names, units and frames."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp

from mcx_jax.spatial import Mat, Scalar, Vec, angle, matmul, norm, transpose, vsub


@dataclass(frozen=True)
class ObservationRow:
    """A block of the observation."""

    name: str
    size: int
    unit: str
    meaning: str


OBS_TABLE = (
    ObservationRow("R_B_G", 9, "1", "orientation of the goal G in the arm base B, row-major"),
    ObservationRow("p_B_G", 3, "m", "position of the goal G in B"),
    ObservationRow("R_B_E", 9, "1", "orientation of the tool E in B, row-major"),
    ObservationRow("p_B_E", 3, "m", "position of the tool E in B"),
    ObservationRow("R_G_E", 9, "1", "orientation of the tool E in the goal G, row-major"),
    ObservationRow("p_EG_B", 3, "m", "vector from the tool E to the goal G, in B"),
    ObservationRow("dp", 1, "m", "distance from the tool to the goal"),
    ObservationRow("da", 1, "rad", "angle between the tool and the goal"),
)
"""Order of the observation. The paper lists T_G^E for the last pose; the authors' code gives its
translation in B axes and its rotation as E seen from G, and so do we."""
OBS_SIZE = sum(row.size for row in OBS_TABLE)
AGE = ObservationRow("age", 1, "s", "age of the measured pose of G, by its time stamp")
"""Follows OBS_TABLE where measurements come late (--latency-steps)."""


def slices() -> dict[str, slice]:
    """Where each block of OBS_TABLE lies in the observation."""
    out, start = {}, 0
    for row in OBS_TABLE:
        out[row.name] = slice(start, start + row.size)
        start += row.size
    return out


def tracking_error(goal: tuple[Mat, Vec], tool: tuple[Mat, Vec]) -> tuple[Scalar, Scalar]:
    """(dp in m, da in rad) between tool and goal, both poses in B (paper eq. 1)."""
    return norm(vsub(goal[1], tool[1])), angle(matmul(transpose(goal[0]), tool[0]))


def observe(
    goal: tuple[Mat, Vec], tool: tuple[Mat, Vec], errors: tuple[Scalar, Scalar]
) -> jax.Array:
    """(38,) observation in the order of OBS_TABLE.

    Args:
        goal: T_G^B = (R, p in m).
        tool: T_E^B = (R, p in m).
        errors: (dp in m, da in rad).
    """
    relative = matmul(transpose(goal[0]), tool[0])
    parts = [
        *(x for row in goal[0] for x in row),
        *goal[1],
        *(x for row in tool[0] for x in row),
        *tool[1],
        *(x for row in relative for x in row),
        *vsub(goal[1], tool[1]),
        *errors,
    ]
    return jnp.stack(parts)
