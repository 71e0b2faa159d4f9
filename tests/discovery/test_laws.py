"""The laws that p-values rest on, against simulation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from cannoise_jax.signatures.group_sums import Pixels, by_own_noise
from cannoise_jax.signatures.known_shape import rounding_kurtosis
from cannoise_jax.signatures.phasors import orthonormal
from cannoise_jax.signatures.rare import sparse_log_p
from cannoise_jax.signatures.score import normal_log_p, skewed_log_p


@pytest.mark.parametrize(
    "width", [0.45, pytest.param(0.6, marks=pytest.mark.slow), pytest.param(0.8, marks=pytest.mark.slow), 2.0]
)
@pytest.mark.parametrize(
    "place", [pytest.param(0.0, marks=pytest.mark.slow), 0.3, pytest.param(0.5, marks=pytest.mark.slow)]
)
def test_kurtosis_of_rounded_noise_is_known(width, place):
    rng = np.random.default_rng(0)
    codes = np.rint(rng.normal(100 + place, width, 2_000_000))
    sigma = codes.std()
    measured = np.mean(((codes - codes.mean()) / sigma) ** 4) - 3
    expected = float(rounding_kurtosis(np.array(codes.mean() * 4), np.array(sigma * 4), 4.0)[0])
    assert measured == pytest.approx(expected, abs=0.012)


@pytest.mark.parametrize("width", [0.55, 0.8, 2.0])
@pytest.mark.parametrize("place", [0.0, 0.3, 0.5])
def test_what_rounding_leaves_of_heavy_tails_agrees_with_students_t(width, place):
    """Probabilities of the codes from Student's t of 6 / 0.05 + 4 freedoms: excess kurtosis 0.05."""
    excess = 0.05
    freedom = 4 + 6 / excess
    codes = np.arange(-40, 41)
    edges = (np.append(codes, 41) - 0.5 - place) / width

    def moments(cdf):
        p = np.diff(cdf(edges))
        mean = np.sum(p * codes)
        second, fourth = (np.sum(p * (codes - mean) ** k) for k in (2, 4))
        return mean, np.sqrt(second), fourth / second**2 - 3

    mean, sigma, plain = moments(stats.norm.cdf)
    tailed = moments(stats.t(freedom, scale=np.sqrt((freedom - 2) / freedom)).cdf)[2]
    left = float(rounding_kurtosis(np.array(mean), np.array(sigma), 1.0)[1])
    assert (tailed - plain) / excess == pytest.approx(left, abs=0.02)


def test_sheppards_kurtosis_is_the_mean_over_places():
    places = np.linspace(0, 1, 16, endpoint=False)
    sigma = np.sqrt(0.62**2 + 1 / 12)
    mean = rounding_kurtosis(places, np.full(16, sigma), 1.0)[0].mean()
    assert mean == pytest.approx(-1 / 120 / sigma**4, abs=3e-3)


@pytest.mark.parametrize("shape", [4.0, 40.0])
@pytest.mark.parametrize("sides", [1, 2])
def test_p_of_a_skewed_sum(shape, sides):
    x = stats.gamma.rvs(shape, size=200_000, random_state=np.random.default_rng(1))
    z = (x - shape) / np.sqrt(shape)
    p = np.exp([skewed_log_p(v, 2 / np.sqrt(shape), sides) for v in z[:4000]])
    for level in (0.5, 0.1, 0.02):
        assert np.mean(p < level) == pytest.approx(level, abs=4 * np.sqrt(level / 4000))


def test_no_skewness_is_the_normal_law():
    assert skewed_log_p(3.0, 0.0, 2) == pytest.approx(normal_log_p(3.0))


def test_sparse_p_is_never_too_small():
    rng = np.random.default_rng(2)
    means = np.exp(np.linspace(np.log(1.5), np.log(40), 6))

    def ratios(x):
        return [
            0.5 / m**2 - x / m - np.log(m) + stats.norm.logcdf(x - 1 / m) - stats.norm.logpdf(x)
            for m in means
        ]

    p = []
    for _ in range(300):
        x = rng.standard_normal(5000)
        p.append(np.exp(sparse_log_p(np.ones_like(x), ratios(x))))
    for level in (0.2, 0.05, 0.01):
        assert np.mean(np.array(p) <= level) <= level + 3 * np.sqrt(level / 300)
    x = rng.standard_normal(5000)
    x[:6] += rng.exponential(12, 6)
    assert sparse_log_p(np.ones_like(x), ratios(x)) < np.log(1e-6)


def test_orthonormal_rows_span_the_basis():
    rng = np.random.default_rng(3)
    basis = rng.standard_normal((6, 400))
    basis[5] = basis[0] + basis[1]  # a row that adds nothing
    q = orthonormal(basis)
    assert q.shape == (5, 400)
    np.testing.assert_allclose(q @ q.T, np.eye(5), atol=1e-5)
    np.testing.assert_allclose(basis @ q.T @ q, basis, atol=1e-4)


def pixels(values, response):
    """What the values [groups, count] show beside the offset of their group."""
    rest = values - values.mean(1, keepdims=True)
    information, fourth = (np.full(len(values), values.shape[1] * response**p) for p in (2, 4))
    within = response**2 * np.sum(rest**2, 1)[None]
    return Pixels(information, fourth, within, np.arange(information.size) % 2)


@pytest.mark.parametrize("count", [64, 256])
@pytest.mark.parametrize("offsets", [0.0, 0.5, 20.0])
def test_sums_by_their_own_noise_keep_their_mean_square(count, offsets):
    rng = np.random.default_rng(5)
    values = rng.standard_normal((20_000, count)) + offsets * rng.standard_normal((20_000, 1))
    scaled, more = by_own_noise(values.sum(1)[None], pixels(values, 1.0), np.full(20_000, float(count)))
    assert more == pytest.approx(1, abs=0.01)
    expected = count * (1 + count * offsets**2)
    assert np.mean(scaled**2) == pytest.approx(expected, rel=4 * np.sqrt(2 / 20_000))


@pytest.mark.parametrize("offset", [0.7, 10.0])
def test_an_offset_that_the_modelled_noise_holds_keeps_its_amplitude(offset):
    rng = np.random.default_rng(7)
    count = 200
    values = rng.standard_normal((5000, count)) + offset * rng.standard_normal((5000, 1))
    response = 1 / np.sqrt(1 + offset**2)  # the noise was taken for all that varies
    seen = pixels(response * values, response)
    information = seen.information
    scaled, more = by_own_noise(response**2 * values.sum(1)[None], seen, np.full(5000, float(count)))
    power = np.mean(scaled**2 / (information * more))
    assert np.sqrt((power - 1) / (information * more)[0]) == pytest.approx(offset, rel=0.05)


def test_uneven_noise_is_no_offset():
    rng = np.random.default_rng(6)
    spread = np.exp(0.8 * rng.standard_normal((4000, 1)))  # every line as noisy as it likes
    values = spread * rng.standard_t(3, (4000, 200))
    score = values.sum(1)
    scaled, more = by_own_noise(score[None], pixels(values, 1.0), np.full(4000, 200.0))
    scaled = scaled[0] / np.sqrt(more)
    assert np.mean(scaled**2) / 200 == pytest.approx(1, abs=0.1)
    assert np.var(score**2 / 200) > 10 * np.var(scaled**2 / 200)
