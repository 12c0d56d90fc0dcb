"""The recurrent cell. A cell has `init_carry`, `step` and `unroll`, and an opaque carry (a pytree
whose leaves are zeros at the start of an episode): that is all that the networks know of it.

The LSTM is the textbook one (Hochreiter & Schmidhuber 1997, forget gate of Gers et al. 2000) with
its four gates in one matrix, order input, forget, cell, output. A step is one product of [input,
last output] with both matrices: hoisting the input's product out of the scan, as is usual, writes
and reads back (T, B, 4H) numbers (two CPU cores, 256 rows: the network's forward pass took 5.2
instead of 3.8 us a step, its gradient 15.6 instead of 14.5). The reverse mode is written out: one
product a step, and one over all steps for the gradient of the matrices.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct

from mcx_jax.compute.fusion import opaque_true, stage
from mcx_jax.policy.dense import affine, kernel_gradient

NEWTON_SCHULZ_STEPS = 60
"""Enough for singular values down to 1e-9 of the largest."""


@struct.dataclass
class LSTMCarry:
    """Memory of the cell, one row per environment; zeros at the start of an episode.

    Attributes:
        c: cell state, (..., H).
        h: output of the last step, (..., H).
    """

    c: jax.Array
    h: jax.Array


class LSTM(nn.Module):
    """Long short-term memory with `features` = H units."""

    features: int

    def setup(self) -> None:
        width = 4 * self.features
        self.input_kernel = self.param(
            "input_kernel", nn.initializers.lecun_normal(), (self.features, width)
        )
        self.recurrent_kernel = self.param(
            "recurrent_kernel", orthogonal_blocks, (self.features, width)
        )
        self.bias = self.param("bias", _forget_bias_one, (width,))

    def init_carry(self, batch: tuple[int, ...]) -> LSTMCarry:
        """Zeros for environments of shape `batch`."""
        return LSTMCarry(*(jnp.zeros((*batch, self.features)) for _ in range(2)))

    def step(self, carry: LSTMCarry, x: jax.Array) -> tuple[LSTMCarry, jax.Array]:
        """One step: carry and x (..., H) -> carry, output (..., H)."""
        carry = _advance(carry.c, _gates(self._kernel(), self.bias, x, carry.h))
        return carry, carry.h

    def unroll(self, carry: LSTMCarry, x: jax.Array) -> tuple[LSTMCarry, jax.Array]:
        """Steps over axis 0: x (T, B, H) -> carry (B, H) after the last one, outputs (T, B, H)."""
        return _unroll(self._kernel(), self.bias, x, carry)

    def _kernel(self) -> jax.Array:
        return jnp.concatenate([self.input_kernel, self.recurrent_kernel])


def _gates(kernel: jax.Array, bias: jax.Array, x: jax.Array, h: jax.Array) -> jax.Array:
    """Activated gates (..., 4H) of input x and last output h, (..., H) each."""
    return _activate(affine(jnp.concatenate([x, h], axis=-1), kernel, bias))


def orthogonal_blocks(key: jax.Array, shape: tuple[int, int]) -> jax.Array:
    """Orthogonal (H, H) blocks side by side: each gate keeps the norm of what it reads.

    The orthogonal factor of a Gaussian matrix by Newton-Schulz iteration (small singular values
    grow by 1.5 a step), not by QR: jaxlib's batched LAPACK calls wait in XLA's thread pool for
    threads of that pool, and two of them at once (policy and value network, or seeds) on a machine
    with two cores wait for each other for ever.
    """
    size = shape[0]
    blocks = jax.random.normal(key, (shape[1] // size, size, size))
    blocks = blocks / jnp.linalg.norm(blocks, axis=(1, 2), keepdims=True)

    def improve(_: int, x: jax.Array) -> jax.Array:
        gram = jnp.matmul(jnp.swapaxes(x, 1, 2), x, precision="highest")
        return 1.5 * x - 0.5 * jnp.matmul(x, gram, precision="highest")

    blocks = jax.lax.fori_loop(0, NEWTON_SCHULZ_STEPS, improve, blocks)
    return jnp.concatenate(list(blocks), axis=1)


def _forget_bias_one(key: jax.Array, shape: tuple[int]) -> jax.Array:
    """Forget gate half open at the start (Gers et al. 2000), so that gradients reach back."""
    del key
    return jnp.zeros(shape).at[shape[0] // 4 : shape[0] // 2].set(1.0)


def _activate(pre: jax.Array) -> jax.Array:
    """Activations of the four gates: pre (..., 4H) -> (..., 4H), the third block tanh.

    sigmoid(x) = 1/2 + tanh(x/2) / 2 makes all four one tanh between a scale and a shift, which is
    one loop over (B, 4H). Splitting, activating and joining the blocks made a sequence's forward
    pass take twice as long.
    """
    is_cell = jnp.arange(4).repeat(pre.shape[-1] // 4) == 2
    scale = jnp.where(is_cell, 1.0, 0.5)
    return scale * jnp.tanh(scale * pre) + jnp.where(is_cell, 0.0, 0.5)


def _advance(c: jax.Array, gates: jax.Array) -> LSTMCarry:
    c, _, h = _advance_with_tanh(c, gates)
    return LSTMCarry(c=c, h=h)


def _advance_with_tanh(c: jax.Array, gates: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """New cell state, its tanh, and the output; (..., H) each."""
    i, f, g, o = jnp.split(gates, 4, axis=-1)
    c = f * c + i * g
    tanh_c = jnp.tanh(c)
    return c, tanh_c, o * tanh_c


@jax.custom_vjp
def _unroll(
    kernel: jax.Array, bias: jax.Array, x: jax.Array, carry: LSTMCarry
) -> tuple[LSTMCarry, jax.Array]:
    """kernel (2H, 4H), bias (4H,), x (T, B, H), carry (B, H) -> last carry, outputs (T, B, H)."""

    def body(carry: LSTMCarry, x: jax.Array):
        carry = _advance(carry.c, _gates(kernel, bias, x, carry.h))
        return carry, carry.h

    return jax.lax.scan(body, carry, x)


def _unroll_forward(kernel: jax.Array, bias: jax.Array, x: jax.Array, carry: LSTMCarry):
    """`_unroll`, keeping of every step its gates (T, B, 4H), the cell state before it, the tanh of
    the one after it, and its output (T, B, H)."""

    def body(carry: LSTMCarry, x: jax.Array):
        gates = _gates(kernel, bias, x, carry.h)
        c, tanh_c, h = _advance_with_tanh(carry.c, gates)
        return LSTMCarry(c=c, h=h), (gates, carry.c, tanh_c, h)

    last, kept = jax.lax.scan(body, carry, x)
    return (last, kept[-1]), (kernel, x, carry, kept)


def _unroll_backward(saved, cotangents):
    kernel, x, carry, (gates, cells_before, tanh_cells, outputs) = saved
    d_last, d_outputs = cotangents
    hidden = x.shape[-1]
    kernel_t = kernel.T
    wall = opaque_true(kernel)

    def body(d_carry: LSTMCarry, step):
        d_output, gate, c_before, tanh_c = step
        d_pre, d_c = stage(wall, _backward_step, d_output, d_carry, gate, c_before, tanh_c)
        d_x, d_h = jnp.split(d_pre @ kernel_t, [hidden], axis=-1)
        return LSTMCarry(c=d_c, h=d_h), (d_pre, d_x)

    d_first, (d_pre, d_x) = jax.lax.scan(
        body, d_last, (d_outputs, gates, cells_before, tanh_cells), reverse=True
    )
    outputs_before = jnp.concatenate([carry.h[None], outputs[:-1]])
    d_kernel = kernel_gradient(jnp.concatenate([x, outputs_before], axis=-1), d_pre)
    return d_kernel, d_pre.sum(axis=(0, 1)), d_x, d_first


def _backward_step(
    d_output: jax.Array,
    d_carry: LSTMCarry,
    gates: jax.Array,
    c_before: jax.Array,
    tanh_c: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Cotangents of the gates before activation (B, 4H) and of the cell state before (B, H)."""
    i, f, g, o = jnp.split(gates, 4, axis=-1)
    d_h = d_carry.h + d_output
    d_c = d_carry.c + d_h * o * (1 - tanh_c**2)
    d_pre = [
        d_c * g * i * (1 - i),
        d_c * c_before * f * (1 - f),
        d_c * i * (1 - g**2),
        d_h * tanh_c * o * (1 - o),
    ]
    return jnp.concatenate(d_pre, axis=-1), d_c * f


_unroll.defvjp(_unroll_forward, _unroll_backward)
