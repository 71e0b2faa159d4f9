"""The KL metric: the reference's arithmetic bin by bin, its known weaknesses, and its finite-sample floor."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cannoise_jax.evaluation import kl


def naive_kl(real, fake):
    """The definition, one value and one bin at a time, without np.histogram."""
    width = 0.2 / 64
    inner = [-0.1 + i * width for i in range(65)]

    def counts(values):
        result = [0] * 66
        for value in values:
            result[sum(value >= edge for edge in inner)] += 1
        return result

    p, q = counts(real), counts(fake)
    total = 0.0
    for a, b in zip(p, q, strict=True):
        if a and b:
            total += a / len(real) * math.log((a / len(real)) / (b / len(fake)))
    return total


def test_edges_are_66_bins_and_zero_falls_below_the_middle():
    assert kl.EDGES.size == 67 and kl.BINS == 66
    assert kl.EDGES[33] > 0 and kl.EDGES[33] < 1e-16
    assert kl.histogram(np.zeros(5))[32] == 5
    assert kl.histogram(np.array([-5.0, 5.0]))[[0, 65]].tolist() == [1, 1]


def test_agrees_with_the_definition():
    rng = np.random.default_rng(0)
    real, fake = rng.normal(0, 0.05, 3000), rng.standard_t(4, 2500) * 0.04
    assert kl.kl_divergence(real, fake) == pytest.approx(naive_kl(real, fake), abs=1e-12)


def smoothed(real, fake):
    return kl.kl_smoothed_of_counts(kl.histogram(real), kl.histogram(fake))


def test_identical_sets_give_zero():
    noise = np.random.default_rng(1).normal(0, 0.02, (4, 8, 8))
    assert kl.kl_divergence(noise, noise) == 0
    assert smoothed(noise, noise) == 0


def test_direction_is_real_against_fake():
    rng = np.random.default_rng(2)
    wide, narrow = rng.normal(0, 0.02, 200_000), rng.normal(0, 0.015, 200_000)
    gaussian = 0.5 * ((0.02 / 0.015) ** 2 - 1) - math.log(0.02 / 0.015)
    assert smoothed(wide, narrow) == pytest.approx(gaussian, rel=0.05)


def test_a_model_without_noise_scores_below_zero_unless_smoothed():
    real = np.random.default_rng(3).normal(0, 0.04, 16384)
    assert kl.kl_divergence(real, np.zeros(16384)) == pytest.approx(-0.108, abs=0.006)
    assert smoothed(real, np.zeros(16384)) == pytest.approx(5.47, abs=0.05)


@pytest.mark.parametrize(
    "count, sigma, published",
    [
        (4096, 0.005, 0.0027),
        (4096, 0.01, 0.0051),
        (4096, 0.02, 0.0097),
        (4096, 0.04, 0.0162),
        (16384, 0.002, 0.0003),
        (16384, 0.005, 0.0007),
        (16384, 0.01, 0.0014),
        (16384, 0.02, 0.0027),
        (16384, 0.04, 0.0040),
        (65536, 0.01, 0.0004),
        (65536, 0.04, 0.0010),
    ],
)
def test_floor_of_two_draws_of_one_gaussian(count, sigma, published):
    """The floor from one real set agrees with the mean over independent pairs, and with measured values."""
    rng = np.random.default_rng(count)
    draws = [kl.histogram(rng.normal(0, sigma, count)) for _ in range(120)]
    pairs = [kl.kl_of_counts(a, b) for a, b in zip(draws[::2], draws[1::2], strict=True)]
    standard_error = np.std(pairs) / math.sqrt(len(pairs))
    floor = np.mean([kl.kl_floor_of_counts(c, trials=16, seed=i) for i, c in enumerate(draws[:8])])
    assert np.mean(pairs) == pytest.approx(published, abs=6e-5 + 4 * standard_error)
    assert floor == pytest.approx(np.mean(pairs), rel=0.1, abs=4 * standard_error)


def test_floor_counts_both_sets():
    share = np.full(66, 1000)
    for fake in (66_000, 6_600, 660_000):
        measured = kl.kl_floor_of_counts(share, fake, trials=400)
        assert measured == pytest.approx(65 / 2 * (1 / 66_000 + 1 / fake), rel=0.06)


@pytest.mark.parametrize(
    "ratio, expected",
    [(1.0, 0.0015), (1.05, 0.0037), (1.1, 0.0105), (1.2, 0.036), (1.3, 0.076), (1.45, 0.152), (0.75, 0.069)],
)
def test_sensitivity_to_scale(ratio, expected):
    rng = np.random.default_rng(7)
    values = [
        kl.kl_divergence(rng.normal(0, 0.01 * ratio, 16384), rng.normal(0, 0.01, 16384)) for _ in range(40)
    ]
    assert np.mean(values) == pytest.approx(expected, rel=0.08)


@pytest.mark.parametrize("freedom, expected", [(3, 0.080), (5, 0.020), (10, 0.0058)])
def test_sensitivity_to_tails_of_equal_variance(freedom, expected):
    rng = np.random.default_rng(8)
    scale = 0.01 / math.sqrt(freedom / (freedom - 2))
    values = [
        kl.kl_divergence(rng.standard_t(freedom, 16384) * scale, rng.normal(0, 0.01, 16384))
        for _ in range(40)
    ]
    assert np.mean(values) == pytest.approx(expected, rel=0.12)


def test_clipped_noise_is_what_a_clipped_recording_shows():
    clean = np.array([0.01, 0.5, 0.99])
    assert kl.clipped_noise(np.array([-0.2, 0.1, 0.2]), clean) == pytest.approx([-0.01, 0.1, 0.01])


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused(wrong):
    real = np.random.default_rng(9).normal(0, 0.02, 1000)
    fake = real.copy()
    fake[7] = wrong
    for measure in (kl.kl_divergence, smoothed):
        with pytest.raises(ValueError, match="1 of 1000 values are not finite"):
            measure(real, fake)
        with pytest.raises(ValueError, match="not finite"):
            measure(fake, real)
