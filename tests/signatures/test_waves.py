"""Lines of the spectrum beside coloured noise, and what taking one out leaves alone."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.search.fit import stepwise
from cannoise_jax.signatures.waves import wave_absorb, wave_score
from tests.discovery.looks import SIGNATURES, white

SIZE = (64, 96)
_RNG = np.random.default_rng


def coloured(rng, count, exponent):
    """Noise of power 1 / f ** exponent over white noise of unit power."""
    f = np.hypot(np.fft.fftfreq(SIZE[0])[:, None], np.fft.fftfreq(SIZE[1]))
    f[0, 0] = 1.0
    gain = np.sqrt(1 + (0.08 / f) ** exponent)
    gain[0, 0] = 1.0
    spectrum = np.fft.fft2(rng.standard_normal((count, *SIZE)))
    return np.real(np.fft.ifft2(gain * spectrum)).astype(np.float32)


@pytest.mark.parametrize("time", ["redrawn", "frozen"])
def test_noise_stronger_at_low_frequencies_is_no_line(time):
    p = []
    for seed in range(12):
        fields = tuple(
            f._replace(contrasts=coloured(_RNG(seed), 5, 1.0), static=coloured(_RNG(50 + seed), 1, 1.0)[0])
            for f in white(_RNG(seed), kinds=("dark",), frames=6, size=SIZE)
        )
        p.append(wave_score(fields, time=time).log_p)
    assert np.median(p) > -4 and min(p) > -12


@pytest.mark.parametrize("amplitude", [0.3, 1.5, 6.0])
def test_a_wave_that_stays_has_its_strength_whatever_it_is(amplitude):
    """A strong one is most of what stays in a field, by which the powers are divided."""
    y, x = np.indices(SIZE)
    wave = amplitude * np.cos(2 * np.pi * (0.125 * y + 0.25 * x) + 1.0)
    scores = []
    for seed in range(20):
        fields = tuple(
            f._replace(static=(f.static + np.sqrt(f.frames) * wave * f.weight).astype(np.float32))
            for f in white(_RNG(seed), kinds=("dark", "dark"), frames=6, size=SIZE)
        )
        scores.append(wave_score(fields, time="frozen"))
    found, error = np.mean([s.amplitude for s in scores]), scores[0].error
    assert found == pytest.approx(amplitude, abs=4 * error / np.sqrt(len(scores)))
    least = 3.0 * np.sqrt(2 / (12 * SIZE[0] * SIZE[1]))
    assert 0.95 < error / least < 1.5  # side lobes of a strong one count as coloured noise


def test_a_line_stands_out_of_coloured_noise():
    (field,) = white(_RNG(1), kinds=("dark",), frames=6, size=SIZE)
    y, x = np.indices(SIZE)
    phase = 2 * np.pi * _RNG(2).random((5, 1, 1))
    line = 0.5 * np.cos(2 * np.pi * (7 * y / 64 + 3 * x / 96) + phase) / 3.0
    field = field._replace(contrasts=(coloured(_RNG(3), 5, 1.0) + line).astype(np.float32))
    score = wave_score((field,), time="redrawn")
    assert score.log_p < -7
    assert score.parameters["amplitude"][0] == pytest.approx(0.5, abs=4 * score.parameters["amplitude"][2])


def test_taking_a_wave_out_leaves_the_offsets_of_frames():
    (field,) = white(_RNG(4), kinds=("dark",), frames=6, size=SIZE)
    x = np.indices(SIZE)[1]
    wave = 0.6 * np.cos(2 * np.pi * x / SIZE[1])
    field = field._replace(contrasts=(field.contrasts + 0.3 + wave).astype(np.float32))
    score = wave_score((field,), time="redrawn")
    (left,) = wave_absorb((field,), score)
    assert left.contrasts.mean((1, 2)) == pytest.approx(field.contrasts.mean((1, 2)), abs=1e-3)
    told = [SIGNATURES["frame_additive"].score((f, f)).amplitude for f in (field, left)]
    assert told[1] == pytest.approx(told[0], rel=0.02)


@pytest.mark.parametrize("rows, first", [(0.2, True), (3.0, False)])
def test_a_line_that_is_most_of_what_rows_share_is_judged_before_them(rows, first):
    """Beside row noise of a fifth or of three times its strength."""
    (field,) = white(_RNG(6), kinds=("dark",), frames=8, size=SIZE)
    y = np.arange(SIZE[0])[:, None]
    phase = 2 * np.pi * _RNG(7).random((7, 1, 1))
    shared = 1.5 * np.cos(2 * np.pi * 9 * y / SIZE[0] + phase) + rows * _RNG(8).standard_normal(
        (7, SIZE[0], 1)
    )
    field = field._replace(contrasts=(field.contrasts + shared / 3.0).astype(np.float32))
    wave = SIGNATURES["wave_redrawn"]
    assert ("row_slope" in wave.before(wave.score((field,)))) == first


@pytest.mark.parametrize("frequencies", [(0.0833,), (0.0833, 0.3107), (0.0712, 0.1424, 0.2851)])
def test_as_many_lines_as_there_are_each_with_its_frequency_and_strength(frequencies):
    """Of equal strength, between points of any grid, beside white row noise."""
    (field,) = white(_RNG(11), kinds=("dark",), frames=9, size=SIZE)
    rng, y = _RNG(12), np.arange(SIZE[0])[:, None]
    shared = 0.1 * rng.standard_normal((8, SIZE[0], 1))
    for f in frequencies:
        shared = shared + 0.6 * np.cos(2 * np.pi * (f * y + rng.random((8, 1, 1))))
    field = field._replace(contrasts=(field.contrasts + shared / 3.0).astype(np.float32))
    names = ("wave_redrawn", "wave_redrawn_2", "wave_redrawn_3", "row_additive_temporal", "row_slope")
    found = stepwise((field,), tuple(SIGNATURES[n] for n in names), frozenset({"banding"}), np.log(0.01))
    waves = [s.named.score for s in found.steps if s.named.signature.kin == "wave"]
    assert len(waves) == len(frequencies)
    told = sorted((abs(w.parameters["frequency_y"][0]), w.amplitude) for w in waves)
    for (frequency, amplitude), f in zip(told, frequencies, strict=True):
        assert frequency == pytest.approx(f, abs=2e-3)
        assert amplitude == pytest.approx(0.6, abs=0.12)
