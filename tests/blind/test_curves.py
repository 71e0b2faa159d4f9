import numpy as np
import pytest
from scipy import stats

from cannoise_jax.blind.curves import chance, half_power, limit, uniformity


def test_uniform_p_values_pass_and_small_ones_do_not():
    rng = np.random.default_rng(0)
    rates = [uniformity(list(rng.random(200)))["ks_p"] < 0.05 for _ in range(200)]
    assert 0.01 < np.mean(rates) < 0.11
    small = uniformity(list(rng.random(200) ** 2))
    assert small["too_small_p"] < 1e-4
    large = uniformity(list(rng.random(200) ** 0.5))
    assert large["ks_p"] < 1e-4 and large["too_small_p"] > 0.2


def test_p_values_on_a_coarse_grid_are_not_held_against_it():
    rng = np.random.default_rng(1)
    coarse = np.ceil(rng.random(400) * 10) / 10
    assert stats.kstest(coarse, "uniform").pvalue < 1e-3
    assert uniformity(list(coarse))["ks_p"] > 0.05
    assert uniformity([0.5] * 3)["ks_p"] is None


def test_intervals_of_the_half_power_point_cover_it():
    rng = np.random.default_rng(2)
    covered = []
    for _ in range(30):
        multiples = np.exp(rng.uniform(np.log(0.3), np.log(10), 80))
        seen = rng.random(80) < chance(multiples, 1.3, 4.0)
        low, high = half_power(list(multiples), list(seen))["ci95"]
        covered.append(low <= 1.3 <= high)
    # Of 95 % intervals 24 or fewer of 30 hold it once in 300 times.
    assert sum(covered) >= 25
    assert half_power([1.0] * 9, [True] * 9)["half_at"] is None


def test_the_limit_is_the_power_of_the_likelihood_ratio():
    rng = np.random.default_rng(3)
    drawn = rng.standard_normal(20000) + 5 * 0.4
    assert limit(np.array([0.4]))[0] == pytest.approx(np.mean(drawn > stats.norm.isf(0.01)), abs=0.012)
