"""The gated recurrent unit (Cho et al. 2014), `--cell gru`: three gates and one memory where the
LSTM has four and two; the paper names it as future work.

Gates in one matrix, order reset, update, candidate. The reset gate acts after the recurrent product
(as in cuDNN), so that a step is one product of the last output. Unlike the LSTM's, the input's
product can stand outside the scan: it must stay apart from the recurrent one anyway.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct

from mcx_jax.policy.dense import affine
from mcx_jax.policy.lstm import orthogonal_blocks


@struct.dataclass
class GRUCarry:
    """Memory of the cell, one row per environment; zeros at the start of an episode."""

    h: jax.Array
    """Output of the last step, (..., H)."""


class GRU(nn.Module):
    """Gated recurrent unit with `features` = H units."""

    features: int

    def setup(self) -> None:
        shape = (self.features, 3 * self.features)
        self.input_kernel = self.param("input_kernel", nn.initializers.lecun_normal(), shape)
        self.recurrent_kernel = self.param("recurrent_kernel", orthogonal_blocks, shape)
        self.bias = self.param("bias", nn.initializers.zeros, shape[1:])

    def init_carry(self, batch: tuple[int, ...]) -> GRUCarry:
        """Zeros for environments of shape `batch`."""
        return GRUCarry(jnp.zeros((*batch, self.features)))

    def step(self, carry: GRUCarry, x: jax.Array) -> tuple[GRUCarry, jax.Array]:
        """One step: carry and x (..., H) -> carry, output (..., H)."""
        h = self._advance(carry.h, affine(x, self.input_kernel, self.bias))
        return GRUCarry(h), h

    def unroll(self, carry: GRUCarry, x: jax.Array) -> tuple[GRUCarry, jax.Array]:
        """Steps over axis 0: x (T, B, H) -> carry (B, H) after the last one, outputs (T, B, H)."""

        def body(h: jax.Array, pre: jax.Array) -> tuple[jax.Array, jax.Array]:
            h = self._advance(h, pre)
            return h, h

        last, outputs = jax.lax.scan(body, carry.h, affine(x, self.input_kernel, self.bias))
        return GRUCarry(last), outputs

    def _advance(self, h: jax.Array, pre: jax.Array) -> jax.Array:
        """h (..., H), input's part of the gates (..., 3H) -> new h."""
        recurrent = affine(h, self.recurrent_kernel, jnp.zeros_like(self.bias))
        x_r, x_z, x_n = jnp.split(pre, 3, axis=-1)
        h_r, h_z, h_n = jnp.split(recurrent, 3, axis=-1)
        reset, update = _sigmoid(x_r + h_r), _sigmoid(x_z + h_z)
        candidate = jnp.tanh(x_n + reset * h_n)
        return candidate + update * (h - candidate)


def _sigmoid(x: jax.Array) -> jax.Array:
    return 0.5 + 0.5 * jnp.tanh(0.5 * x)
