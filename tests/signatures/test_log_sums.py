import numpy as np
from scipy import special

from cannoise_jax.signatures.log_sums import log_add, log_sum

LOGS = 300 * np.random.default_rng(0).normal(size=(9, 50))
LOGS[2, :10] = -np.inf


def test_sums_are_those_of_scipy():
    weights = np.random.default_rng(1).random(9)
    weights[3] = 0
    np.testing.assert_allclose(log_sum(LOGS), special.logsumexp(LOGS, axis=0), rtol=1e-13)
    weighted = special.logsumexp(LOGS, axis=0, b=weights[:, None])
    np.testing.assert_allclose(log_sum(LOGS, weights), weighted, rtol=1e-13)


def test_what_does_not_count_may_be_the_largest():
    logs = np.array([[1800.0, 5.0], [30.0, 5.0]])
    np.testing.assert_allclose(log_sum(logs, np.array([0.0, 1.0])), [30.0, 5.0])


def test_of_nothing_the_log_is_minus_infinity():
    assert log_sum(np.full((3, 2), -np.inf)).tolist() == [-np.inf, -np.inf]


def test_two_are_added_as_by_numpy():
    np.testing.assert_allclose(log_add(LOGS[2], LOGS[4]), np.logaddexp(LOGS[2], LOGS[4]), rtol=1e-13)
