"""Recordings of few rows, columns or pixels: every estimator gives a value or says what it lacks."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from cannoise_jax.commands.calibrate import calibrate
from cannoise_jax.evaluation.sheet_data import sheet_data
from cannoise_jax.mechanisms import MECHANISMS
from cannoise_jax.physics.transfer.estimate import NotMeasurable
from cannoise_jax.physics.transfer.estimators.maps import pixel_read_noise_map
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.model import format_findings, sensor_model
from cannoise_jax.physics.transfer.photon_transfer import of_all_pixels
from cannoise_jax.recordings import CaptureSet, Recording

SIZES = ((4, 128), (6, 128), (8, 128), (128, 4), (128, 6), (96, 8), (16, 16))
DEFAULT = (((128, 4), 0.0), ((16, 16), 0.8))
GAIN, READ_E, BLACK = 0.5, 4.0, 100.0


def recording(rng, size, electrons, kind, exposure_s, frames, spread=0.0):
    """Codes of a camera with Poisson-Gaussian noise; spread: of the read noise over the pixels."""
    read = READ_E * np.exp(spread * rng.standard_normal(size))
    charge = rng.poisson(electrons, (frames, *size)) + read * rng.standard_normal((frames, *size))
    codes = np.clip(np.rint(BLACK + GAIN * charge), 0, 4095).astype(np.uint16)
    return made(codes, kind, exposure_s)


def made(codes, kind, exposure_s):
    return Recording(
        codes, "MONO", (BLACK,) * 4, 4095.0, kind=kind, exposure_s=exposure_s, iso=100.0, code_step=1.0
    )


def capture(size, frames=8, spread=0.0):
    """Flats and darks of three exposures."""
    rng = np.random.default_rng(size)
    times = (0.01, 1.0, 30.0)
    flats = [recording(rng, size, 2e3 * k, "flat", 0.01 * k, frames, spread) for k in (0.3, 1, 2)]
    darks = [recording(rng, size, 0.1 * t, "dark", t, frames, spread) for t in times]
    return CaptureSet("made", (*flats, *darks))


@pytest.mark.parametrize(
    ("size", "spread"),
    [
        pytest.param(
            size,
            spread,
            id=f"{spread}-{size[0]}x{size[1]}",
            marks=() if (size, spread) in DEFAULT else pytest.mark.slow,
        )
        for spread in (0.0, 0.8)
        for size in SIZES
    ],
)
def test_calibrate_of_small_frames_ends_without_a_fault_of_its_own(size, spread):
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        transfers, findings = calibrate(capture(size, spread=spread))
    assert findings
    for finding in findings:
        if not isinstance(finding.estimates, NotMeasurable):
            for name, estimate in finding.estimates.items():
                assert np.isfinite(estimate.value), (finding.mechanism, name)
    model = sensor_model(transfers, findings)
    assert format_findings(findings) and sheet_data(tuple(map(of_all_pixels, transfers)))
    assert 0.5 < float(np.mean(np.asarray(model.gain_dn_per_e))) / GAIN < 2


@pytest.mark.parametrize("size", ((8, 128), pytest.param((128, 8), marks=pytest.mark.slow)))
def test_what_needs_more_pixels_says_so(size):
    statistics = [frame_statistics(r) for r in capture(size).recordings]
    baseline = calibrate(capture(size))[0][0].baseline
    found = MECHANISMS["in_camera_denoising"].estimator(statistics, baseline)
    assert isinstance(found, NotMeasurable) and "16 rows" in found.record
    gain = MECHANISMS["column_gain"].estimator(statistics, baseline)
    assert isinstance(gain, NotMeasurable) == (size[1] < 16)


def test_a_channel_without_pixels_has_no_spread():
    dark = frame_statistics(recording(np.random.default_rng(0), (32, 48), 0.0, "dark", 1.0, 8))
    assert "spread" in pixel_read_noise_map([dark])
    without = np.zeros((32, 48), bool)
    without[::2, ::2] = True
    assert isinstance(pixel_read_noise_map([dark], without=without), NotMeasurable)


def test_full_darks_are_said_to_be_full():
    rng, size = np.random.default_rng(0), (32, 48)
    short = frame_statistics(recording(rng, size, 0.0, "dark", 0.01, 8))
    full = frame_statistics(made(np.full((8, *size), 4095, np.uint16), "dark", 100.0))
    baseline = calibrate(capture(size))[0][0].baseline
    found = MECHANISMS["hot_pixels"].estimator([short, full], baseline)
    assert isinstance(found, NotMeasurable) and "shorter" in found.record


def test_two_amplifiers_in_one_frame_end_in_a_model():
    rng, size, half = np.random.default_rng(5), (64, 96), 48
    out = []
    for kind, electrons in (("dark", 0.0), ("flat", 900.0), ("flat", 2400.0)):
        charge = rng.poisson(electrons, (16, *size)) * 1.0
        charge[..., :half] = 100 + 0.5 * (charge[..., :half] + 4 * rng.standard_normal((16, 64, half)))
        charge[..., half:] = 130 + 0.6 * (charge[..., half:] + 8 * rng.standard_normal((16, 64, half)))
        out.append(made(np.clip(np.rint(charge), 0, 4095).astype(np.uint16), kind, 0.01))
    transfers, findings = calibrate(CaptureSet("made", tuple(out)))
    assert 0.45 < float(np.mean(np.asarray(sensor_model(transfers, findings).gain_dn_per_e))) < 0.65
