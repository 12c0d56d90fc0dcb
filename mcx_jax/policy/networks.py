"""Policy and value network: normalised observation -> 2 x dense tanh -> LSTM with a skip -> head.

Both are separate networks with the same torso (paper; authors' code). All methods take
NORMALISED observations (`ppo.normalise`) and leave batch axes in front: step (..., F), unroll
(T, B, F).
"""

from dataclasses import dataclass
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from mcx_jax.policy.dense import Dense
from mcx_jax.policy.gru import GRU
from mcx_jax.policy.lstm import LSTM

Params = Any
"""A network's weights, as flax nests them."""
Carry = Any
"""A cell's memory: a pytree of zeros at the start of an episode, batch leading."""

HEAD_SCALE_POLICY = 0.01
"""The first policy acts like a = 0, the IK baseline: with a full-size head it would start by moving
the goal by centimetres."""


CELLS = {"lstm": LSTM, "gru": GRU}
"""Recurrent cells by the name that `--cell` gives them."""


def init_carry(net: "PolicyNet | ValueNet", batch: tuple[int, ...]) -> Carry:
    """The memory of environments of shape `batch` at the start of an episode."""
    return CELLS[net.cell](net.hidden).init_carry(batch)


class RecurrentNet(nn.Module):
    """Torso and linear head.

    Attributes:
        hidden: width H of the dense layers and of the cell.
        outputs: width O of the head.
        cell_name: the recurrent cell, see CELLS.
        head_scale: size of the head's initial weights.
    """

    hidden: int
    outputs: int
    cell_name: str
    head_scale: float = 1.0

    def setup(self) -> None:
        self.dense = [Dense(self.hidden) for _ in range(2)]
        self.cell = CELLS[self.cell_name](self.hidden)
        scale = nn.initializers.variance_scaling(self.head_scale**2, "fan_in", "normal")
        self.head = Dense(self.outputs, kernel_init=scale)

    def step(self, carry: Carry, obs: jax.Array) -> tuple[Carry, jax.Array]:
        """obs (..., F) -> carry, head output (..., O)."""
        x = self._embed(obs)
        carry, y = self.cell.step(carry, x)
        return carry, self.head(x + y)

    def unroll(self, carry: Carry, obs: jax.Array) -> tuple[Carry, jax.Array]:
        """obs (T, B, F) -> carry after the last step, head outputs (T, B, O)."""
        x = self._embed(obs)
        carry, y = self.cell.unroll(carry, x)
        return carry, self.head(x + y)

    def _embed(self, x: jax.Array) -> jax.Array:
        for layer in self.dense:
            x = jnp.tanh(layer(x))
        return x


class PolicyNet(nn.Module):
    """Mean of the actions from a `RecurrentNet`, and a free standard deviation for each of them."""

    hidden: int
    actions: int
    initial_sigma: float = 1.0
    cell: str = "lstm"

    def setup(self) -> None:
        self.net = RecurrentNet(self.hidden, self.actions, self.cell, HEAD_SCALE_POLICY)
        raw = float(np.log(np.expm1(self.initial_sigma)))  # softplus(raw) = initial_sigma
        self.raw_sigma = self.param("raw_sigma", nn.initializers.constant(raw), (self.actions,))

    def step(self, carry: Carry, obs: jax.Array) -> tuple[Carry, jax.Array, jax.Array]:
        """obs (..., F) -> carry, mean (..., A), standard deviation (A,)."""
        carry, mean = self.net.step(carry, obs)
        return carry, mean, jax.nn.softplus(self.raw_sigma)

    def unroll(self, carry: Carry, obs: jax.Array) -> tuple[Carry, jax.Array, jax.Array]:
        """obs (T, B, F) -> carry after the last step, means (T, B, A), standard deviation (A,)."""
        carry, mean = self.net.unroll(carry, obs)
        return carry, mean, jax.nn.softplus(self.raw_sigma)


class ValueNet(nn.Module):
    """Normalised value of the present state (`ppo.normalise` holds the scale)."""

    hidden: int
    cell: str = "lstm"

    def setup(self) -> None:
        self.net = RecurrentNet(self.hidden, 1, self.cell)

    def step(self, carry: Carry, obs: jax.Array) -> tuple[Carry, jax.Array]:
        """obs (..., F) -> carry, value (...)."""
        carry, value = self.net.step(carry, obs)
        return carry, value[..., 0]

    def unroll(self, carry: Carry, obs: jax.Array) -> tuple[Carry, jax.Array]:
        """obs (T, B, F) -> carry after the last step, values (T, B)."""
        carry, value = self.net.unroll(carry, obs)
        return carry, value[..., 0]


@dataclass(frozen=True)
class Networks:
    """Both networks without their weights; hashable, so static under jit."""

    policy: PolicyNet
    value: ValueNet


def make_networks(hidden: int, initial_sigma: float, actions: int, cell: str = "lstm") -> Networks:
    """The networks of a configuration."""
    return Networks(PolicyNet(hidden, actions, initial_sigma, cell), ValueNet(hidden, cell))


def init_params(net: "PolicyNet | ValueNet", key: jax.Array, obs_size: int) -> Params:
    """First weights of either network."""
    carry = init_carry(net, ())
    return net.init(key, carry, jnp.zeros((obs_size,)), method="step")


def step(net: nn.Module, params: Params, carry: Carry, obs: jax.Array) -> Any:
    """`net.step` with `params`."""
    return net.apply(params, carry, obs, method="step")


def unroll(net: nn.Module, params: Params, carry: Carry, obs: jax.Array) -> Any:
    """`net.unroll` with `params`."""
    return net.apply(params, carry, obs, method="unroll")
