"""Hot pixels beside dark currents that differ from pixel to pixel by a skewed law."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, stats

from cannoise_jax.signatures.core_law import GAMMA, LOGNORMAL, NORMAL, Core, skewed
from cannoise_jax.signatures.hot_law import likely_laws, share_error
from cannoise_jax.signatures.rare import hot_log_p, spread_of

CORES = [Core(law=NORMAL), Core(law=GAMMA, skew=0.8), Core(law=LOGNORMAL, skew=1.2)]


def drawn(law, variation, hot, seed, pixels=30_000, noise=5.0):
    """Levels in standard deviations of the noise: currents of mean 100, hot ones higher by 500 on average."""
    rng = np.random.default_rng(seed)
    logs = np.sqrt(np.log1p(variation**2))
    current = {
        "normal": lambda: 100 * (1 + variation * rng.standard_normal(pixels)),
        "gamma": lambda: rng.gamma(1 / variation**2, 100 * variation**2, pixels),
        "log-normal": lambda: 100 * np.exp(logs * rng.standard_normal(pixels) - logs**2 / 2),
    }[law]()
    current += (rng.random(pixels) < hot) * rng.exponential(500.0, pixels)
    return (current - np.mean(current) + noise * rng.standard_normal(pixels)) / noise


@pytest.mark.parametrize("core", CORES, ids=lambda c: c.law)
@pytest.mark.parametrize("mean", [2.0, 20.0])
def test_the_sum_of_a_level_and_a_height_has_the_density_of_both(core, mean):
    for u in (-1.0, 0.5, 4.0, 12.0):

        def both(x, power, u=u):
            return x**power * np.exp(core.log_density(np.array(u - x)) - x / mean) / mean

        grid = np.linspace(0, 80, 80_001)
        density, first = (integrate.trapezoid(both(grid, k), grid) for k in (0, 1))
        ratio = float(core.log_ratio(np.array(u), mean))
        assert ratio == pytest.approx(np.log(density) - float(core.log_density(np.array(u))), abs=0.03)
        assert float(core.height(np.array(u), mean)) == pytest.approx(first / density, rel=0.03, abs=0.03)


@pytest.mark.parametrize("core", CORES, ids=lambda c: c.law)
def test_standard_levels_have_mean_0_and_deviation_1(core):
    grid = np.linspace(-8, 30, 40_001)
    density = np.exp(core.log_density(grid)) * (core.log_density(grid) > -11)
    moments = [integrate.trapezoid(grid**k * density, grid) for k in range(4)]
    assert moments == pytest.approx([1, 0, 1, core.skew], abs=0.03)
    assert float(integrate.trapezoid(density * (grid > core.far(0.01)), grid)) == pytest.approx(0.01, rel=0.1)


@pytest.mark.parametrize("law", ["normal", "gamma", "log-normal"])
@pytest.mark.parametrize("variation", [pytest.param(0.25, marks=pytest.mark.slow), 0.4])
@pytest.mark.parametrize("hot", [0.0, 0.005, pytest.param(0.02, marks=pytest.mark.slow)])
def test_the_tail_of_a_skewed_dark_current_is_no_hot_pixels(law, variation, hot):
    """Of normal levels as before; of skewed ones the normal law has 0.02 to 0.06 of the pixels hot where
    none is, and 0.006 to 0.026 for 0.005."""
    u = drawn(law, variation, hot, 3)
    _, core, _, share, _, gain = likely_laws(u, spread_of(u), True)[0]
    assert (core.law == NORMAL) == (law == "normal")
    if hot:
        assert share == pytest.approx(hot, rel=0.35) and gain > 300
    else:
        assert gain < 40 and share * 30_000 * (gain > 10) < 0.03 * 30_000


def test_levels_that_are_normal_are_skewed_by_chance_alone():
    none = [skewed(np.random.default_rng(k).standard_normal(5_000)) for k in range(200)]
    assert sum(map(bool, none)) <= 1
    assert skewed(stats.pearson3.rvs(0.6, size=5_000, random_state=1))


def test_beside_many_hot_pixels_no_law_is_told_from_the_lower_half():
    u = drawn("normal", 0.3, 0.3, 4)
    assert likely_laws(u, spread_of(u), True)[0].core.law == NORMAL


@pytest.mark.parametrize("hot", [0.0, 0.002])
def test_a_skewness_that_the_lower_half_tells_too_little_of_makes_no_hot_pixels(hot):
    """As where hits were taken out of some pixels, which have more noise about the same law; of normal levels
    hot ones stay."""
    rng = np.random.default_rng(5)
    u = rng.gamma(16, 1.0, 20_000) if not hot else 4 * rng.standard_normal(20_000)
    u = u - u.mean() + rng.standard_normal(u.size) * np.where(rng.random(u.size) < 0.07, 2.5, 1.0)
    u += (rng.random(u.size) < hot) * rng.exponential(20.0, u.size)
    _, core, _, share, _, gain = likely_laws(u, spread_of(u), True)[0]
    assert (core.law == NORMAL) == bool(hot)
    assert (gain > 100 and share == pytest.approx(hot, rel=0.5)) if hot else gain < 10


@pytest.mark.parametrize(
    ("law", "variation", "offsets"),
    [
        pytest.param("gamma", 0.7, 0.3, marks=pytest.mark.slow),
        pytest.param("log-normal", 0.5, 0.3, marks=pytest.mark.slow),
        ("log-normal", 0.6, 0.8),
    ],
)
def test_offsets_beside_long_tailed_currents_make_no_pixel_hot(law, variation, offsets):
    """Offsets make the lower half of the levels more normal than currents are: by that half alone tens to
    hundreds of pixels of the tail were hot, and hundreds of nats spoke for them."""
    noise = 100 * variation * offsets
    told = likely_laws(u := drawn(law, variation, 0.0, 3, noise=noise), spread_of(u), True)
    assert hot_log_p(min(f.mixture for f in told), u.size) > -20
    shares = []
    for seed in range(2):
        u, rng = drawn(law, variation, 0.0, seed, noise=noise), np.random.default_rng([1, seed])
        hot = rng.random(u.size) < 0.0015
        u += hot * rng.exponential(6000.0 * variation, u.size) / noise
        told = likely_laws(u, spread_of(u), True)
        shares.append((told[0].share - hot.mean()) / share_error(told, u.size))
    assert np.max(np.abs(shares)) < 3


@pytest.mark.parametrize("hot", [0.0, 0.12])
def test_levels_of_few_values_have_a_law(hot):
    """Where noise is below a code half of the levels may be one of them: their lower half has no spread."""
    rng = np.random.default_rng(6)
    u = np.rint(0.4 * rng.standard_normal(20_000)) + 30.0 * (rng.random(20_000) < hot)
    assert likely_laws(u, 1.0, True)
