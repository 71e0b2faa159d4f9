"""The sampler's counts are Poisson: exact quantiles, moments and tails, and independent draws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.random import threefry_2x32
from scipy import stats

from cannoise_jax.physics.core import tukey_lambda
from cannoise_jax.physics.core.poisson_gaussian import (
    centred_uniform,
    electrons_from_nlf,
    nlf_from_electrons,
    nlf_sigma,
    poisson_quantile,
    sample_normal,
    sample_poisson,
)
from cannoise_jax.physics.core.random_bits import random_bits, threefry

MEANS = (0.01, 0.3, 1.0, 4.0, 11.9, 12.1, 20.0, 75.0, 1e3, 1e4, 1e5)
GRID = 2**20
# Every probability that a 20-bit uniform number can have: the distribution itself, not a sample of it.
CENTRED = (np.arange(GRID) + 0.5) / GRID * 2 - 1
quantiles = jax.jit(poisson_quantile)


def counts_at(mean: float) -> np.ndarray:
    return np.asarray(quantiles(jnp.asarray(CENTRED, jnp.float32), jnp.float32(mean)), np.float64)


def smallest_count(probability, mean):
    """The quantile: the smallest count with at least that probability up to it."""
    counts = np.arange(int(max(mean - 12 * mean**0.5, 0)), int(mean + 12 * mean**0.5) + 50)
    return counts[np.searchsorted(stats.poisson.cdf(counts, mean), probability)]


@pytest.mark.parametrize("mean", MEANS)
def test_quantiles_are_exact_but_for_rare_steps(mean):
    ours, exact = counts_at(mean), smallest_count((CENTRED + 1) / 2, mean)
    assert np.abs(ours - exact).max() <= 1
    # float32 rounds a quantile across a whole number the more often the larger it is.
    assert np.mean(ours != exact) < max(5e-4, 6e-8 * mean)


@pytest.mark.parametrize(
    "mean",
    [
        0.0,
        pytest.param(1e-3, marks=pytest.mark.slow),
        0.1,
        2.0,
        pytest.param(5.0, marks=pytest.mark.slow),
        11.9,
    ],
)
def test_the_most_extreme_uniforms_give_the_extreme_quantiles(mean):
    # The highest and lowest values that `centred_uniform` can return.
    last = np.arange(2**24 - 2**16, 2**24) - (2**23 - 0.5)
    v = np.concatenate([last, -last]) * 2.0**-23
    ours = np.asarray(quantiles(jnp.asarray(v, jnp.float32), jnp.float32(mean)), np.float64)
    exact = np.where(v > 0, stats.poisson.isf((1 - v) / 2, mean), stats.poisson.ppf((1 + v) / 2, mean))
    if mean == 0:
        exact = np.zeros_like(v)
    assert np.abs(ours - exact).max() <= 2  # float32 sums are off by the last of 2^24 uniforms
    assert np.mean(ours != exact) < 5e-3


@pytest.mark.parametrize("mean", MEANS)
def test_moments_and_tails(mean):
    counts = counts_at(mean)
    centred = counts - counts.mean()
    variance = np.mean(centred**2)
    assert counts.mean() == pytest.approx(mean, rel=1e-4, abs=1e-5)
    assert variance == pytest.approx(mean, rel=1e-3)
    if mean >= 0.3:  # below, a grid of 2^20 probabilities cuts off what matters for the third moment
        assert np.mean(centred**3) / variance**1.5 == pytest.approx(mean**-0.5, rel=0.01, abs=2e-5)
    for chance in (1e-2, 1e-3, 1e-4):
        high, low = stats.poisson.isf(chance, mean), stats.poisson.ppf(chance, mean)
        assert np.mean(counts > high) == pytest.approx(stats.poisson.sf(high, mean), rel=0.05, abs=2 / GRID)
        assert np.mean(counts <= low) == pytest.approx(stats.poisson.cdf(low, mean), rel=0.12, abs=2 / GRID)


@pytest.mark.parametrize("mean", [0.05, 2.0, 11.0, 13.0, 300.0])
def test_draws_pass_a_chi_square_test(mean):
    counts = np.asarray(sample_poisson(jax.random.key(4), jnp.full(200_000, mean, jnp.float32)))
    low, high = int(stats.poisson.ppf(1e-4, mean)), int(stats.poisson.isf(1e-4, mean))
    edges = np.arange(low, high + 1)
    seen = np.array([(counts <= low).sum(), *[(counts == k).sum() for k in edges[1:]], (counts > high).sum()])
    expected = np.diff(np.concatenate([[0], stats.poisson.cdf(edges, mean), [1]])) * counts.size
    keep = expected > 5
    statistic = np.sum((seen[keep] - expected[keep]) ** 2 / expected[keep])
    assert stats.chi2.sf(statistic, keep.sum() - 1) > 1e-4


def test_bits_are_those_of_threefry():
    key = jax.random.key(3)
    data = jax.random.key_data(key)
    counts = jnp.arange(8, dtype=jnp.uint32)
    ours = jnp.concatenate(threefry((data[0], data[1]), counts[:4], counts[4:]))
    np.testing.assert_array_equal(ours, threefry_2x32((data[0], data[1]), counts))


def test_bits_depend_on_the_key_and_differ_from_those_of_jax_random():
    one, two = (np.asarray(random_bits(jax.random.key(k), (64, 64))) for k in (1, 2))
    assert np.unique(np.concatenate([one.ravel(), two.ravel()])).size == 2 * 64 * 64
    theirs = np.asarray(jax.random.bits(jax.random.key(1), (64 * 64,)))
    assert np.intersect1d(one, theirs).size == 0
    both = jax.vmap(lambda k: random_bits(k, (8,)))(jax.random.split(jax.random.key(1)))
    np.testing.assert_array_equal(both[1], random_bits(jax.random.split(jax.random.key(1))[1], (8,)))
    set_bits = np.unpackbits(one.view(np.uint8)).mean()
    assert abs(set_bits - 0.5) < 5 * 0.5 / np.sqrt(32 * 64 * 64)


def test_zero_and_negative_means_give_no_counts():
    assert np.all(np.asarray(sample_poisson(jax.random.key(0), jnp.array([0.0, -3.0] * 500))) == 0)


def test_uniforms_are_open_and_symmetric():
    v = np.asarray(centred_uniform(jax.random.key(1), (400_000,)))
    assert np.abs(v).max() < 1 and abs(v.mean()) < 5 / np.sqrt(3 * v.size)
    assert stats.kstest(0.5 + 0.5 * v, "uniform").pvalue > 1e-4
    assert stats.kstest(np.asarray(sample_normal(jax.random.key(2), (100_000,))), "norm").pvalue > 1e-4
    extremes = jnp.array([-(1 - 2.0**-23), 1 - 2.0**-24], jnp.float32)
    assert np.all(np.isfinite(np.asarray(poisson_quantile(extremes, jnp.float32(50.0)))))


def test_noise_level_function_and_electrons_are_inverse():
    shot, read = np.array([1e-4, 3e-3]), np.array([1e-6, 2e-4])
    gain, noise = electrons_from_nlf(shot, read, 959.0)
    np.testing.assert_allclose(gain, shot * 959, rtol=1e-6)
    back = nlf_from_electrons(gain, noise, 959.0)
    np.testing.assert_allclose(back[0], shot, rtol=1e-6)
    np.testing.assert_allclose(back[1], read, rtol=1e-5)


def test_normalised_noise_has_the_stated_variance():
    clean = jnp.full((4, 50_000), jnp.array([[0.0], [0.01], [0.2], [0.9]]))
    gain, read_noise = electrons_from_nlf(jnp.float32(2e-3), jnp.float32(1e-4))
    shot, read = jax.random.split(jax.random.key(3))
    electrons = sample_poisson(shot, clean / gain) + read_noise * sample_normal(read, clean.shape)
    noise = np.asarray(gain * electrons - clean)
    sigma = np.asarray(nlf_sigma(clean[:, 0], jnp.float32(2e-3), jnp.float32(1e-4)))
    np.testing.assert_allclose(noise.std(axis=1), sigma, rtol=0.03)
    assert np.all(np.abs(noise.mean(axis=1)) < 5 * sigma / np.sqrt(50_000))


@pytest.mark.parametrize("shape", [-0.2, -0.05, 0.0, 0.02, 0.1, 0.2])
def test_tukey_lambda_is_scipys(shape):
    law = stats.tukeylambda(shape)
    p = np.linspace(0.001, 0.999, 201)
    ours = np.asarray(tukey_lambda.quantile(jnp.asarray(2 * p - 1, jnp.float32), shape))
    np.testing.assert_allclose(ours, law.ppf(p), rtol=2e-4, atol=2e-5)
    variance, excess = (float(v) for v in law.stats(moments="vk"))
    assert float(tukey_lambda.variance(shape)) == pytest.approx(variance, rel=1e-4)
    assert float(tukey_lambda.excess_kurtosis(shape)) == pytest.approx(excess, rel=0.01, abs=3e-3)


def test_tukey_lambda_limits():
    assert np.isinf(float(tukey_lambda.excess_kurtosis(-0.3)))
    assert np.isinf(float(tukey_lambda.variance(-0.6)))
    assert np.isfinite(float(jax.grad(lambda s: tukey_lambda.standard_quantile(0.9, s))(0.03)))
