"""Golden values worked by hand, and laws, for the pure functions of the learner."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mcx_jax.policy import normalise as nm
from mcx_jax.policy.gaussian import action_distribution
from mcx_jax.ppo.gae import discounted_returns, gae
from mcx_jax.ppo.loss import (
    clipped_surrogate,
    explained_variance,
    huber,
    masked_mean,
    reported_mean,
    standardise,
    value_loss,
)
from mcx_jax.ppo.sequences import flatten_starts, minibatch_order, take, to_sequences


@pytest.fixture(autouse=True)
def strict():
    """Our own maths promotes no types and no ranks by accident."""
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        yield


def test_gae_by_hand():
    # gamma 0.5, lambda 0.5, so A_t = delta_t + 0.25 A_{t+1}; last value 8.
    # delta_2 = 3 + 0.5*8 - 6 = 1          A_2 = 1
    # delta_1 = 2 + 0.5*6 - 4 = 1          A_1 = 1 + 0.25*1    = 1.25
    # delta_0 = 1 + 0.5*4 - 2 = 1          A_0 = 1 + 0.25*1.25 = 1.3125
    advantages, targets = gae(
        rewards=jnp.array([1.0, 2.0, 3.0]),
        values=jnp.array([2.0, 4.0, 6.0]),
        last_value=jnp.array(8.0),
        discounts=jnp.full(3, 0.5),
        lam=0.5,
    )
    np.testing.assert_allclose(advantages, [1.3125, 1.25, 1.0], rtol=1e-6)
    np.testing.assert_allclose(targets, [3.3125, 5.25, 7.0], rtol=1e-6)


def test_gae_of_an_end():
    # The same with a terminal state after step 1 (discount 0): delta_1 = 2 - 4 = -2 = A_1,
    # A_0 = 1 + 0.25*(-2) = 0.5; A_2 is of the next episode and unchanged.
    advantages, _ = gae(
        rewards=jnp.array([1.0, 2.0, 3.0]),
        values=jnp.array([2.0, 4.0, 6.0]),
        last_value=jnp.array(8.0),
        discounts=jnp.array([0.5, 0.0, 0.5]),
        lam=0.5,
    )
    np.testing.assert_allclose(advantages, [0.5, -2.0, 1.0], rtol=1e-6)


def test_gae_with_lambda_one_is_the_discounted_return():
    rng = np.random.default_rng(0)
    rewards, values = (jnp.asarray(rng.normal(size=(7, 3)), jnp.float32) for _ in range(2))
    last, discounts = jnp.asarray(rng.normal(size=3), jnp.float32), jnp.full((7, 3), 0.9)
    _, targets = gae(rewards=rewards, values=values, last_value=last, discounts=discounts, lam=1.0)
    returns = discounted_returns(rewards=rewards, last_value=last, discounts=discounts)
    np.testing.assert_allclose(targets, returns, rtol=1e-5, atol=1e-5)


def test_discounted_returns_by_hand():
    # G_2 = 3 + 0.5*8 = 7, G_1 = 2 + 0.5*7 = 5.5, G_0 = 1 + 0.5*5.5 = 3.75
    returns = discounted_returns(
        rewards=jnp.array([1.0, 2.0, 3.0]), last_value=jnp.array(8.0), discounts=jnp.full(3, 0.5)
    )
    np.testing.assert_allclose(returns, [3.75, 5.5, 7.0])


def test_clipped_surrogate_by_hand():
    # Ratios 1.5, 0.5, 1.1, 0.5 with clip 0.2:
    #   A = +1, r = 1.5 -> min(1.5, 1.2)           =  1.2
    #   A = +1, r = 0.5 -> min(0.5, 0.8)           =  0.5
    #   A = -1, r = 1.1 -> min(-1.1, -1.1)         = -1.1
    #   A = -1, r = 0.5 -> min(-0.5, -0.8)         = -0.8   mean -0.05
    # entropy 2 with weight 0.1: loss = 0.05 - 0.2 = -0.15. The fifth entry is masked, and NaN.
    ratios = jnp.array([1.5, 0.5, 1.1, 0.5, jnp.nan])
    loss, stats = clipped_surrogate(
        log_prob=jnp.log(ratios) + 3.0,
        old_log_prob=jnp.full(5, 3.0),
        advantage=jnp.array([1.0, 1.0, -1.0, -1.0, 0.0]),
        entropy=jnp.full(5, 2.0),
        mask=jnp.array([1.0, 1.0, 1.0, 1.0, 0.0]),
        clip=0.2,
        entropy_coef=0.1,
    )
    np.testing.assert_allclose(loss, -0.15, rtol=1e-5)
    # KL = mean of (r - 1 - ln r) = (0.094535 + 0.193147 + 0.004690 + 0.193147) / 4
    np.testing.assert_allclose(stats.kl, 0.12138, rtol=1e-4)
    np.testing.assert_allclose(stats.clip_share, 0.75)
    np.testing.assert_allclose(stats.ratio_deviation, 0.5, rtol=1e-5)
    np.testing.assert_allclose(stats.entropy, 2.0)


def test_gradient_of_the_surrogate_ignores_what_is_masked():
    def loss(log_prob, advantage):
        return clipped_surrogate(
            log_prob=log_prob,
            old_log_prob=jnp.zeros(2),
            advantage=advantage,
            entropy=jnp.zeros(2),
            mask=jnp.array([1.0, 0.0]),
            clip=0.2,
            entropy_coef=0.0,
        )[0]

    # At ratio 1 the gradient is -A / (number of entries that count): here -2 / 1.
    with jax.numpy_rank_promotion("allow"):
        gradient = jax.grad(loss)(jnp.array([0.0, 0.3]), jnp.array([2.0, 5.0]))
    np.testing.assert_allclose(gradient, [-2.0, 0.0])


def test_entropy_of_the_actions():
    # 0.5 ln(2 pi e) = 1.4189385 each, plus ln sigma: ln 0.5 = -0.6931472, ln 2 = +0.6931472.
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        distribution = action_distribution(jnp.zeros((3, 2)), jnp.array([0.5, 2.0]))
        np.testing.assert_allclose(distribution.entropy(), np.full(3, 2.837877), rtol=1e-6)
        # log-density at the mean: -2 * 0.5 ln(2 pi) - ln 0.5 - ln 2 = -1.837877
        np.testing.assert_allclose(distribution.log_prob(jnp.zeros((3, 2))), -1.837877, rtol=1e-6)


def test_huber_by_hand():
    # 0.5 * 0.5^2 = 0.125; 0.5 at the joint; 3 - 0.5 = 2.5 on either side.
    np.testing.assert_allclose(huber(jnp.array([0.5, 1.0, 3.0, -3.0])), [0.125, 0.5, 2.5, 2.5])
    loss = value_loss(jnp.array([1.0, 9.0]), jnp.array([0.5, jnp.nan]), jnp.array([1.0, 0.0]))
    np.testing.assert_allclose(loss, 0.125)


def test_masked_mean_and_standardise():
    x, mask = jnp.array([1.0, 3.0, jnp.nan]), jnp.array([1.0, 1.0, 0.0])
    assert masked_mean(x, mask) == 2.0
    assert masked_mean(x, jnp.zeros(3)) == 0.0
    assert reported_mean(x, mask) == 2.0 and jnp.isnan(reported_mean(x, jnp.zeros(3)))
    np.testing.assert_allclose(standardise(x, mask), [-1.0, 1.0, 0.0], rtol=1e-6)


def test_explained_variance_by_hand():
    # Targets 0, 2, 4: variance 8/3. Errors 1, 0, -1 (mean 0): variance 2/3. 1 - 1/4 = 0.75.
    target, mask = jnp.array([0.0, 2.0, 4.0]), jnp.ones(3)
    np.testing.assert_allclose(
        explained_variance(jnp.array([-1.0, 2.0, 5.0]), target, mask), 0.75, rtol=1e-6
    )


def test_chunks_keep_their_order():
    # Entry 100 t + n says where it came from: T = 6, N = 3, L = 2.
    t, n = np.meshgrid(np.arange(6), np.arange(3), indexing="ij")
    chunks = to_sequences(jnp.asarray(100 * t + n), 2)
    assert chunks.shape == (2, 9)
    for k in range(3):
        for env in range(3):
            expected = [100 * (2 * k) + env, 100 * (2 * k + 1) + env]
            assert chunks[:, 3 * env + k].tolist() == expected
    starts = flatten_starts(jnp.asarray(100 * t + n)[::2])
    assert starts.tolist() == chunks[0].tolist()


def test_minibatches_hold_every_sequence_once_an_epoch():
    # 12 sequences in 2 shards, 3 epochs, 3 minibatches: 2 sequences of each shard in each.
    order = np.asarray(minibatch_order(jax.random.key(0), 12, 3, 3, 2))
    assert order.shape == (9, 2, 2)
    data = jnp.arange(12)
    epochs = [
        np.concatenate([take(data, jnp.asarray(chosen), 0) for chosen in epoch])
        for epoch in order.reshape(3, 3, 2, 2)
    ]
    for epoch in epochs:
        assert sorted(epoch.tolist()) == list(range(12))
    assert not np.array_equal(epochs[0], epochs[1])


def test_a_minibatch_takes_whole_sequences():
    # Entry 100 t + n: step t of sequence n; 2 shards of 3 sequences.
    data = jnp.asarray(100 * np.arange(4)[:, None] + np.arange(6))
    got = take(data, jnp.array([[2, 0], [1, 1]]), 1)
    np.testing.assert_array_equal(got, 100 * np.arange(4)[:, None] + [2, 0, 4, 4])


def _merged(batches, masks=None):
    stats = nm.init_stats(batches[0].shape[2:])
    for i, batch in enumerate(batches):
        mask = np.ones(batch.shape[:2]) if masks is None else masks[i]
        with jax.numpy_rank_promotion("allow"):
            stats = nm.merge(stats, jnp.asarray(batch, jnp.float32), jnp.asarray(mask, jnp.float32))
    return stats


def test_running_statistics_against_numpy():
    rng = np.random.default_rng(1)
    batches = [rng.normal(3.0 * i, 1.0 + i, size=(5, 40, 2)) for i in range(3)]
    stats = _merged(batches)
    samples = np.concatenate([b.reshape(-1, 2) for b in batches])
    assert stats.count == len(samples)
    np.testing.assert_allclose(stats.mean, samples.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(stats.var, samples.var(axis=0), rtol=1e-5)


def test_running_statistics_leave_out_what_is_masked():
    rng = np.random.default_rng(2)
    batch = rng.normal(size=(4, 6, 2))
    mask = np.ones((4, 6))
    mask[:, 2] = 0
    spoilt = batch.copy()
    spoilt[:, 2] = np.nan
    stats = _merged([batch, spoilt], [np.ones((4, 6)), mask])
    samples = np.concatenate([batch.reshape(-1, 2), batch[:, [0, 1, 3, 4, 5]].reshape(-1, 2)])
    np.testing.assert_allclose(stats.mean, samples.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(stats.var, samples.var(axis=0), rtol=1e-5)
    nothing = _merged([spoilt], [np.zeros((4, 6))])
    assert nothing.count == 0 and nothing.std.tolist() == [1.0, 1.0]


def test_running_statistics_of_a_column_near_one_keep_their_digits():
    # A cosine near 1 that moves by 1e-4: E[x^2] - E[x]^2 in float32 would give noise or less.
    rng = np.random.default_rng(3)
    batches = [1.0 - 1e-4 * rng.random(size=(32, 256, 1)) for _ in range(20)]
    stats = _merged(batches)
    samples = np.concatenate(batches).astype(np.float32).astype(np.float64)
    np.testing.assert_allclose(stats.var[0], samples.var(), rtol=1e-3)


def test_old_samples_are_forgotten_where_asked():
    stats = nm.init_stats(())
    for value in (0.0, 10.0):
        stats = nm.merge(stats, jnp.full((4,), value), jnp.ones(4), keep=0.5)
    # weights 2 and 4: mean 10 * 4/6
    np.testing.assert_allclose(stats.mean, 6.6666, rtol=1e-4)


def test_normalise_inverse_floor_and_bound():
    stats = nm.RunningStats(count=jnp.ones(()), mean=jnp.array(2.0), var=jnp.array(9.0))
    assert nm.normalise(stats, jnp.array(8.0)) == 2.0
    assert nm.denormalise(stats, jnp.array(2.0)) == 8.0
    constant = stats.replace(var=jnp.array(0.0))
    assert constant.std == jnp.float32(nm.STD_FLOOR)
    assert nm.normalise_obs(constant, jnp.array(3.0)) == nm.CLIP
