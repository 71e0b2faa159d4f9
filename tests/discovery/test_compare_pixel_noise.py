"""Pixels unlike in noise: how unlike is told beside the chance of few frames, and drawn as unlike."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.compare.pixel_noise import Spread, compared, uneven, variances
from cannoise_jax.discovery.compare.view import bulk_variance
from cannoise_jax.signatures.fields import helmert

SIZE = (160, 192)
ALL = np.ones(SIZE, bool)


def contrasts(rng, spread, count, law="gamma"):
    """Of pixels whose variances scatter by this much, of an inverse gamma or a log-normal law, and these."""
    if law == "gamma":
        shape = 2 + 1 / spread
        true = (shape - 1) / rng.gamma(shape, 1.0, SIZE)
    else:
        wide = np.sqrt(np.log1p(spread))
        true = np.exp(wide * rng.standard_normal(SIZE) - wide**2 / 2)
    return np.sqrt(true) * rng.standard_normal((count, *SIZE)), true


@pytest.mark.parametrize("law", ["gamma", "log-normal"])
@pytest.mark.parametrize(("spread", "count"), [(0.05, 8), (0.1, 8), (0.1, 30)])
def test_pixels_are_as_unlike_as_they_were_made(law, spread, count):
    rng = np.random.default_rng(count)
    values, true = contrasts(rng, spread, count, law)
    alike = rng.standard_normal((count, *SIZE))
    found = compared(uneven(values, ALL, 1.0), uneven(alike, ALL, 1.0))
    assert found.value == pytest.approx(spread, rel=0.35) and not found.drawn
    drawn = variances(np.mean(values**2, 0), count, found, 1)
    bulk = ~drawn.odd
    assert np.mean(drawn.values[bulk]) == pytest.approx(np.mean(true[bulk]), rel=0.02)
    assert np.std(drawn.values[bulk]) == pytest.approx(np.std(true[bulk]), rel=0.2)
    assert drawn.lowest == pytest.approx(np.quantile(true[bulk], 0.02), abs=0.08)
    known = np.corrcoef(drawn.values[bulk], true[bulk])[0, 1]
    assert known == pytest.approx(spread / (spread + 2 / count), abs=0.12)


def test_pixels_that_are_alike_are_left_alike():
    rng = np.random.default_rng(3)
    one, two = rng.standard_normal((2, 8, *SIZE))
    found = compared(uneven(one, ALL, 1.0), uneven(two, ALL, 1.0))
    drawn = variances(np.mean(one**2, 0), 8, found, 1)
    assert found == Spread(0.0, 0.0) and drawn.lowest == 1 and (drawn.values[~drawn.odd] == 1).all()
    assert drawn.odd.mean() == pytest.approx(1e-3, abs=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_the_noisiest_of_pixels_that_are_alike_are_not_drawn_noisier(seed):
    ratio = np.random.default_rng(seed).chisquare(9, SIZE) / 9
    assert variances(ratio, 9, Spread(0.0, 0.0), 1).odd.sum() <= 2  # of thirty that stand out
    ratio[::16, ::16] *= 9  # one in 256 is
    found = variances(ratio, 9, Spread(0.0, 0.0), 1).odd
    assert found[::16, ::16].mean() > 0.8 and found.sum() < 1.2 * found[::16, ::16].size


def test_tails_of_noise_are_no_matter_of_pixels():
    """Contrasts of the same frames share a frame far out: their squares go together."""
    rng = np.random.default_rng(4)
    frames = rng.standard_t(6, (9, *SIZE)) / np.sqrt(1.5)
    matrix = helmert(9)
    values = np.einsum("nt,tij->nij", matrix, frames)
    halves = [np.mean(part**2, 0) for part in np.array_split(values, 2)]
    assert np.cov(halves[0].ravel(), halves[1].ravel())[0, 1] > 0.05
    found = uneven(values, ALL, 1.0)
    assert abs(found.value) < 4 * found.error


def test_a_simulator_that_draws_pixels_unlike_is_given_no_more_of_it():
    rng = np.random.default_rng(6)
    recorded, simulated = (contrasts(rng, 0.1, 8)[0] for _ in range(2))
    found = compared(uneven(recorded, ALL, 1.0), uneven(simulated, ALL, 1.0))
    assert found.value == found.drawn > 0.05
    drawn = variances(np.mean(recorded**2, 0), 8, found, 1)
    assert (drawn.values[~drawn.odd] == 1).all() and drawn.lowest == 1
    # Those that stand out do so of pixels that are unlike.
    assert drawn.odd.mean() == pytest.approx(1e-3, abs=1e-3)


def test_what_pixels_are_more_unlike_than_simulated_is_drawn_besides():
    """Together with the simulator's own law, of other pixels, they are as unlike as recorded."""
    rng = np.random.default_rng(8)
    own = contrasts(rng, 0.1, 8)[1]
    simulated = np.sqrt(contrasts(rng, 0.1, 8)[1]) * rng.standard_normal((8, *SIZE))
    true = own * contrasts(rng, 0.15, 8)[1]
    recorded = np.sqrt(true) * rng.standard_normal((8, *SIZE))
    found = compared(uneven(recorded, ALL, 1.0), uneven(simulated, ALL, 1.0))
    drawn = variances(np.mean(recorded**2, 0), 8, found, 1)
    bulk = ~drawn.odd
    together = drawn.values * contrasts(rng, 0.1, 8)[1]
    assert np.std(together[bulk]) == pytest.approx(np.std(true[bulk]), rel=0.2)


@pytest.mark.parametrize("hit", [0.0, 0.005, 0.02])
def test_the_variance_of_most_pixels_is_not_that_of_a_few(hit):
    """A particle leaves ten thousand times the variance of the noise in the pixels that it meets."""
    rng = np.random.default_rng(3)
    frames = 4.0 * rng.standard_normal((7, 40_000))
    frames[0] += np.where(rng.random(40_000) < hit, rng.exponential(3000.0, 40_000), 0.0)
    assert bulk_variance(frames.var(0, ddof=1), 6) == pytest.approx(16.0, rel=0.04)


def test_noise_that_leaves_most_pixels_still_keeps_its_variance():
    rng = np.random.default_rng(4)
    frames = np.round(0.185 * rng.standard_normal((6, 200_000)))
    v = frames.var(0, ddof=1)
    assert np.mean(v > 0) < 0.05 and bulk_variance(v, 5) == pytest.approx(v.mean(), rel=0.1)
