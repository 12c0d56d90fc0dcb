"""The recurrent networks: one sequence at once = step by step = flax's own LSTM."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mcx_jax.policy import dense, gru, lstm
from mcx_jax.policy import networks as nw

HIDDEN, OBS, ACTIONS, TIME, BATCH = 16, 5, 3, 7, 4


@pytest.fixture(scope="module")
def sequence():
    return jax.random.normal(jax.random.key(7), (TIME, BATCH, OBS))


def _nets():
    nets = nw.make_networks(HIDDEN, 0.3, ACTIONS)
    params = nw.init_params(nets.policy, jax.random.key(0), OBS)
    return nets, params


def _carry(batch):
    keys = jax.random.split(jax.random.key(3))
    return lstm.LSTMCarry(*(0.5 * jax.random.normal(k, (batch, HIDDEN)) for k in keys))


def test_unroll_is_a_loop_of_steps(sequence):
    nets, params = _nets()
    carry = _carry(BATCH)
    end, means, _ = jax.jit(nw.unroll, static_argnums=0)(nets.policy, params, carry, sequence)
    step = jax.jit(nw.step, static_argnums=0)
    for t in range(TIME):
        carry, mean, _ = step(nets.policy, params, carry, sequence[t])
        np.testing.assert_allclose(means[t], mean, atol=1e-6)
    np.testing.assert_allclose(end.c, carry.c, atol=1e-6)
    np.testing.assert_allclose(end.h, carry.h, atol=1e-6)


def test_one_environment_needs_no_batch_axis(sequence):
    nets, params = _nets()
    carry, mean, sigma = nw.step(
        nets.policy, params, nw.init_carry(nets.policy, ()), sequence[0, 0]
    )
    assert mean.shape == sigma.shape == (ACTIONS,) and carry.h.shape == (HIDDEN,)


def _cell_params():
    return lstm.LSTM(HIDDEN).init(
        jax.random.key(1), _carry(1), jnp.zeros((1, HIDDEN)), method="step"
    )


def test_cell_against_flax():
    params = _cell_params()["params"]
    theirs = nn.OptimizedLSTMCell(HIDDEN)
    gates = "ifgo"
    mapped = {}
    for k, gate in enumerate(gates):
        columns = slice(k * HIDDEN, (k + 1) * HIDDEN)
        mapped[f"i{gate}"] = {"kernel": params["input_kernel"][:, columns]}
        mapped[f"h{gate}"] = {
            "kernel": params["recurrent_kernel"][:, columns],
            "bias": params["bias"][columns],
        }
    carry = _carry(BATCH)
    x = jax.random.normal(jax.random.key(2), (BATCH, HIDDEN))
    ours, y = lstm.LSTM(HIDDEN).apply({"params": params}, carry, x, method="step")
    (c, h), z = theirs.apply({"params": mapped}, (carry.c, carry.h), x)
    np.testing.assert_allclose(ours.c, c, atol=1e-6)
    np.testing.assert_allclose(ours.h, h, atol=1e-6)
    np.testing.assert_allclose(y, z, atol=1e-6)


def test_gru_against_flax():
    cell, h = gru.GRU(HIDDEN), 0.5 * jax.random.normal(jax.random.key(3), (BATCH, HIDDEN))
    x = jax.random.normal(jax.random.key(2), (TIME, BATCH, HIDDEN))
    params = cell.init(jax.random.key(1), gru.GRUCarry(h), x[0], method="step")["params"]
    params["bias"] = 0.3 * jax.random.normal(jax.random.key(4), params["bias"].shape)
    mapped = {}
    for k, gate in enumerate("rzn"):
        columns = slice(k * HIDDEN, (k + 1) * HIDDEN)
        mapped[f"i{gate}"] = {
            "kernel": params["input_kernel"][:, columns],
            "bias": params["bias"][columns],
        }
        mapped[f"h{gate}"] = {"kernel": params["recurrent_kernel"][:, columns]}
    mapped["hn"]["bias"] = jnp.zeros(HIDDEN)
    carry, z = h, []
    for t in range(TIME):
        carry, y = nn.GRUCell(HIDDEN).apply({"params": mapped}, carry, x[t])
        z.append(y)
    last, ours = cell.apply({"params": params}, gru.GRUCarry(h), x, method="unroll")
    np.testing.assert_allclose(ours, jnp.stack(z), atol=2e-6)
    np.testing.assert_array_equal(last.h, ours[-1])
    one, y = cell.apply({"params": params}, gru.GRUCarry(h), x[0], method="step")
    np.testing.assert_allclose(y, ours[0], atol=1e-6)
    np.testing.assert_array_equal(one.h, y)


def test_written_out_reverse_mode_is_the_derivative(sequence):
    """Against JAX's own derivative of the loop of steps: weights, inputs and first memory."""
    cell, params, carry = lstm.LSTM(HIDDEN), _cell_params(), _carry(BATCH)
    x = jax.random.normal(jax.random.key(5), (TIME, BATCH, HIDDEN))

    def unrolled(params, x, carry):
        end, y = cell.apply(params, carry, x, method="unroll")
        return jnp.sum(y**3) + jnp.sum(end.c * end.h)

    def looped(params, x, carry):
        total = 0.0
        for t in range(TIME):
            carry, y = cell.apply(params, carry, x[t], method="step")
            total = total + jnp.sum(y**3)
        return total + jnp.sum(carry.c * carry.h)

    ours = jax.jit(jax.grad(unrolled, argnums=(0, 1, 2)))(params, x, carry)
    theirs = jax.jit(jax.grad(looped, argnums=(0, 1, 2)))(params, x, carry)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-5, rtol=2e-5), ours, theirs)


def test_first_weights():
    nets, params = _nets()
    cell = params["params"]["net"]["cell"]
    for k in range(4):
        block = cell["recurrent_kernel"][:, k * HIDDEN : (k + 1) * HIDDEN]
        np.testing.assert_allclose(block.T @ block, np.eye(HIDDEN), atol=1e-5)
    assert cell["bias"].tolist() == [0.0] * HIDDEN + [1.0] * HIDDEN + [0.0] * 2 * HIDDEN
    obs = 3.0 * jax.random.normal(jax.random.key(9), (200, OBS))
    _, mean, sigma = nw.step(nets.policy, params, nw.init_carry(nets.policy, (200,)), obs)
    assert float(jnp.abs(mean).max()) < 0.05  # the IK baseline, but for half a millimetre
    np.testing.assert_allclose(sigma, 0.3, rtol=1e-6)


def test_affine_has_the_gradient_of_the_plain_product():
    keys = jax.random.split(jax.random.key(3), 4)
    shapes = ((5, 3, 7), (7, 4), (4,), (5, 3, 4))
    x, kernel, bias, weight = (jax.random.normal(k, s) for k, s in zip(keys, shapes, strict=True))
    ours = jax.grad(lambda *a: jnp.sum(weight * dense.affine(*a) ** 2), (0, 1, 2))(x, kernel, bias)
    plain = jax.grad(lambda x, k, b: jnp.sum(weight * (x @ k + b) ** 2), (0, 1, 2))(x, kernel, bias)
    # Another order of 15 float32 sums of size 10.
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), ours, plain)
