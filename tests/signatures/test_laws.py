"""The laws: standard normal when both sides are alike, signed, and honest about a restless simulator."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.signatures import laws


def test_energies_of_equal_laws_are_standard_normal_and_signed():
    rng = np.random.default_rng(1)
    count = np.repeat([2.0, 30.0, 1000.0], 1500)
    real, drawn = (
        rng.chisquare(count, (5, count.size)) / count,
        rng.chisquare(count, (3, 5, count.size)) / count,
    )
    z = laws.compare_energies(real, drawn, count).z
    assert abs(z.mean()) < 0.05 and 0.85 < z.std() < 1.05
    assert laws.compare_energies(1.3 * real, drawn, count).z[3000:].min() > 3
    assert laws.compare_energies(real / 1.3, drawn, count).z[3000:].max() < -3


def test_energies_of_a_simulator_whose_units_scatter_more():
    """Coefficients that share a factor from unit to unit: the F law of independent ones would alarm."""
    rng = np.random.default_rng(2)
    count = np.full(800, 200.0)

    def units(*shape):
        return rng.chisquare(count, (*shape, 800)) / count * rng.gamma(20, 1 / 20, (*shape, 800))

    z = laws.compare_energies(units(6), units(4, 6), count).z
    assert np.abs(z).max() < 4.5 and z.std() < 1.1


@pytest.mark.parametrize("units", [1, 7])
def test_means_are_standard_normal_where_the_closed_form_is_off(units):
    rng = np.random.default_rng(3)
    real, drawn = (1.5 * rng.standard_normal((*n, 4000)) for n in ((units,), (4, units)))
    z = laws.compare_means(real, drawn, np.ones(4000)).z
    assert abs(z.mean()) < 0.06 and 0.85 < z.std() < 1.1


def test_means_of_parts_that_scatter_each_in_their_own_way_are_standard_normal():
    """Few units: what the family shows is most of what is known."""
    rng = np.random.default_rng(5)
    own = np.repeat([4.0, 1.0, 0.6], 1000)
    real, drawn = (own * rng.standard_normal((*n, 3000)) for n in ((1,), (2, 1)))
    z = laws.compare_means(real, drawn, np.ones(3000), parts=3).z.reshape(3, -1)
    assert np.all(np.abs(z.mean(1)) < 0.12) and np.all((z.std(1) > 0.8) & (z.std(1) < 1.15))
    assert laws.compare_means(real, drawn, np.ones(3000)).z[:1000].std() > 2


def test_counts_are_careful_where_there_are_few_and_sure_where_there_are_many():
    real = np.array([[0.0, 3.0, 40.0, 400.0]])
    drawn = np.array([[[0.0, 1.0, 2.0, 900.0]]] * 3)
    z = laws.compare_counts(real, drawn, 0.25).z
    assert z[0] == 0 and 0 < z[1] < 3 and z[2] > 8 and z[3] < -8


def test_far_tails_stay_finite_and_in_order():
    real = np.array([[2.0, 20.0, 200.0, 0.1, 0.01]])
    drawn = np.ones((2, 1, 5))
    z = laws.compare_energies(real, drawn, np.full(5, 1e5)).z
    assert np.isfinite(z).all() and z[0] < z[1] < z[2] and z[4] < z[3] < 0


def test_the_threshold_grows_with_what_was_looked_at():
    assert laws.threshold(0.01, 1, 1) == pytest.approx(2.576, abs=1e-3)
    assert laws.threshold(0.01, 20, 1000) > laws.threshold(0.01, 20, 10) > laws.threshold(0.01, 1, 10)
