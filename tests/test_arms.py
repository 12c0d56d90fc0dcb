"""The chain engine on any serial hinge arm: 4, 6 and 7 joints against C MuJoCo in float64."""

import functools

import arms
import jax
import mujoco
import numpy as np
import pytest

from mcx_jax.arm import chain
from mcx_jax.arm.model import chain_model

# Both solve the same equations; condition (1e3) times 1e-16 times accelerations of up to 1e3 rad/s2
# times 2 ms leaves 1e-13; 1e-9 is what the project promises.
F64 = 1e-9
ROWS = 48


@pytest.mark.parametrize("arm", arms.ARMS)
def test_one_step_equals_c(arm):
    mj = arms.load(arm)
    model = chain_model(mj)
    x, y, z = model.gravity
    still = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (-x, -y, -z))

    @functools.partial(jax.jit, compiler_options=arms.QUICK)
    @jax.vmap
    def step(q, qd, ctrl):
        return {
            integrator: chain.substeps(model, integrator, q, qd, ctrl, lambda i: still, 1)
            for integrator in arms.INTEGRATORS
        }

    rows = arms.states(mj, ROWS, seed=1)
    with jax.enable_x64(True):
        result = jax.tree.map(np.asarray, step(*rows))
    for integrator, (got_q, got_qd) in result.items():
        mj = arms.load(arm, integrator)
        for i, row in enumerate(zip(*rows, strict=True)):
            d = arms.c_step(mj, *row)
            np.testing.assert_allclose(got_qd[i], d.qvel, rtol=0, atol=F64)
            np.testing.assert_allclose(got_q[i], d.qpos, rtol=0, atol=F64)


@pytest.mark.parametrize("arm", arms.ARMS)
def test_the_states_reach_every_limit(arm):
    """Each force limit is active in some rows and not in others; control limits cut."""
    mj = arms.load(arm)
    q, qd, ctrl = arms.states(mj, ROWS, seed=1)
    at_limit = []
    for row in zip(q, qd, ctrl, strict=True):
        d = mujoco.MjData(mj)
        d.qpos[:], d.qvel[:], d.ctrl[:] = row
        mujoco.mj_forward(mj, d)
        at_limit.append(np.isin(d.actuator_force, mj.actuator_forcerange))
    limited = mj.actuator_forcelimited.astype(bool)
    share = np.mean(at_limit, axis=0)[limited]
    assert np.all((share > 0.05) & (share < 0.95)), share
    low, high = mj.actuator_ctrlrange[mj.actuator_ctrllimited.astype(bool)].T
    cut = ctrl[:, mj.actuator_ctrllimited.astype(bool)]
    assert np.all(np.mean((cut < low) | (cut > high), axis=0) > 0.05)
