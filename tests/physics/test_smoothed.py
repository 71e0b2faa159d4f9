"""Frames that were smoothed and values that are not linear are said, and bring no mechanisms that are not
there."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import ndimage

from cannoise_jax.mechanisms import LISTED
from cannoise_jax.physics.transfer.clamped import clamped as clamped_line
from cannoise_jax.physics.transfer.doubts import doubts
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.model import find_mechanisms
from cannoise_jax.physics.transfer.photon_transfer import photon_transfer
from cannoise_jax.physics.transfer.smoothed import smoothed
from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE, FRAMES = (80, 112), 8


def recorded(
    change=lambda frames: frames, lights=((0.1, 8000.0),), seed=0, more=0.0, egain=None, count=FRAMES
):
    """Flats and darks of 0.5 DN/e- and 4 e- of read noise. change: what is done to frames before they are
    stored; more: read noise beside it, DN; lights: seconds and electrons of flats."""
    rng, out = np.random.default_rng(seed), []
    for kind, (seconds, light) in (("dark", (0.1, 0.0)), *(("flat", at) for at in lights)):
        charge = rng.poisson(light, (count, *SIZE)) + 4.0 * rng.standard_normal((count, *SIZE))
        codes = np.rint(change(300 + 0.5 * charge + more)).clip(0, 65535).astype(np.uint16)
        stated = {"exposure_s": seconds, "egain": egain}
        out.append(Recording(codes, "MONO", (300.0,) * 4, 65535.0, "c", kind, code_step=1.0, **stated))
    return CaptureSet("c", tuple(out))


def blurred(frames):
    return ndimage.gaussian_filter(frames, (0, 0.7, 0.7))


def boxed(frames):
    return ndimage.uniform_filter(frames, (1, 3, 3))


@pytest.mark.parametrize("change", [pytest.param(blurred, marks=pytest.mark.slow), boxed])
def test_smoothed_frames_are_said_and_have_no_noise_of_lines(change):
    (transfer,) = photon_transfer(recorded(change))
    assert any("processed, not raw" in line for line in doubts(transfer))
    findings = find_mechanisms(transfer.statistics, transfer.baseline, LISTED)
    there = {f.mechanism for f in findings if f.measured is not None}
    assert there <= {"prnu", "dsnu"}


def clamped(frames):
    """To the largest of the eight about each pixel, as firmware does to hot pixels."""
    about = np.ones((1, 3, 3), bool)
    about[0, 1, 1] = False
    return np.minimum(frames, ndimage.maximum_filter(frames, footprint=about))


def median_of_loud(frames):
    middle = ndimage.median_filter(frames, (1, 3, 3))
    return np.where(frames > middle + 25, middle, frames)


def median_of_few(frames):
    middle = ndimage.median_filter(frames, (1, 3, 3))
    return np.where(frames > middle + 70, middle, frames)


@pytest.mark.parametrize(
    "change", [clamped, median_of_loud, pytest.param(median_of_few, marks=pytest.mark.slow)]
)
def test_filters_of_loud_pixels_are_said_and_are_no_crosstalk(change):
    (transfer,) = photon_transfer(recorded(change, count=2 * FRAMES))
    said = " ".join(doubts(transfer))
    assert ("loud pixels were clamped" if change is clamped else "frames were filtered") in said
    findings = find_mechanisms(transfer.statistics, transfer.baseline, LISTED)
    assert "crosstalk" not in {f.mechanism for f in findings if f.measured is not None}


def both_sides(frames):
    return -clamped(-clamped(frames))


def by_colour(frames):
    out = frames.copy()
    for y, x in ((0, 0), (0, 1), (1, 0), (1, 1)):
        out[:, y::2, x::2] = clamped(frames[:, y::2, x::2])
    return out


@pytest.mark.parametrize(
    ("change", "cfa", "what"),
    [
        (both_sides, "MONO", "loud and dark"),
        (by_colour, "RGGB", "loud"),
        (lambda f: -clamped(-f), "MONO", "dark"),
    ],
)
def test_which_pixels_were_clamped_is_said(change, cfa, what):
    capture = recorded(change)
    of_colour = tuple(dataclasses.replace(r, cfa=cfa) for r in capture.recordings)
    (transfer,) = photon_transfer(CaptureSet("c", of_colour))
    assert any(f"{what} pixels were clamped" in line for line in doubts(transfer))


def test_steep_light_and_lines_are_not_clamped():
    steep = 400.0 * np.arange(SIZE[1])
    rows = 200.0 * np.random.default_rng(1).standard_normal((FRAMES, SIZE[0], 1))
    for more in (steep, rows):
        flat = recorded(more=more).recordings[1]
        assert clamped_line(frame_statistics(flat)) == ""


@pytest.mark.parametrize("axis", (1, 2), ids=("down", "across"))
def test_frames_smoothed_along_one_axis_are_said(axis):
    (transfer,) = photon_transfer(recorded(lambda f: 0.8 * f + 0.2 * np.roll(f, 1, axis)))
    assert any("processed, not raw" in line for line in doubts(transfer))
    findings = find_mechanisms(transfer.statistics, transfer.baseline, LISTED)
    assert not {"crosstalk", "pink_noise"} & {f.mechanism for f in findings if f.measured is not None}


def test_charge_that_spreads_is_no_filter():
    spread = np.outer((0.12, 0.76, 0.12), (0.12, 0.76, 0.12))  # of a Gaussian, to the diagonals as well
    rng, frames = np.random.default_rng(2), []
    for kind, light in (("dark", 0.0), ("flat", 16000.0)):
        charge = ndimage.convolve(rng.poisson(light, (FRAMES, *SIZE)).astype(float), spread[None])
        codes = np.rint(300 + 0.5 * (charge + 4.0 * rng.standard_normal(charge.shape))).astype(np.uint16)
        frames.append(Recording(codes, "MONO", (300.0,) * 4, 65535.0, "c", kind, code_step=1.0))
    (transfer,) = photon_transfer(CaptureSet("c", tuple(frames)))
    assert not any("filtered" in line for line in doubts(transfer))
    findings = find_mechanisms(transfer.statistics, transfer.baseline, LISTED)
    assert "crosstalk" in {f.mechanism for f in findings if f.measured is not None}


def test_noise_of_rows_and_columns_and_waves_is_no_smoothing():
    """All of these make neighbours alike, and pixels further away too."""
    rng, y = np.random.default_rng(1), np.arange(SIZE[0])
    lines = 3.0 * rng.standard_normal((FRAMES, 1, SIZE[1])) + 3.0 * rng.standard_normal((FRAMES, SIZE[0], 1))
    wave = 4.0 * np.sin(0.2 * np.arange(SIZE[1]) + 0.3 * y[:, None])
    drifting = wave * rng.standard_normal((FRAMES, 1, 1))
    along = np.cumsum(0.4 * rng.standard_normal((FRAMES, *SIZE)), axis=2)
    for more in (lines, drifting, along - along.mean(2, keepdims=True)):
        dark = recorded(more=more).recordings[0]
        assert smoothed([frame_statistics(dark)]) == ""
    (transfer,) = photon_transfer(recorded())
    assert doubts(transfer) == ()


def test_codes_with_a_gamma_are_said():
    ladder = [(0.002 * 2**n, 2000.0 * 2**n) for n in range(5)]

    def encoded(frames):
        return 3000 * (np.maximum(frames - 250, 0) / 16000) ** 0.45

    (straight,) = photon_transfer(recorded(lights=ladder))
    (bent,) = photon_transfer(recorded(encoded, ladder))
    assert doubts(straight) == ()
    assert any("not linear" in line for line in doubts(bent))


def test_a_stated_gain_far_off_is_said():
    (near,), (far,) = (photon_transfer(recorded(egain=e)) for e in (1.8, 0.5))
    assert doubts(near) == ()
    assert any("a factor of 4" in line for line in doubts(far))
