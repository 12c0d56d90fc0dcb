"""Commands for the position and velocity servos.

A reference is held for a control step of 20 ms in which the joint moves on. Its position servo,
stiff enough to be at its force limit nearly always, pushes it forwards before it has reached the
reference and backwards after; the velocity servo carries it. So a joint with nothing to lift ends a
control step half a step's way AHEAD of its reference, and a tool moved by six such joints is where
it should be.

Not so a joint that is asked for more than its velocity servo's range (120 deg/s at the shoulder):
that servo brakes, the position servo pushes against it for a greater part of the step, and the lead
shrinks while those of the other joints stay: the tool turns away. Rare (an elbow nearly folded),
and until it was made up for here the largest orientation error of nearly every agent.
"""

import jax
import jax.numpy as jnp

from mcx_jax.arm.model import ChainModel
from mcx_jax.config.delay import CONTROL_DT_S

LEAD_MADE_UP = 0.7
"""Share of the lost lead that is given back; 1 is what a joint that stays so fast would need, and
it does not stay so for long (experiments/servo_lead.csv)."""


def commands(model: ChainModel, reference: jax.Array, rate: jax.Array) -> jax.Array:
    """(nu,) actuator commands: velocity servos get the rate (nq,), rad/s, position servos the
    reference (nq,), rad, and what a joint beyond its velocity servo's range would lack."""
    position = reference + LEAD_MADE_UP * jax.lax.stop_gradient(lost_lead(model, rate))
    return jnp.stack([(position if act.bias[1] else rate)[act.joint] for act in model.actuators])


def lost_lead(model: ChainModel, rate: jax.Array) -> jax.Array:
    """(nq,) rad by which joints at these rates (nq,), rad/s, end a control step less far ahead of
    their references because their velocity servos brake; 0 within the servos' ranges."""
    servos = [_servos(model, joint) for joint in range(model.nq)]
    lost = [
        CONTROL_DT_S / 2 * rate[j] * jnp.clip(slope * (jnp.abs(rate[j]) - fastest), 0.0, 1.0)
        if slope
        else jnp.zeros_like(rate[j])
        for j, (fastest, slope) in enumerate(servos)
    ]
    return jnp.stack(lost)


def _servos(model: ChainModel, joint: int) -> tuple[float, float]:
    """Of a joint: the fastest rate that its velocity servo takes, rad/s, and the share of the
    position servo's force that the former takes up per rad/s beyond it (0: no such pair)."""
    mine = [act for act in model.actuators if act.joint == joint]
    pushing = [act for act in mine if act.bias[1] and act.force_range]
    carrying = [act for act in mine if not act.bias[1] and act.bias[2] and act.ctrl_range]
    if len(pushing) != 1 or len(carrying) != 1:
        return 0.0, 0.0
    force_range, ctrl_range = pushing[0].force_range, carrying[0].ctrl_range
    assert force_range and ctrl_range
    fastest = min(-ctrl_range[0], ctrl_range[1])
    return fastest, -carrying[0].bias[2] / min(-force_range[0], force_range[1])
