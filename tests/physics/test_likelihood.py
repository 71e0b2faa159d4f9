"""The discretised likelihood: against float64 references, entropies, and brute force."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats

from cannoise_jax.physics.likelihood.codes import (
    CodeGrid,
    gaussian_log_prob,
    log_normal_cdf,
    log_normal_interval,
)
from cannoise_jax.physics.likelihood.crossed import SharedTerms, crossed_gaussian, stationary_factor


def _log_mass(centre, half):
    """float64: the density at the nearer edge times a ratio of Mills ratios, or a series for narrow bins."""
    a = np.abs(centre)
    nodes, weights = np.polynomial.legendre.leggauss(40)
    narrow = special.logsumexp(
        -((a[:, None] + half[:, None] * nodes) ** 2) / 2,
        b=weights * half[:, None] / np.sqrt(2 * np.pi),
        axis=1,
    )
    low, high = special.log_ndtr(half - a), special.log_ndtr(-a - half)
    return np.where(half * (1 + a) < 5, narrow, low + np.log1p(-np.exp(high - low)))


def test_interval_and_its_gradient_match_float64_over_twelve_decades():
    rng = np.random.default_rng(0)
    centre = np.float32(10 ** rng.uniform(-4, 2, 600) * rng.choice([-1, 1], 600))
    half = np.float32(10 ** rng.uniform(-5, 2, 600))
    exact = _log_mass(centre.astype(float), half.astype(float))
    value = np.asarray(log_normal_interval(centre, half), float)
    assert np.max(np.abs(value - exact) / np.maximum(1, np.abs(exact))) < 2e-6
    by_centre = np.asarray(jax.grad(lambda c: log_normal_interval(c, half).sum())(centre), float)
    # d log P / dc is the mean of -x under the normal truncated to the bin; here by its two edge densities.
    c, h = np.abs(centre.astype(float)), half.astype(float)
    edge = np.exp(-((c - h) ** 2) / 2 - 0.5 * np.log(2 * np.pi) - exact)
    expected = np.sign(centre) * edge * np.expm1(-2 * c * h)
    clear = np.abs(exact) < 700
    np.testing.assert_allclose(by_centre[clear], expected[clear], rtol=2e-4, atol=2e-5)


@pytest.mark.parametrize("centre,half", [(1e5, 1e5), (1e6, 1e-6), (0.0, 1e6), (-3e5, 2.0), (5.0, 1e-6)])
def test_gradients_stay_finite_in_far_tails_and_far_below_a_step(centre, half):
    first = jax.grad(log_normal_interval, (0, 1))(centre, half)
    second = jax.hessian(log_normal_interval)(centre, half)
    assert np.isfinite([*map(float, first), float(second), float(log_normal_interval(centre, half))]).all()
    assert np.isfinite(float(jax.grad(log_normal_cdf)(-abs(centre))))


def test_probabilities_over_all_codes_sum_to_one_between_the_rails():
    for step in (1.0, 4.0, 16.0):
        grid = CodeGrid(step, 0.0, 64 * step)
        codes = step * np.arange(65.0)
        log_prob = gaussian_log_prob(codes, 3 * step, (2.5 * step) ** 2, grid)
        assert abs(float(jnp.exp(log_prob).sum()) - 1) < 1e-5


@pytest.mark.parametrize(("step", "top"), [(4.0, 65532.0), (16.0, 65520.0), (1.0, 65535.0)])
@pytest.mark.parametrize("black", [0.0, 200.3])
def test_the_highest_code_is_censored_though_the_white_level_is_no_code(step, top, black):
    grid = CodeGrid(step, -black, 65535.0 - black)
    mean, sigma = 65700.0 - black, 40.0
    exact = stats.norm.logsf((top - step / 2 - 65700) / sigma)
    code = np.float32(top - black)
    value = float(gaussian_log_prob(code, mean, sigma**2, grid))
    assert value == pytest.approx(exact, rel=0.02) and -2e-5 < exact < -1e-6
    below = float(gaussian_log_prob(code - np.float32(step), mean, sigma**2, grid))
    edges = (np.array([top - 1.5 * step, top - 0.5 * step]) - 65700) / sigma
    assert below == pytest.approx(np.log(np.diff(stats.norm.cdf(edges))[0]), abs=0.01)


def test_mean_log_likelihood_of_rounded_data_is_minus_their_entropy():
    # 0.69 DN read noise, rounded to whole DN: 1.13 nats; a density in place of the mass would claim 1.048.
    codes = np.arange(-20.0, 21.0)
    phases = np.linspace(0, 1, 40, endpoint=False)[:, None]
    own = np.asarray(gaussian_log_prob(codes, phases, 0.69**2), float)
    entropies = -(np.exp(own) * own).sum(1)
    edges = (np.arange(-20, 22) - 0.5) / 0.69
    mass = np.diff(stats.norm.cdf(edges - phases / 0.69))
    exact = special.entr(mass).sum(1).mean()
    assert abs(entropies.mean() - exact) < 2e-5 and abs(exact - 1.131) < 4e-3
    rng = np.random.default_rng(1)
    mean = rng.uniform(0, 1, 400_000).astype(np.float32)
    drawn = np.round(mean + 0.69 * rng.normal(size=mean.size)).astype(np.float32)
    log_prob = np.asarray(gaussian_log_prob(drawn, mean, 0.69**2), float)
    assert abs(log_prob.mean() + entropies.mean()) < 4 * log_prob.std() / np.sqrt(mean.size)


def test_a_step_of_one_on_codes_of_step_sixteen_is_wrong_by_log_sixteen():
    rng = np.random.default_rng(2)
    drawn = 16 * np.round(rng.normal(10, 3, 20_000)).astype(np.float32)
    right = gaussian_log_prob(drawn, 160.0, 48.0**2, CodeGrid(16.0))
    wrong = gaussian_log_prob(drawn, 160.0, 48.0**2, CodeGrid(1.0))
    assert abs(float((right - wrong).mean()) - np.log(16)) < 5e-3


def _rows_by_brute_force(codes, noise: float, sigma: float) -> np.ndarray:
    """Log-probability of rows of whole codes with an offset each, wherever it lies; float64."""
    unit = np.linspace(-9, np.abs(codes).max() / sigma + 9, 20001)

    def inside(row):
        a = np.abs((row[:, None] - sigma * unit) / noise)
        low, high = (stats.norm.logsf(a + s * 0.5 / noise) for s in (-1, 1))
        return (low + np.log1p(-np.exp(high - low))).sum(0) + stats.norm.logpdf(unit)

    return np.array([special.logsumexp(inside(row)) for row in codes]) + np.log(unit[1] - unit[0])


def test_crossed_terms_match_a_dense_covariance():
    rng = np.random.default_rng(4)
    h, w = 6, 5
    pink = stationary_factor(jnp.asarray(0.5 * 0.6 ** np.arange(h), jnp.float32))
    terms = SharedTerms(pink, 0.4 * jnp.eye(w), 0.3)
    variance = rng.uniform(1, 2, (h, w)).astype(np.float32)
    ones_h, ones_w = np.ones((h, h)), np.ones((w, w))
    covariance = np.kron(np.asarray(pink) @ np.asarray(pink).T, ones_w) + np.kron(ones_h, 0.16 * np.eye(w))
    covariance += 0.09 + np.diag((variance + 1 / 12).ravel())
    drawn = 1.5 * rng.normal(size=(3, h, w))
    dense = stats.multivariate_normal(np.zeros(h * w), covariance).logpdf(drawn.reshape(3, -1))
    low_rank = crossed_gaussian(drawn, 0.0, variance, terms, correct=False)
    np.testing.assert_allclose(low_rank, dense, atol=2e-4)


@pytest.mark.parametrize(("noise", "error"), [(1.0, 3e-4), (0.5, 3e-3)])
def test_rows_of_codes_are_scored_as_the_sum_over_their_offsets_says(noise, error):
    rng, sigma = np.random.default_rng(9), 0.5
    codes = np.round(sigma * rng.normal(size=(6, 1)) + noise * rng.normal(size=(6, 48)))
    terms = SharedTerms(sigma * jnp.eye(6), jnp.zeros((48, 48)))
    known = _rows_by_brute_force(codes, noise, sigma).sum()
    (found,) = crossed_gaussian(codes[None].astype(np.float32), 0.0, noise**2, terms)
    assert abs(float(found) - known) < error * codes.size
