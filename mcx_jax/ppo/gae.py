"""Advantages and returns. Time is the first axis; the window's end bootstraps (a truncation)."""

import jax
import jax.numpy as jnp


def gae(
    *,
    rewards: jax.Array,
    values: jax.Array,
    last_value: jax.Array,
    discounts: jax.Array,
    lam: float,
) -> tuple[jax.Array, jax.Array]:
    """Generalised advantage estimation (Schulman et al. 2016, eqs. 11-16).

    Args:
        rewards: r_t of the step from state t to t + 1, (T, ...).
        values: V of state t, (T, ...).
        last_value: V of the state after the last step, (...).
        discounts: gamma, or 0 where state t + 1 is terminal, (T, ...).
        lam: lambda.

    Returns:
        Advantages A_t, and the targets A_t + V_t (lambda returns), (T, ...).
    """
    next_values = jnp.concatenate([values[1:], last_value[None]])
    deltas = rewards + discounts * next_values - values

    def body(advantage: jax.Array, step):
        delta, discount = step
        advantage = delta + discount * lam * advantage
        return advantage, advantage

    _, advantages = jax.lax.scan(
        body, jnp.zeros_like(last_value), (deltas, discounts), reverse=True
    )
    return advantages, advantages + values


def discounted_returns(
    *,
    rewards: jax.Array,
    last_value: jax.Array,
    discounts: jax.Array,
) -> jax.Array:
    """G_t = r_t + discount_t G_{t+1}, with last_value (...) after the last step: (T, ...)."""

    def body(following: jax.Array, step):
        reward, discount = step
        following = reward + discount * following
        return following, following

    _, returns = jax.lax.scan(body, last_value, (rewards, discounts), reverse=True)
    return returns
