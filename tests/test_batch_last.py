"""vmap that calls a function once, on the whole batch: values, derivative, number of traces."""

import jax
import jax.numpy as jnp
import numpy as np

from mcx_jax.compute.batch_last import batch_last

# A dozen float32 operations on numbers of 1, in another order at most.
F32 = 1e-6


def swing(q, lengths, is_stiff):
    """Elementwise on leading components, pytrees in and out."""
    tip = jnp.stack([lengths["a"] * jnp.sin(q[0]), lengths["b"] * jnp.cos(q[0] * q[1])])
    return {"tip": jnp.where(is_stiff, 0.0, tip), "sum": (q[0] + q[1],)}


Q = jax.random.normal(jax.random.key(0), (5, 2))
LENGTHS = {"a": jnp.float32(0.7), "b": jax.random.normal(jax.random.key(1), (5,))}
AXES = (0, {"a": None, "b": 0}, None)


def equal(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, atol=F32)


def test_without_vmap_it_is_the_function():
    lengths = {"a": LENGTHS["a"], "b": LENGTHS["b"][0]}
    equal(batch_last(swing)(Q[0], lengths, False), swing(Q[0], lengths, False))
    equal(jax.jit(batch_last(swing))(Q[0], lengths, False), swing(Q[0], lengths, False))


def test_vmap_is_jaxs_with_arguments_that_are_not_batched():
    given = Q, LENGTHS, jnp.bool_(False)
    equal(jax.vmap(batch_last(swing), AXES)(*given), jax.vmap(swing, AXES)(*given))
    # The batch may be any axis, in and out.
    last = jax.vmap(batch_last(swing), (1, *AXES[1:]), out_axes=-1)(Q.T, *given[1:])
    equal(last, jax.vmap(swing, AXES, out_axes=-1)(*given))


def test_vmap_of_vmap():
    """Seeds over environments."""
    q = jax.random.normal(jax.random.key(2), (3, 5, 2))
    twice = [
        jax.vmap(jax.vmap(f, AXES), (0, None, None))(q, LENGTHS, jnp.bool_(False))
        for f in (batch_last(swing), swing)
    ]
    equal(*twice)


def test_derivative_from_outside_the_vmap():
    def loss(f):
        def of(q, b):
            out = jax.vmap(f, AXES)(q, {**LENGTHS, "b": b}, jnp.bool_(False))
            return jnp.sum(out["tip"] ** 2) + jnp.sum(out["sum"][0])

        return jax.jit(jax.grad(of, argnums=(0, 1)))(Q, LENGTHS["b"])

    slopes = loss(batch_last(swing))
    equal(slopes, loss(swing))
    assert all(jnp.abs(x).max() > 0.1 for x in slopes)


def test_the_function_sees_the_batch_last_and_once():
    seen = []

    def look(x):
        seen.append(x.shape)
        return 2.0 * x

    jax.jit(jax.vmap(batch_last(look))).trace(jnp.zeros((5, 2)))
    assert seen == [(2, 5)]
