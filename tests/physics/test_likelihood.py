"""The discretised likelihood: against float64 references, entropies, brute force, and simulated truths."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats

from cannoise_jax.physics.core import tukey_lambda
from cannoise_jax.physics.likelihood import accuracy
from cannoise_jax.physics.likelihood.codes import (
    CodeGrid,
    code_entropy,
    gaussian_log_prob,
    log_normal_cdf,
    log_normal_interval,
)
from cannoise_jax.physics.likelihood.crossed import (
    crossed_gaussian,
    crossed_laplace,
    stationary_factor,
    white_terms,
)
from cannoise_jax.physics.likelihood.fit import fit_baseline, reference_factor
from cannoise_jax.physics.likelihood.shared import as_groups, shared_log_prob
from cannoise_jax.physics.likelihood.shot import choose_shot, shot_error, skewed_log_prob
from cannoise_jax.physics.likelihood.tails import student_log_prob, tukey_log_prob
from cannoise_jax.recordings.recording import BadInput, Recording


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
    forms = (
        gaussian_log_prob(code, mean, sigma**2, grid),
        skewed_log_prob(code, 1e7, 1e-4, mean - 1e3, sigma, grid),
        tukey_log_prob(code, mean, 1.0, sigma, 0.135, grid),
    )
    assert float(forms[0]) == pytest.approx(exact, rel=0.02) and -2e-5 < exact < -1e-6
    for value in forms:
        assert -1e-4 < float(value) < 1e-6
    below = float(gaussian_log_prob(code - np.float32(step), mean, sigma**2, grid))
    edges = (np.array([top - 1.5 * step, top - 0.5 * step]) - 65700) / sigma
    assert below == pytest.approx(np.log(np.diff(stats.norm.cdf(edges))[0]), abs=0.01)


def test_baseline_of_saturated_light_is_not_pulled_to_the_highest_code():
    rng = np.random.default_rng(5)
    clean = np.broadcast_to(np.linspace(0.9, 1.0, 64, dtype=np.float32), (32, 64))
    signal = clean * (65535.0 - 256)
    frames = 256 + signal + rng.normal(size=(6, 32, 64)) * np.sqrt(20.0 * signal)
    codes = np.clip(np.round(frames / 16) * 16, 0, 65520).astype(np.uint16)
    assert np.mean(codes == 65520) > 0.02
    recording = Recording(codes, "RGGB", (256.0,) * 4, 65535.0, kind="scene", clean=clean, code_step=16.0)
    found = fit_baseline([recording], trim=None)
    offset = (np.asarray(found.black_level) - 256) / np.asarray(found.black_error)
    assert np.abs(offset).max() < 4 and np.abs(offset.mean()) < 2


def test_mean_log_likelihood_of_rounded_data_is_minus_their_entropy():
    # 0.69 DN read noise, rounded to whole DN: 1.13 nats; a density in place of the mass would claim 1.048.
    codes = np.arange(-20.0, 21.0)
    phases = np.linspace(0, 1, 40, endpoint=False)[:, None]
    entropies = code_entropy(gaussian_log_prob(codes, phases, 0.69**2))
    edges = (np.arange(-20, 22) - 0.5) / 0.69
    mass = np.diff(stats.norm.cdf(edges - phases / 0.69))
    exact = special.entr(mass).sum(1).mean()
    assert abs(float(entropies.mean()) - exact) < 2e-5 and abs(exact - 1.131) < 4e-3
    rng = np.random.default_rng(1)
    mean = rng.uniform(0, 1, 400_000).astype(np.float32)
    drawn = np.round(mean + 0.69 * rng.normal(size=mean.size)).astype(np.float32)
    log_prob = np.asarray(gaussian_log_prob(drawn, mean, 0.69**2), float)
    assert abs(log_prob.mean() + float(entropies.mean())) < 4 * log_prob.std() / np.sqrt(mean.size)


def test_a_step_of_one_on_codes_of_step_sixteen_is_wrong_by_log_sixteen():
    rng = np.random.default_rng(2)
    drawn = 16 * np.round(rng.normal(10, 3, 20_000)).astype(np.float32)
    right = gaussian_log_prob(drawn, 160.0, 48.0**2, CodeGrid(16.0))
    wrong = gaussian_log_prob(drawn, 160.0, 48.0**2, CodeGrid(1.0))
    assert abs(float((right - wrong).mean()) - np.log(16)) < 5e-3


def test_shot_noise_forms_lose_no_more_than_they_promise():
    for electrons, gain, read in ((2.0, 2.0, 4.0), (60.0, 0.5, 1.0), (400.0, 2.0, 4.0)):
        chosen = ("gaussian", "skewed", "poisson")[int(choose_shot(np.array(electrons), gain, read))]
        assert shot_error(electrons, gain, read, CodeGrid(1.0), chosen) < 1e-5
    assert shot_error(60.0, 0.5, 1.0, CodeGrid(1.0), "gaussian") > 1e-4  # so the choice matters


def test_student_and_tukey_lambda_match_scipy():
    codes = np.array([-60.0, -20, -8, -3, -1, 0, 1, 2, 5, 9, 15, 30, 60])
    offset = np.abs(codes - 0.2)
    for dof in (2.5, 5.0, 10.0):
        law = stats.t(dof, scale=2 / np.sqrt(dof / (dof - 2)))
        exact = np.log(law.sf(offset - 0.5) - law.sf(offset + 0.5))
        np.testing.assert_allclose(student_log_prob(codes, 0.2, 0.0, 2.0, dof), exact, atol=5e-5)
    for shape in (-0.3, 0.0, 0.14):
        law = stats.tukeylambda(shape, scale=2 / np.sqrt(float(tukey_lambda.variance(shape))))
        mass = law.sf(offset - 0.5) - law.sf(offset + 0.5)
        seen = mass > 1e-9
        got = np.asarray(tukey_log_prob(codes, 0.2, 0.0, 2.0, shape))
        np.testing.assert_allclose(got[seen], np.log(mass[seen]), atol=2e-3)
        assert np.isfinite(got).all()


def test_tukey_lambda_plus_shot_noise_matches_a_convolution():
    p = special.expit(np.linspace(-40, 40, 4001))
    weight = np.gradient(p)
    codes = np.arange(-12.0, 13.0, 3.0)
    shape, read = -0.1, 2.0
    offset = read / np.sqrt(float(tukey_lambda.variance(shape))) * (p**shape - (1 - p) ** shape) / shape
    for shot in (0.5, 1.5, 6.0):
        mass = [
            weight[1000:-1000] @ accuracy.interval_mass((c - offset[1000:-1000]) / shot, 0.5 / shot)
            for c in codes
        ]
        np.testing.assert_allclose(tukey_log_prob(codes, 0.0, shot**2, read, shape), np.log(mass), atol=2e-3)


def test_one_shared_term_agrees_with_brute_force_and_finite_differences():
    rng = np.random.default_rng(3)
    level = np.float32(rng.uniform(0, 1, (6, 48)))
    for sigma in (0.35, 0.69):
        drawn = np.round(level + 0.5 * rng.normal(size=(6, 1)) + sigma * rng.normal(size=level.shape))
        exact = accuracy.brute_force_rows(drawn, level.astype(float), float(np.float32(sigma)), 0.5)
        found = accuracy._nested(drawn.astype(np.float32), level, sigma, 0.5)
        np.testing.assert_allclose(found, exact, atol=1e-6 * 48)
    mean = np.float32(rng.uniform(0, 1, (8, 40)))
    codes = np.round(mean + rng.normal(size=(8, 1)) + 0.8 * rng.normal(size=(8, 40))).astype(np.float32)

    @jax.jit
    def total(theta):
        return shared_log_prob(
            lambda o: gaussian_log_prob(codes, mean + o, jnp.exp(2 * theta[0])), jnp.exp(theta[1]), 8
        ).sum()

    theta = jnp.array([-0.1, 0.2])
    slope, h = jax.grad(total)(theta), 1e-2
    for k, unit in enumerate(np.eye(2, dtype=np.float32)):
        by_difference = (total(theta + h * unit) - total(theta - h * unit)) / (2 * h)
        assert abs(float(slope[k] - by_difference)) < 5e-3 * max(1, abs(float(by_difference)))


def _rows_by_brute_force(codes, noise: float, sigma: float) -> np.ndarray:
    """Log-probability of rows of whole codes with an offset each, wherever it lies; float64."""
    unit = np.linspace(-9, np.abs(codes).max() / sigma + 9, 20001)

    def inside(row):
        a = np.abs((row[:, None] - sigma * unit) / noise)
        low, high = (stats.norm.logsf(a + s * 0.5 / noise) for s in (-1, 1))
        return (low + np.log1p(-np.exp(high - low))).sum(0) + stats.norm.logpdf(unit)

    return np.array([special.logsumexp(inside(row)) for row in codes]) + np.log(unit[1] - unit[0])


@pytest.mark.parametrize("noise", [0.25, 1.0])
def test_an_offset_far_beyond_its_sigma_is_found(noise):
    rng, sigma = np.random.default_rng(9), 0.5
    for far, tolerance in ((10, 1e-6), (20, 1e-6), (50, 5e-6)):
        codes = np.round(far * sigma + noise * rng.normal(size=(6, 48)))
        known = _rows_by_brute_force(codes, noise, sigma)
        found = accuracy._nested(codes.astype(np.float32), np.zeros((6, 48), np.float32), noise, sigma)
        np.testing.assert_allclose(found, known, atol=tolerance * 48)


def test_among_crossed_offsets_one_far_beyond_its_sigma_is_found():
    rng, noise, sigma = np.random.default_rng(9), 0.5, 0.5
    terms = white_terms((6, 48), sigma)

    @jax.jit
    def found(codes):
        return crossed_laplace(lambda o: gaussian_log_prob(codes, o, noise**2), terms, (6, 48))

    for far in (10, 30, 60, 100):
        codes = np.round(far * sigma * (np.arange(6) == 2)[:, None] + noise * rng.normal(size=(6, 48)))
        known = _rows_by_brute_force(codes, noise, sigma).sum()
        assert float(found(codes.astype(np.float32))) == pytest.approx(known, abs=1e-5 * codes.size)


def test_groups_share_rows_columns_and_frames():
    frames = jnp.arange(24.0).reshape(2, 3, 4)
    assert as_groups(frames, "row").shape == (6, 4)
    assert np.array_equal(as_groups(frames, "column")[1], [1, 5, 9])
    assert np.array_equal(as_groups(frames, "frame")[1], np.arange(12, 24))


def test_crossed_terms_match_a_dense_covariance_and_brute_force():
    rng = np.random.default_rng(4)
    h, w = 6, 5
    pink = stationary_factor(jnp.asarray(0.5 * 0.6 ** np.arange(h), jnp.float32))
    terms = white_terms((h, w), 0.0, 0.4, 0.3)._replace(row=pink)
    variance = rng.uniform(1, 2, (h, w)).astype(np.float32)
    ones_h, ones_w = np.ones((h, h)), np.ones((w, w))
    covariance = np.kron(np.asarray(pink) @ np.asarray(pink).T, ones_w) + np.kron(ones_h, 0.16 * np.eye(w))
    covariance += 0.09 + np.diag((variance + 1 / 12).ravel())
    drawn = 1.5 * rng.normal(size=(3, h, w))
    dense = stats.multivariate_normal(np.zeros(h * w), covariance).logpdf(drawn.reshape(3, -1))
    low_rank = crossed_gaussian(drawn, 0.0, variance, terms, correct=False)
    np.testing.assert_allclose(low_rank, dense, atol=2e-4)

    def smooth(offset):  # continuous normal pixels: there Laplace is exact
        return gaussian_log_prob(drawn[0], offset, variance + 1 / 12, CodeGrid(0.0))

    assert abs(float(crossed_laplace(smooth, terms, (h, w))) - dense[0]) < 2e-4
    error = accuracy.shared_errors(1.0, 0.5)
    assert error.crossed_normal < 3e-4 and error.crossed_laplace < 1e-4


def _recording(rng, *, step=4.0, gain=2.0, read=3.0, black=64.0, hot=0.0, frames=3, noisy=None):
    electrons = 600 * np.linspace(0, 1, 96 * 96).reshape(96, 96) ** 2

    def draw(count):
        analogue = black + gain * rng.poisson(electrons, (count, 96, 96))
        return np.clip(np.round((analogue + read * rng.normal(size=analogue.shape)) / step) * step, 0, 4092)

    codes = draw(frames)
    struck = rng.random(codes.shape) < hot
    codes = np.where(struck, np.minimum(codes + 400, 4092), codes).astype(np.uint16)
    clean = electrons * gain / (4092 - black)
    if noisy:
        clean = (draw(noisy).mean(0) - black) / (4092 - black)
    return Recording(
        codes,
        "RGGB",
        (black + 5,) * 4,  # as recorded: five DN wrong
        4092.0,
        clean=((clean * (4092 - black)) / (4092 - black - 5)).astype(np.float32),
        code_step=step,
        reference="independent" if noisy else None,
        reference_frames=noisy,
    )


def test_baseline_is_recovered_with_calibrated_errors_despite_outliers_and_a_noisy_reference():
    rng = np.random.default_rng(5)
    for more in ({}, {"hot": 3e-3}, {"noisy": 8}):
        fit = fit_baseline([_recording(rng, **more)])
        pulls = np.concatenate([(fit.gain - 2.0) / fit.gain_error, (fit.read_noise - 3.0) / fit.read_error])
        assert fit.converged
        assert np.abs(pulls).max() < 4 and (pulls**2).mean() < 3
        assert np.abs(fit.black_level - 64).max() < 0.5
        assert np.all(fit.gain_error < 0.05) and np.all(fit.read_error < 0.6)


def test_darks_alone_give_read_noise_but_no_gain():
    rng = np.random.default_rng(6)
    codes = np.round(64 + 0.69 * rng.normal(size=(4, 64, 64))).astype(np.uint16)
    fit = fit_baseline([Recording(codes, "MONO", (64.0,) * 4, 1023.0, kind="dark", code_step=1.0)], trim=None)
    assert np.isnan(fit.gain).all()
    assert np.all(np.abs(fit.read_noise - 0.69) < 4 * fit.read_error)
    assert np.abs(fit.log_likelihood + 1.131).max() < 0.06


def test_light_without_expected_signal_is_refused_in_one_line():
    frames = np.zeros((1, 4, 4), np.uint16)
    with pytest.raises(BadInput, match="give `clean`") as error:
        fit_baseline(
            [Recording(frames, "RGGB", (0.0,) * 4, 1023.0, kind="flat", path="flat.h5", code_step=1.0)]
        )
    assert "flat.h5" in str(error.value) and "\n" not in str(error.value)


def test_reference_error_adds_or_removes_its_share():
    assert reference_factor("independent", 4) == 1.25
    assert reference_factor("burst_mean", 4) == 0.75
    assert reference_factor(None, 4) == reference_factor("independent", None) == 1.0


def test_intervals_of_shot_read_and_row_noise_cover_a_thin_slice():
    for c in accuracy.coverage(10, seed=1):
        assert c.covered >= 0.6, c  # 10 draws of a 90 % interval: fewer than 6 hits once in 600
        assert abs(c.mean / c.truth - 1) < 0.25, c


@pytest.mark.slow
def test_intervals_cover_85_to_95_percent():
    for c in accuracy.coverage(300, seed=2):
        assert 0.85 <= c.covered <= 0.95, c
