"""The minimum detectable effect against simulation: a plain NumPy likelihood ratio that knows the effect's
form, on frames drawn with and without it, is shifted by five null standard deviations."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.report.not_found import detectable
from cannoise_jax.discovery.search.limits import mde
from cannoise_jax.signatures.multiplicity import SHARED
from cannoise_jax.signatures.sparse import HOT_SHARE, TELEGRAPH_SHARE, hot_amplitude, telegraph_amplitude
from tests.conftest import SEARCH
from tests.discovery.capture import capture_set
from tests.discovery.naive_limits import (
    BLACK,
    CASES,
    GAIN,
    LONGEST,
    NULLS,
    PAIRS,
    READ,
    SIZE,
    limit,
    plan,
    shifts,
)  # fmt: skip

FIRST = ("row_noise", "dsnu", "heavy_tails")
OTHERS = ("prnu", "banding", "channel_offset", "green_imbalance", "crosstalk", "pixel_read_noise_map")
REST = (*OTHERS, *(m for m in CASES if m not in (*FIRST, *OTHERS)))


SHIFT = "shift of the likelihood ratio, standard deviations"
COLUMNS = ("effect at the minimum detectable strength", "measured", "expected")


def told(tables, mechanism, what, measured, expected):
    """Notes it for the table of docs/proof.md."""
    row = (f"{mechanism.replace('_', ' ')}: {what}", measured, expected)
    tables.add("detection_limits", COLUMNS, [row], (*SEARCH, "cannoise_jax/blind"))


@pytest.mark.parametrize("mechanism", FIRST)
@pytest.mark.parametrize(
    ("nulls", "near"), [(NULLS // 3, 0.5), pytest.param(NULLS, 0.3, marks=pytest.mark.slow)]
)
def test_the_mean_is_shifted_by_five(mechanism, nulls, near, tables):
    """near: the spread of fewer frames is less certain."""
    shift, error = shifts(FIRST, nulls, PAIRS)[mechanism]
    if nulls == NULLS:
        told(tables, mechanism, SHIFT, f"{shift:.2f} ± {error:.2f}", "5")
    assert shift == pytest.approx(5, abs=near), (shift, error)


@pytest.mark.slow
@pytest.mark.parametrize("mechanism", REST)
def test_the_mean_of_the_others_is_shifted_by_five(mechanism, tables):
    shift, error = shifts(REST, 2 * NULLS, 4 * PAIRS)[mechanism]
    told(tables, mechanism, SHIFT, f"{shift:.2f} ± {error:.2f}", "5")
    assert shift == pytest.approx(5, abs=0.3), (shift, error)


def sparse_shift(pixels, share, mean, draw, log_likelihood, each=3000):
    """Shift of the sum over pixels of log(1 - f + f L), f the share, L the likelihood ratio averaged over the
    heights. draw: data of pixels of these heights; log_likelihood: of data at one height, over that at none.

    Quiet pixels that look affected decide, and are too rare to be drawn as such: pixels of every height are
    drawn alike and weighted by how likely their data are without, or with, the effect.
    """
    rng = np.random.default_rng(1)
    heights = (np.arange(70) + 0.5) / 70 * 14 * mean
    weights = np.exp(-heights / mean)
    weights /= weights.sum()
    data = draw(rng, np.concatenate([np.zeros(20 * each), np.repeat(heights, each)]))
    ratios = np.exp(np.minimum([log_likelihood(data, h) for h in heights], 600))
    drawn = (20 + ratios.sum(0)) / 90
    quiet, affected = 1 / drawn, weights @ ratios / drawn
    value = np.log1p(share * (weights @ ratios - 1))
    value -= np.average(value, weights=quiet)
    if data.ndim > 1:  # the read noise is fitted too
        squares = np.sum(data**2 - 1, axis=1)
        value -= squares * np.average(value * squares, weights=quiet) / np.average(squares**2, weights=quiet)
    change = np.average(value, weights=affected) - np.average(value, weights=quiet)
    return np.sqrt(pixels / np.average(value**2, weights=quiet)) * share * change


def test_few_hot_pixels_shift_their_likelihood_ratio_by_five():
    amplitude = hot_amplitude(np.full((96, 128), 0.7), 5.0)
    mean = amplitude / np.sqrt(2 * HOT_SHARE) * np.sqrt(0.7)
    shift = sparse_shift(
        96 * 128,
        HOT_SHARE,
        mean,
        lambda rng, height: height + rng.standard_normal(height.size),
        lambda u, h: u * h - h**2 / 2,
    )
    assert shift == pytest.approx(5, abs=0.3)
    dense = (2 * 5**2 / (96 * 128)) ** 0.25 / np.sqrt(0.7)
    assert amplitude < 0.4 * dense  # a map of as much rms in every pixel is seen far later


@pytest.mark.parametrize("frames", [8, pytest.param(16, marks=pytest.mark.slow)])
def test_few_telegraph_pixels_shift_their_likelihood_ratio_by_five(frames):
    noise = 2.0
    amplitude = telegraph_amplitude([(1 / noise**2, frames), (0.0, 4)], 96 * 128, 5.0)
    mean = amplitude / noise / np.sqrt(TELEGRAPH_SHARE)

    def draw(rng, height):
        size = (height.size, frames)
        return rng.standard_normal(size) + height[:, None] * rng.choice((-1, 0, 0, 1), size)

    def log_likelihood(z, h):
        return np.sum(np.log(0.5 + 0.5 * np.cosh(h * z) * np.exp(-(h**2) / 2)), axis=1)

    shift = sparse_shift(96 * 128, TELEGRAPH_SHARE, mean, draw, log_likelihood, 600)
    assert shift == pytest.approx(5, abs=0.3)


@pytest.mark.parametrize("mechanism", ["hot_pixels", pytest.param("rts", marks=pytest.mark.slow)])
def test_sparse_effects_stand_on_the_frames_that_show_them(mechanism):
    darks = capture_set(5, size=SIZE, gain=GAIN, read=READ, black=BLACK, kinds="d")
    more = capture_set(5, size=SIZE, gain=GAIN, read=READ, black=BLACK, kinds="d", frames=32)
    few, many = mde(mechanism, darks), mde(mechanism, more)
    assert few and many and limit(mechanism) < 1.02 * few
    # Four times the frames: a height is known twice as well, and one that jumps nearly so.
    assert many / few == pytest.approx(0.5 if mechanism == "hot_pixels" else 0.6, abs=0.12)


def test_a_multiple_multiplies_the_shift_and_not_the_amplitude():
    assert mde("row_noise", plan(), 4.0) == pytest.approx(2 * limit("row_noise"))
    assert mde("channel_offset", plan(), 4.0) == pytest.approx(4 * limit("channel_offset"))
    assert limit("rts") < mde("rts", plan(), 4.0) < 4 * limit("rts")


def test_a_level_or_a_period_has_no_strength_and_what_nothing_shows_no_limit():
    for mechanism in ("missing_codes", "quantization", "saturation", "black_clipping"):
        assert mde(mechanism, plan()) is None
    assert mde("prnu", capture_set(5, size=SIZE, kinds="d")) is None
    flats = capture_set(5, size=SIZE, kinds="f")
    assert mde("green_imbalance", flats) is None and mde("lens_shading", flats) is None


def few_hot(amplitude):
    """Hot pixels, exponential in strength, growing with the exposure; rms DN at the longest."""

    def alter(rng):
        heat = (rng.random((96, 128)) < HOT_SHARE) * rng.exponential(size=(96, 128))
        heat *= amplitude / np.sqrt(np.mean(heat**2))
        return lambda dn, signal, kind, t: dn + heat * t / LONGEST

    return alter


def few_telegraph(amplitude):
    """Pixels that jump up, down or not at all; rms DN."""

    def alter(rng):
        height = (rng.random((96, 128)) < TELEGRAPH_SHARE) * rng.exponential(size=(96, 128))
        height *= amplitude / np.sqrt(np.mean(height**2) / 2)
        return lambda dn, signal, kind, t: dn + height * rng.choice((-1, 0, 0, 1), dn.shape)

    return alter


def interference(amplitude):
    """A wave of one frequency along the scan, its phase new in every frame."""

    def alter(rng):
        turns = rng.uniform(0.002, 0.45) * np.arange(96 * 128).reshape(96, 128)
        return lambda dn, signal, kind, t: dn + amplitude * np.sin(2 * np.pi * (turns + rng.random()))

    return alter


@cache
def nothing_found():
    return diagnose(capture_set(0, kinds="d"), compare=False)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mechanism", "effect"),
    [
        ("hot_pixels", few_hot),
        pytest.param("rts", few_telegraph, marks=pytest.mark.slow),
        pytest.param("banding", interference, marks=pytest.mark.slow),
    ],
)
def test_the_smallest_detectable_effect_is_found_half_of_the_time(mechanism, effect, tables):
    quiet = nothing_found()
    found = detectable(quiet, mechanism)
    assert found is not None
    # All frames together, at the share of the error rate that they have.
    rare = 1.0 if mechanism == "banding" else SHARED.rare
    level = np.log(quiet.alpha * SHARED.together * rare / quiet.fitted.first.tests)

    def share(amplitude, sets=12):
        seen = 0
        for seed in range(sets):
            capture = capture_set(seed, effect(amplitude), kinds="d")
            prepared = prepare(capture, [list(range(r.count)) for r in capture.recordings], False)
            signatures = [p for p in prepared.signatures if p.mechanism == mechanism]
            seen += min(p.score(prepared.fields).log_p for p in signatures) < level
        return seen / sets

    assert share(0.6 * found[0]) <= 0.25
    half = share(found[0])
    told(tables, mechanism, "share of 12 sets in which it is found", f"{half:.2f}", "0.5")
    assert 0.2 <= half <= 0.8
    assert share(1.6 * found[0]) >= 0.85
