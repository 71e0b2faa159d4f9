"""Tails, null laws and information of the score statistics."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import stats

from cannoise_jax.discovery.frames.contrasts import detected_step
from cannoise_jax.recordings.codes import detect_code_step
from cannoise_jax.recordings.recording import CaptureSet
from cannoise_jax.signatures import lines
from cannoise_jax.signatures.fields import frame_fields, helmert
from cannoise_jax.signatures.score import (
    chi2_log_sf,
    normal_log_p,
    quadratic_log_p,
    sidak,
    variance_component,
)
from tests.discovery.capture import capture_set
from tests.discovery.looks import SIGNATURES, white


def test_helmert_contrasts_are_orthonormal_and_blind_to_a_constant():
    for frames in (2, 5, 9):
        matrix = helmert(frames)
        assert np.allclose(matrix @ matrix.T, np.eye(frames - 1))
        assert np.allclose(matrix @ np.ones(frames), 0)


def test_frames_are_put_together_from_contrasts_and_static_part():
    rng = np.random.default_rng(0)
    frames = rng.standard_normal((4, 6, 8)).astype(np.float32)
    field = white(rng, kinds=("dark",), size=(6, 8))[0]._replace(
        contrasts=np.tensordot(helmert(4), frames, axes=1).astype(np.float32), static=frames.mean(0) * 2
    )
    assert np.allclose(frame_fields(field), frames, atol=1e-5)


@pytest.mark.parametrize("level", [0.05, 1e-3, 1e-5])
def test_quadratic_tail_against_the_exact_law_of_equal_weights(level):
    value = stats.chi2.isf(level, 12)
    assert quadratic_log_p(3 * value, np.full(12, 3.0)) == pytest.approx(np.log(level), abs=0.02)


def test_quadratic_tail_of_unequal_weights_against_simulation():
    rng = np.random.default_rng(1)
    weights = rng.uniform(0.2, 2, 80)
    draws = rng.standard_normal((200000, 80)) ** 2 @ weights
    for level in (0.1, 0.01, 1e-3):
        value = np.quantile(draws, 1 - level)
        assert quadratic_log_p(value, weights) == pytest.approx(np.log(level), abs=0.15)


@pytest.mark.parametrize("dof", [0.3, 1, 7.7, 100.0, 3e5])
def test_tails_are_those_of_scipy(dof):
    """They are worked out without its checks, on both sides of the median."""
    for x in (0.0, *(dof * np.geomspace(1e-3, 3, 40))):
        wanted = stats.chi2.logsf(x, dof)
        if wanted > -600:
            assert chi2_log_sf(x, dof) == pytest.approx(wanted, rel=1e-12, abs=1e-15)
    for z in (0.0, 1e-3, -2.5, 7.0, -40.0):
        assert normal_log_p(z) == pytest.approx(min(0.0, stats.norm.logsf(abs(z)) + np.log(2)), rel=1e-12)
        assert normal_log_p(z, 1) == pytest.approx(stats.norm.logsf(z), rel=1e-12)


def test_chi_square_tail_goes_on_where_it_underflows():
    below, above = chi2_log_sf(1190.0, 4), chi2_log_sf(1210.0, 4)
    assert -12 < above - below < -8


def test_sidak_is_exact_for_independent_tests():
    assert np.exp(sidak(np.log(1e-3), 50)) == pytest.approx(1 - (1 - 1e-3) ** 50)
    assert sidak(-800.0, 10) == pytest.approx(-800 + np.log(10))


def test_variance_component_recovers_a_known_variance_with_its_error():
    rng = np.random.default_rng(2)
    information = rng.uniform(0.5, 3, 4000)
    fits = []
    for _ in range(60):
        u = rng.standard_normal(4000) * np.sqrt(1 + 0.2 * information)
        fits.append(variance_component(u**2, information))
    z = [(f.variance - 0.2) / f.error for f in fits]
    assert abs(np.mean(z)) < 0.5 and 0.75 < np.std(z) < 1.3


def null_scores(score, count=60, **kind):
    return np.exp([score(white(np.random.default_rng(s), **kind)).log_p for s in range(count)])


@pytest.mark.parametrize(
    "name",
    [
        "row_additive_temporal",
        "column_additive_static",
        "frame_additive",
        "pixel_additive_static",
        "flicker",
        "lags_crosstalk",
        "lags_any",
        "kurtosis",
        "row_slope",
    ],
)
def test_null_p_values_are_not_too_small(name):
    kind = {"frames": 8, "size": (32, 48)} if name == "frame_additive" else {"size": (32, 48)}
    p = null_scores(SIGNATURES[name].score, **kind)
    assert stats.kstest(p, "uniform", alternative="greater").pvalue > 1e-3
    assert p.min() > 1e-5


@pytest.mark.parametrize("strength", [20.0])
def test_row_noise_shifts_its_score_by_the_information_it_states(strength):
    signature = SIGNATURES["row_additive_temporal"]
    shifts = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        fields = white(rng)
        one = signature.score(fields).shift
        sigma = one * np.sqrt(strength)
        fields = tuple(
            f._replace(
                contrasts=(
                    f.contrasts
                    + sigma / f.sigma * rng.standard_normal((len(f.contrasts), f.mean.shape[0], 1))
                ).astype(np.float32)
            )
            for f in fields
        )
        u = [lines.line_sums(f, f.contrasts, "row", "additive") for f in fields]
        power = np.concatenate([(s.score**2).sum(0) / s.information for s in u])
        i, n = (
            np.concatenate([s.information for s in u]),
            np.concatenate([np.full(64, len(s.score)) for s in u]),
        )
        shifts.append(np.sum(i * (power - n)) / np.sqrt(2 * np.sum(n * i**2)))
    assert np.mean(shifts) == pytest.approx(strength, abs=0.08 * strength)


def test_absorbing_row_noise_leaves_white_rows():
    signature = SIGNATURES["row_additive_temporal"]
    rng = np.random.default_rng(5)
    fields = tuple(
        f._replace(contrasts=(f.contrasts + 0.5 * rng.standard_normal((3, 64, 1))).astype(np.float32))
        for f in white(rng)
    )
    before = signature.score(fields)
    after = signature.score(signature.absorb(fields, before))
    assert before.log_p < -50 and after.log_p > np.log(1e-3)


def test_plane_wave_is_found_at_its_frequency():
    rng = np.random.default_rng(6)
    y, x = np.indices((64, 96))
    fields = tuple(
        f._replace(
            contrasts=(
                f.contrasts
                + np.array(
                    [0.2 * np.sin(2 * np.pi * (0.11 * y + 0.23 * x) + rng.uniform(0, 6)) for _ in range(3)]
                )
            ).astype(np.float32)
        )
        for f in white(rng)
    )
    signature = SIGNATURES["wave_redrawn"]
    score = signature.score(fields)
    fy, fx = score.parameters["frequency_y"][0], score.parameters["frequency_x"][0]
    assert score.log_p < -20
    assert abs(abs(fy) - 0.11) < 0.006 and abs(fx - 0.23) < 0.006
    assert score.amplitude == pytest.approx(0.6, rel=0.2)


def test_a_pixel_off_the_lattice_leaves_the_code_step():
    (dark, *_) = capture_set(0, step=4.0, kinds="d").recordings
    frames = np.array(dark.frames[:])
    frames[0, 5, 7] += 1
    repaired = CaptureSet("repaired", (dataclasses.replace(dark, frames=frames),))
    assert detected_step(repaired) == 4.0 == detect_code_step(frames[:1])


def test_code_step_is_the_common_divisor_of_the_codes():
    assert detected_step(capture_set(0, step=4.0, kinds="d")) == 4.0
    assert detected_step(capture_set(0, step=1.0, kinds="d")) == 1.0
