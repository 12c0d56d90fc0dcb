"""Commands of the servos: their order, and the lead of a joint that is asked for too much."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mcx_jax.arm import chain, servo
from mcx_jax.arm.load import load_arm, start_pose
from mcx_jax.config.delay import CONTROL_DT_S, SUBSTEPS
from mcx_jax.spatial import ZERO

FASTEST = np.deg2rad([120, 120, 180, 180, 180, 180])
BRAKED = np.array([330, 330, 150, 56, 56, 56]) / 1e3
"""rad/s beyond that at which a velocity servo of 1e3 N m s/rad takes up all the other's force."""
F32 = 1e-7


@pytest.fixture(scope="module")
def model():
    return load_arm("paper", "tool")[1]


def test_order_is_the_models(model):
    reference, rate = jnp.arange(6.0), 0.1 * jnp.arange(6.0)
    # The MJCF lists six position servos, then six velocity servos.
    np.testing.assert_array_equal(
        servo.commands(model, reference, rate), np.concatenate([reference, rate])
    )


@pytest.mark.parametrize("joint", range(6))
def test_lead_of_each_joint_by_hand(model, joint):
    """A third of the position servo's force is taken up: a third of half a step's way is lost."""
    speed = FASTEST[joint] + BRAKED[joint] / 3
    for sign in (1, -1):
        rate = np.zeros(6)
        rate[joint] = sign * speed
        want = np.zeros(6)
        want[joint] = sign * 0.01 * speed / 3
        # The share is a difference of two float32 speeds of 3 rad/s (2e-7), times up to 1/0.056:
        # 4e-6 of 1; times 0.03 rad.
        np.testing.assert_allclose(servo.lost_lead(model, jnp.asarray(rate)), want, atol=2e-7)


@pytest.mark.parametrize("joint", range(6))
def test_nothing_within_the_range_and_all_far_beyond(model, joint):
    rate = np.full(6, 0.999) * FASTEST
    np.testing.assert_array_equal(servo.lost_lead(model, jnp.asarray(rate)), np.zeros(6))
    rate[joint] = 10.0
    want = np.zeros(6)
    want[joint] = 10.0 * CONTROL_DT_S / 2
    np.testing.assert_allclose(servo.lost_lead(model, jnp.asarray(rate)), want, atol=F32)


def test_no_lead_without_a_pair_of_limited_servos(model):
    """Of another arm: a velocity servo without a range, no velocity servo."""
    position, velocity = model.actuators[:6], model.actuators[6:]
    free = tuple(replace(act, ctrl_range=None) for act in velocity)
    for actuators in (position + free, position):
        other = replace(model, actuators=actuators)
        np.testing.assert_array_equal(servo.lost_lead(other, jnp.full(6, 9.0)), np.zeros(6))


def test_a_fast_shoulder_keeps_its_lead(model, monkeypatch):
    """Ten control steps of the simulated arm at 2.3 rad/s: it ends them half a step ahead of its
    references when what is lost is made up for, and not when it is not."""
    speed = 2.3
    start = jnp.asarray(start_pose(model), jnp.float32)
    still = ZERO, ZERO, (0.0, 0.0, 9.81)

    def lead(share: float) -> float:
        monkeypatch.setattr(servo, "LEAD_MADE_UP", share)

        def step(carry, k):
            q, qd = carry
            reference = start.at[0].add(speed * CONTROL_DT_S * (k + 1))
            ctrl = servo.commands(model, reference, jnp.zeros(6).at[0].set(speed))
            system = model, "quiet"
            q, qd = chain.substeps(*system, q, qd, ctrl, lambda i: still, SUBSTEPS)
            return (q, qd), q[0] - reference[0]

        moving = jnp.zeros(6).at[0].set(speed)
        return float(jax.jit(lambda: jax.lax.scan(step, (start, moving), jnp.arange(10)))()[1][-1])

    way = speed * CONTROL_DT_S / 2
    # A balance at steady speed predicts 1 - 0.62 and 1; the inertia of the way there: 0.44, 0.95.
    assert lead(0.0) == pytest.approx(0.38 * way, abs=0.1 * way)
    assert lead(1.0) == pytest.approx(way, abs=0.1 * way)
