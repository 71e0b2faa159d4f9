"""Intervals of what few draws scatter by hold the truth as often as they say."""

import numpy as np
import pytest

from cannoise_jax.signatures.line_sums import component_score

REPLICATES = 2000


@pytest.mark.parametrize(
    "draws, signal",
    [
        (2, 30.0),
        pytest.param(5, 30.0, marks=pytest.mark.slow),
        (5, 1.5),
        pytest.param(24, 30.0, marks=pytest.mark.slow),
        (400, 0.4),
    ],
)
def test_nine_in_ten_intervals_of_a_scatter_hold_it(draws, signal):
    """signal: variance of the offsets in units of the noise of one."""
    rng = np.random.default_rng(draws)
    information, truth = 7.0, np.sqrt(signal / 7.0)
    held = 0
    for _ in range(REPLICATES):
        power = np.sum((1 + signal) * rng.standard_normal(draws) ** 2)
        score = component_score(
            np.array([power]),
            np.array([information]),
            np.array([draws]),
            scaling="additive",
            where={"axis": "frame"},
        )
        low, high = score.interval90
        held += low <= truth <= high
    assert 0.87 < held / REPLICATES < 0.96


def test_draws_that_tell_nothing_do_not_count():
    power, information = np.array([40.0, 5.0]), np.array([10.0, 1e-6])
    score = component_score(power, information, np.array([5, 5]), scaling="additive", where={"axis": "frame"})
    assert score.drawn == pytest.approx(5, rel=1e-3)


def test_an_interval_is_never_below_the_scatter_of_its_draws():
    """An error that counts the noise alone leaves the strength within what so many draws scatter."""
    score = component_score(
        np.array([4000.0]), np.array([1.0]), np.array([1000]), scaling="additive", where={"axis": "frame"}
    ).replace(drawn=1000.0, error=1e-3)
    low, high = score.interval90
    assert low < score.amplitude < high
    assert high / low == pytest.approx(np.exp(2 * 1.645 / np.sqrt(2 * 1000)), rel=0.01)
