"""Statistics beside KL: white noise gives their null value, known structure its known value."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.evaluation import kl
from cannoise_jax.evaluation.evaluators import (
    EVALUATORS,
    Samples,
    evaluate,
    excess_kurtosis,
    lag_correlation,
    pooled,
    row_power_ratio,
)

SHAPE = (24, 64, 64, 4)


@pytest.fixture(scope="module")
def white():
    return np.random.default_rng(0).normal(0, 0.01, SHAPE)


def samples(real, fake, level=0.1):
    clean = np.full(real.shape, level, np.float32)
    return Samples(real, fake, clean, np.full(real.shape, 0.01))


def test_white_noise_is_at_the_null_values(white):
    assert row_power_ratio(white) == pytest.approx(1, abs=0.06)
    assert lag_correlation(white, 1) == pytest.approx(0, abs=0.004)
    assert lag_correlation(white, 2) == pytest.approx(0, abs=0.004)
    assert excess_kurtosis(white) == pytest.approx(0, abs=0.02)


def test_row_spectrum_sees_a_tenth_of_sigma_in_mosaic_rows(white):
    """Row noise of share s adds s^2 * (pixels in a row) to the white expectation: 1 + 0.01 * 128."""
    rows = np.random.default_rng(1).normal(0, 0.001, (SHAPE[0], 64, 1, 2))
    shared = white + np.repeat(rows, 2, axis=3)
    assert row_power_ratio(shared) == pytest.approx((1 + 0.01 * 128) / 1.01, rel=0.06)


def test_row_spectrum_ignores_offsets_of_channels_and_of_the_whole(white):
    offset = white + np.array([0.01, -0.02, 0.03, 0.005]) + 0.05
    assert row_power_ratio(offset) == pytest.approx(row_power_ratio(white), rel=1e-6)


def test_slow_rows_weigh_more_than_white_rows_of_equal_power(white):
    rng = np.random.default_rng(2)
    fast = np.repeat(rng.normal(0, 0.001, (SHAPE[0], 64, 1, 2)), 2, axis=3)
    phase = rng.uniform(0, 2 * np.pi, (SHAPE[0], 1, 1, 1))
    slow = 0.001 * np.sqrt(2) * np.sin(2 * np.pi * 2 * np.arange(64).reshape(1, -1, 1, 1) / 64 + phase)
    assert row_power_ratio(white + slow) > 2 * row_power_ratio(white + fast)


@pytest.mark.parametrize("axis", [1, 2])
def test_lag_correlation_of_a_moving_average(white, axis):
    """x + a x' has lag-1 correlation a / (1 + a^2) along the axis, and none along the other."""
    blurred = white + 0.2 * np.roll(white, 1, axis=axis)
    assert lag_correlation(blurred, axis) == pytest.approx(0.2 / 1.04, abs=0.01)
    assert lag_correlation(blurred, 3 - axis) == pytest.approx(0, abs=0.005)


def test_kurtosis_of_student_t():
    values = np.random.default_rng(3).standard_t(12, 400_000)
    assert excess_kurtosis(values) == pytest.approx(6 / 8, abs=0.1)


def test_scale_tells_dark_from_bright():
    rng = np.random.default_rng(4)
    real = rng.normal(0, 0.01, SHAPE)
    clean = np.where(np.arange(64)[None, :, None, None] < 32, 0.02, 0.5) * np.ones(SHAPE)
    fake = rng.normal(0, 1, SHAPE) * np.where(clean < 0.1, 0.02, 0.005)
    numbers = evaluate(Samples(real, fake, clean, np.full(SHAPE, 0.01)))
    assert numbers["std_ratio_dark"] == pytest.approx(2, rel=0.02)
    assert numbers["std_ratio_bright"] == pytest.approx(0.5, rel=0.02)
    assert "std_ratio_middle" not in numbers


def test_kl_by_patch_is_the_mean_of_the_patches(white):
    fake = np.random.default_rng(5).normal(0, 0.012, SHAPE)
    numbers = evaluate(samples(white, fake))
    each = [kl.kl_divergence(a, b) for a, b in zip(white, fake, strict=True)]
    assert numbers["kl"] == pytest.approx(np.mean(each))
    assert numbers["patches"] == SHAPE[0]
    assert numbers["kl_pool"] == pytest.approx(kl.kl_divergence(white, fake))


def test_the_truth_scores_its_floor():
    rng = np.random.default_rng(6)
    numbers = evaluate(samples(rng.normal(0, 0.01, SHAPE), rng.normal(0, 0.01, SHAPE)))
    assert numbers["kl"] == pytest.approx(numbers["kl_floor"], rel=0.2)
    assert numbers["kl_pool"] < 3 * numbers["kl_pool_floor"] + 1e-5
    assert numbers["std_ratio"] == pytest.approx(1, abs=0.01)


def test_evaluators_share_no_key():
    rng = np.random.default_rng(7)
    made = [e.run(samples(rng.normal(0, 0.01, SHAPE), rng.normal(0, 0.01, SHAPE))) for e in EVALUATORS]
    assert sum(len(m) for m in made) == len(set().union(*made))


def test_pooled_is_the_mean_over_patches():
    rng = np.random.default_rng(8)
    real, fake = rng.normal(0, 0.02, SHAPE), rng.normal(0, 0.025, SHAPE)
    parts = [evaluate(samples(real[part], fake[part])) for part in (slice(0, 8), slice(8, None))]
    whole, row = evaluate(samples(real, fake)), pooled(parts)
    assert row["kl"] == pytest.approx(whole["kl"]) and row["patches"] == SHAPE[0]
    assert row["kl_se"] == pytest.approx(whole["kl_se"], rel=0.2)
    assert pooled([{"patches": 1, "a": 1.0}, {"patches": 3, "a": 2.0, "b": 5.0}]) == {
        "patches": 4,
        "a": 1.75,
        "b": 5.0,
    }


def test_noise_that_is_not_finite_has_no_score(white):
    broken = white.copy()
    broken[3, 2, 1, 0] = np.nan
    with pytest.raises(ValueError, match="1 of .* generated noise are not finite"):
        evaluate(samples(white, broken))


@pytest.mark.filterwarnings("error")
def test_noise_that_is_zero_has_no_structure(white):
    numbers = evaluate(samples(white, np.zeros_like(white)))
    assert np.isnan([numbers[n] for n in ("row_spectrum", "lag1_vertical", "excess_kurtosis")]).all()
    assert numbers["std_ratio"] == 0 and np.isfinite(numbers["kl_smoothed"])
