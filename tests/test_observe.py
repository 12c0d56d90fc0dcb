"""The observation's table and one observation worked by hand."""

import jax.numpy as jnp
import numpy as np
import pytest

from mcx_jax.envs import observe
from mcx_jax.envs.observe import OBS_SIZE, OBS_TABLE, slices, tracking_error

# Goal turned by +90 deg about z, tool by +90 deg about x, both seen from B.
GOAL = (((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), (0.60, 0.10, 0.20))
TOOL = (((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)), (0.57, 0.14, 0.20))
F32 = 1e-6  # entries up to 2.1, float32 resolves 1.2e-7 of 1


def traced(pose):
    r, p = pose
    return tuple(tuple(jnp.float32(x) for x in row) for row in r), tuple(map(jnp.float32, p))


def test_table_has_38_numbers_as_the_paper():
    # Three poses of 9 + 3 and two errors: 3 * 12 + 2 = 38.
    assert OBS_SIZE == sum(row.size for row in OBS_TABLE) == 38
    assert len({row.name for row in OBS_TABLE}) == len(OBS_TABLE)
    assert {row.unit for row in OBS_TABLE} == {"1", "m", "rad"}


def test_slices_tile_the_observation():
    where = slices()
    assert list(where) == [row.name for row in OBS_TABLE]
    assert (where["R_B_G"], where["p_B_G"]) == (slice(0, 9), slice(9, 12))
    assert (where["R_B_E"], where["p_B_E"]) == (slice(12, 21), slice(21, 24))
    assert (where["R_G_E"], where["p_EG_B"]) == (slice(24, 33), slice(33, 36))
    assert (where["dp"], where["da"]) == (slice(36, 37), slice(37, 38))


def test_tracking_error_by_hand():
    # Position: (0.03, -0.04, 0), so dp = 0.05 m.
    # R_G^T R_E = ((0, 1, 0), (-1, 0, 0), (0, 0, 1)) R_E has rows (0, 0, -1), (-1, 0, 0), (0, 1, 0):
    # trace 0, cos da = (0 - 1) / 2, da = 120 deg = 2.0943951 rad.
    dp, da = tracking_error(traced(GOAL), traced(TOOL))
    assert float(dp) == pytest.approx(0.05, abs=F32)
    assert float(da) == pytest.approx(2.0943951, abs=F32)
    same = tracking_error(traced(GOAL), traced(GOAL))
    assert [float(x) for x in same] == [0.0, 0.0]


def test_observation_by_hand():
    goal, tool = traced(GOAL), traced(TOOL)
    obs = np.asarray(observe.observe(goal, tool, tracking_error(goal, tool)))
    want = [
        *(0, -1, 0, 1, 0, 0, 0, 0, 1),  # R_B_G row by row
        *(0.60, 0.10, 0.20),
        *(1, 0, 0, 0, 0, -1, 0, 1, 0),  # R_B_E
        *(0.57, 0.14, 0.20),
        *(0, 0, -1, -1, 0, 0, 0, 1, 0),  # R_G_E = R_B_G^T R_B_E: E as seen from G
        # From E to G in B axes; in G axes it would be (-0.04, -0.03, 0).
        *(0.03, -0.04, 0.0),
        *(0.05, 2.0943951),
    ]
    np.testing.assert_allclose(obs, want, rtol=0, atol=F32)
    assert obs.shape == (38,)
