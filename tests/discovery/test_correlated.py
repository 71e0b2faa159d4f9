"""Moments and counts of noise that is alike from pixel to pixel scatter as is said of them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from cannoise_jax.discovery.compare.correlated import correlated, of_counts, of_moments, unskewed
from cannoise_jax.signatures import bank

SIZE, FIELDS = (48, 65), 600


def rows(rng):
    """Normal noise of which whole rows share a half, of mean 0 and mean square 1."""
    z = (rng.standard_normal(SIZE) + rng.standard_normal((SIZE[0], 1))) / np.sqrt(2)
    return z - z.mean()


def white(rng):
    z = rng.standard_normal(SIZE)
    return z - z.mean()


def seen(draw, seed):
    rng = np.random.default_rng(seed)
    fields = [draw(rng).astype(np.float32) for _ in range(FIELDS)]
    noise = correlated(np.mean([bank.power(z) for z in fields], 0), SIZE[1], FIELDS)
    return fields, noise


@pytest.mark.parametrize("draw", [rows, white])
def test_moments_scatter_as_the_correlations_say(draw):
    fields, noise = seen(draw, 1)
    own = [z / np.sqrt(np.mean(z * z)) for z in fields]
    found = np.var([bank.hermite(z, np.ones(SIZE, np.float32)) for z in own], 0)
    expected = of_moments(noise).reshape(found.shape) * np.array([[2.0], [6.0], [24.0]]) / np.prod(SIZE)
    ratio = found / expected
    assert np.all(np.abs(np.log(ratio[1:])) < 0.5)  # of 600 draws each, some of few rows
    assert np.all(np.abs(np.log(ratio[0, 1:])) < 0.4)  # the mean square itself is taken out
    if draw is white:
        assert of_moments(noise).max() < 1.2
    else:
        assert of_moments(noise).max() > 3


@pytest.mark.parametrize("draw", [rows, white])
def test_counts_scatter_as_the_correlations_say(draw):
    fields, noise = seen(draw, 2)
    chances = (0.01, 0.001)
    limits = [stats.norm.isf(p) for p in chances]
    counts = np.array([[(z > t).sum() for t in limits] for z in fields])
    assert np.allclose(counts.var(0) / counts.mean(0), of_counts(noise, chances), rtol=0.3)
    several = [np.sum(np.square(fields[n : n + 6]), 0) for n in range(0, FIELDS, 6)]
    limits = [stats.chi2.isf(p, 6) for p in chances]
    counts = np.array([[(s > t).sum() for t in limits] for s in several])
    assert np.allclose(counts.var(0) / counts.mean(0), of_counts(noise, chances, squares=True), rtol=0.6)


def test_a_mean_of_few_independent_values_is_told_by_its_own_law():
    """Of sums of 20 squares of normal values, in standard deviations, as many lie beyond each limit as of a
    normal law; where nothing is alike nothing moves."""
    rng = np.random.default_rng(3)
    z = (rng.chisquare(20, 200_000) - 20) / np.sqrt(40)
    wider = np.full(z.size, 5.0)
    pixels = 20 * wider[0]  # so that 20 are independent
    moved = unskewed(z, np.broadcast_to(wider, z.shape), pixels, np.full(z.size, 8 / 2**1.5))
    for limit in (2.0, 3.0, 4.0):
        assert np.mean(moved > limit) == pytest.approx(stats.norm.sf(limit), rel=0.5, abs=3e-5)
    assert np.array_equal(unskewed(z, np.ones(z.size), 1000.0, np.ones(z.size)), z)
