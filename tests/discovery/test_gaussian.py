"""A name for Gaussian noise of a power law stays with such noise, whatever its exponent and weights, and goes
where its spectrum or its law is another."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.discovery.proof.gaussian import kurtosis, not_gaussian, other_law, other_spectrum
from cannoise_jax.discovery.search.name import Named
from cannoise_jax.discovery.search.steps import Step
from cannoise_jax.signatures.fields import helmert, refit
from cannoise_jax.signatures.handed import Series
from tests.discovery.capture import capture_set, row_offsets

FRAMES = [7, 5, 6, 5, 7, 6]
LINES = 128


def power_law(rng, frames, number, exponent):
    """Of a record four times as long, so that the end does not meet the beginning."""
    frequency = np.fft.rfftfreq(4 * number)
    shape = (frames, frequency.size)
    modes = rng.standard_normal(shape) + 1j * rng.standard_normal(shape)
    modes[:, 1:] *= frequency[1:] ** (-exponent / 2)
    modes[:, 0] = 0
    series = np.fft.irfft(modes, axis=1)[:, :number]
    return series / series.std()


def recorded(rng, draw, exponent, strength=2.0, uneven=0.0, level=True, number=LINES):
    """Recordings of a series of unit variance, `strength` times its noise, by contrasts."""
    out = []
    for frames in FRAMES:
        information = strength**2 * np.exp(uneven * rng.standard_normal(number))
        score = draw(rng, frames, number) * information
        score += np.sqrt(information) * rng.standard_normal(score.shape)
        contrasts = helmert(frames) @ score
        if level:  # what all places share is the frame's
            contrasts -= contrasts.sum(1, keepdims=True) / information.sum() * information
        out.append(Series(contrasts, information, exponent, level))
    return out


def against(series):
    return other_spectrum(series, series) or other_law(series, FRAMES)


@pytest.mark.parametrize(
    "exponent",
    [0.0, pytest.param(0.5, marks=pytest.mark.slow), 1.0, pytest.param(1.5, marks=pytest.mark.slow)],
)
@pytest.mark.parametrize(
    ("strength", "uneven"),
    [
        (0.5, 0.0),
        pytest.param(2.0, 0.2, marks=pytest.mark.slow),
        pytest.param(0.5, 0.6, marks=pytest.mark.slow),
        (2.0, 0.6),
    ],
)
def test_noise_of_a_power_law_keeps_its_name(exponent, strength, uneven):
    """Of 16 kinds ten draws each: at one in a hundred the chance of none is one in five; none of 6,000 draws
    beside these was doubted."""
    rng = np.random.default_rng(int(100 * exponent + 10 * strength + uneven))
    for _ in range(10):
        series = recorded(rng, lambda *a: power_law(*a, exponent), exponent, strength, uneven)
        assert against(series) is None


@pytest.mark.parametrize("exponent", [0.75, 1.25])
def test_noise_along_the_scan_keeps_its_name(exponent):
    rng = np.random.default_rng(4)
    for strength in (0.15, 0.6):
        series = recorded(
            rng, lambda *a: power_law(*a, exponent), exponent, strength, 0.1, level=False, number=64 * 96
        )
        assert against(series) is None


def bursts(rng, frames, number):
    """A few places of every frame, each with a decaying tail."""
    hits = (rng.random((frames, number)) < 0.02) * rng.standard_normal((frames, number))
    tail = np.exp(-np.arange(12) / 3.0)
    series = np.stack([np.convolve(row, tail)[:number] for row in hits])
    return series / series.std()


def band(rng, frames, number):
    """Noise of one octave."""
    modes = np.fft.rfft(rng.standard_normal((frames, number)), axis=1)
    at = np.fft.rfftfreq(number)
    series = np.fft.irfft(modes * ((at > 0.1) & (at < 0.2)), number, axis=1)
    return series / series.std()


def sawtooth(rng, frames, number):
    """A ramp that starts anew every 48 places, at a place of its own in every frame."""
    return np.sqrt(12) * ((np.arange(number) / 48 + rng.random((frames, 1))) % 1 - 0.5)


def three_levels(rng, frames, number):
    """Steps to one of three levels, each held for some thirty places."""
    jumps = rng.random((frames, number)) < 1 / 30
    jumps[:, 0] = True
    held = np.maximum.accumulate(np.where(jumps, np.arange(number), 0), axis=1)
    levels = rng.integers(-1, 2, (frames, number)) * np.sqrt(1.5)
    return np.take_along_axis(levels, held, 1)


@pytest.mark.parametrize("draw", [bursts, band, sawtooth, three_levels])
@pytest.mark.parametrize("exponent", [0.0, 1.0])
def test_what_has_another_law_or_spectrum_is_doubted(draw, exponent):
    found = against(recorded(np.random.default_rng(3), draw, exponent, 3.0))
    assert found is not None and found.instead and len(found.against) == 1


def test_two_levels_along_the_scan_have_no_power_law():
    """Held for a hundred pixels on average: below 1 / 600 cycles the spectrum is flat, above it falls."""

    def draw(rng, frames, number):
        return 2.0 * (np.cumsum(rng.random((frames, number)) < 0.01, axis=1) % 2) - 1

    series = recorded(np.random.default_rng(6), draw, 1.0, 0.4, level=False, number=96 * 128)
    found = other_spectrum(series, series, "px")
    assert found is not None and "other frequencies" in found.against[0] and found.left > 0.15


def test_one_frame_unlike_the_others_is_an_accident():
    rng = np.random.default_rng(9)
    series = recorded(rng, lambda *a: power_law(*a, 1.0), 1.0)
    more = np.zeros((FRAMES[0], LINES))
    more[2, 62:64] = 10 * series[0].information[62:64]
    series[0] = series[0]._replace(score=series[0].score + helmert(FRAMES[0]) @ more)
    value, weaker, _ = kurtosis(series, FRAMES, 2)
    assert value > 0.5 > abs(weaker)
    assert other_law(series, FRAMES) is None


def test_what_another_finding_takes_out_says_nothing():
    """Of bands whose power it moves."""
    rng = np.random.default_rng(2)
    whole = recorded(rng, lambda *a: power_law(*a, 1.0), 1.0)
    left = [s._replace(score=s.score.copy()) for s in whole]
    for s in left:
        modes = np.fft.rfft(s.score, axis=1)
        modes[:, 8:30] *= 0.2
        s.score[:] = np.fft.irfft(modes, LINES, axis=1)
    assert other_spectrum(left, left) is not None
    assert other_spectrum(left, whole) is None


def rare_rows(rng):
    """A few rows of every frame, with those after them."""

    def alter(dn, signal, kind, t):
        for start in rng.choice(dn.shape[0] - 6, 3, False):
            dn[start : start + 6] += 5 * rng.standard_normal() * np.exp(-np.arange(6) / 2.0)[:, None]
        return dn

    return alter


@pytest.mark.parametrize(("alter", "stays"), [(row_offsets(1.5), True), (rare_rows, False)])
def test_rows_of_recordings(alter, stays):
    capture = capture_set(8, alter, kinds="df")
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    signature = next(s for s in prepared.signatures if s.name == "row_additive_temporal")
    score = signature.score(prepared.fields)
    assert score is not None and score.log_p < -50
    named = Named(score, signature, "row_noise", (("row_noise", 1.0),), False)
    found = not_gaussian((Step(named, prepared.fields, score.log_p),), 0)
    assert (found is None) == stays
    # It has no name, or names no noise of lines: nothing to hold it to.
    other = next(s for s in prepared.signatures if s.name == "pixel_additive_static")
    assert not_gaussian((Step(named._replace(signature=other), prepared.fields, 0.0),), 0) is None


def test_noise_along_the_scan_beside_noise_of_rows_keeps_its_name():
    """What is taken out with the rows is missing in the spectrum along the scan."""

    def alter(rng):
        def change(dn, signal, kind, t):
            slow = power_law(rng, 1, dn.size, 1.0)[0].reshape(dn.shape)
            return dn + 6 * slow + 4 * rng.standard_normal((dn.shape[0], 1))

        return change

    capture = capture_set(8, alter, kinds="d")
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    fields, steps = prepared.fields, []
    for name in ("row_slope", "raster_slope"):
        signature = next(s for s in prepared.signatures if s.name == name)
        score = signature.score(fields)
        assert score is not None and score.log_p < -50
        steps.append(Step(Named(score, signature, name, ((name, 1.0),), False), fields, score.log_p))
        fields = refit(signature.absorb(fields, score))
    assert [not_gaussian(tuple(steps), n) for n in range(2)] == [None, None]


@pytest.mark.parametrize("strength", [0.05, 0.2, 0.6])
def test_tails_of_the_noise_of_pixels_are_not_those_of_the_series(strength):
    rng = np.random.default_rng(12)
    series = []
    for frames in FRAMES:
        score = strength**2 * power_law(rng, frames, 96 * 128, 1.0)
        score += strength * rng.standard_t(4.5, score.shape) * np.sqrt(2.5 / 4.5)
        information = np.full(96 * 128, strength**2)
        series.append(Series(helmert(frames) @ score, information, 1.0, level=False))
    assert against(series) is None
