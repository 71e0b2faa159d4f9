"""Maps and spectra as few recordings show them: what is added has the power that is missing, no more."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.compare.patterns import Mean, Pattern, combined, mean_of, missing
from cannoise_jax.discovery.compare.shapes import LIKELY, smooth
from cannoise_jax.signatures.fields import helmert

SIZE = (160, 192)


def pattern_of(recorded, simulated, noise, simulated_noise):
    """Means of which the white noise is known."""

    def mean(values, variance):
        return Mean(values, np.full(SIZE, variance), np.full(SIZE, variance), 1e6)

    return Pattern(mean(recorded, noise), mean(simulated, simulated_noise))


@pytest.mark.parametrize("alike", [0.0, 0.7, 1.0])
@pytest.mark.parametrize("noise", [0.1, 4.0])
def test_the_pattern_has_the_recorded_power_whatever_the_simulator_had(alike, noise):
    """noise: of the recorded mean over the pattern's variance. A simulator that draws a pattern of the right
    strength, of another unit or of this one, needs nothing more than to be turned into this one."""
    rng = np.random.default_rng(int(10 * alike) + int(noise))
    true, other = rng.standard_normal((2, *SIZE))
    drawn = alike * true + np.sqrt(1 - alike**2) * other
    recorded = true + np.sqrt(noise) * rng.standard_normal(SIZE)
    simulated = drawn + np.sqrt(noise / 2) * rng.standard_normal(SIZE)
    together = drawn + missing(pattern_of(recorded, simulated, noise, noise / 2), 1)
    assert np.var(together) == pytest.approx(1.0, abs=0.1)
    nearer = np.corrcoef(together.ravel(), true.ravel())[0, 1]
    assert nearer > max(alike, 1 / (1 + 1.5 * noise)) - 0.05


def test_a_pattern_that_the_simulator_lacks_is_added_whole():
    rng = np.random.default_rng(5)
    true = rng.standard_normal(SIZE)
    recorded = true + rng.standard_normal(SIZE)
    added = missing(pattern_of(recorded, np.zeros(SIZE), 1.0, 0.0), 1)
    assert np.var(added) == pytest.approx(1.0, abs=0.05)
    assert np.corrcoef(added.ravel(), true.ravel())[0, 1] == pytest.approx(0.5, abs=0.03)


def test_pixels_that_stand_out_are_kept_whatever_the_level():
    rng = np.random.default_rng(11)
    hot = rng.random(SIZE) < 0.01
    recorded = 30 + rng.standard_normal(SIZE) + 20.0 * hot
    added = missing(pattern_of(recorded, np.zeros(SIZE), 1.0, 0.0), 1)
    assert np.allclose(added[hot], recorded[hot])
    assert np.std(added[~hot]) < 0.2


@pytest.mark.parametrize("alike", [0.0, 0.8])
def test_what_the_simulator_has_too_much_of_is_taken_out(alike):
    rng = np.random.default_rng(9)
    true, other = rng.standard_normal((2, *SIZE))
    drawn = 1.5 * (alike * true + np.sqrt(1 - alike**2) * other)
    recorded, simulated = (p + 0.5 * rng.standard_normal(SIZE) for p in (true, drawn))
    together = drawn + missing(pattern_of(recorded, simulated, 0.25, 0.25), 1)
    # Noise of both means comes through: with 2.25 of another pattern, some 0.2 of it.
    assert np.var(together) == pytest.approx(1.0, abs=0.2)
    assert np.corrcoef(together.ravel(), true.ravel())[0, 1] > 0.8


def spectrum_of(rng, frames, lines):
    """Mean periodogram of white noise of variance one with waves along the rows, new phases in every row."""
    h, w = SIZE
    x, power = np.arange(w), np.zeros(SIZE)
    for _ in range(frames):
        noise = rng.standard_normal(SIZE)
        for frequency, amplitude in lines:
            noise += amplitude * np.sqrt(2) * np.cos(2 * np.pi * (frequency * x / w + rng.random((h, 1))))
        power += np.abs(np.fft.fft2(noise)) ** 2 / (frames * h * w)
    return power


def test_waves_along_rows_of_a_new_phase_in_each_stay_sharp_and_the_variance_is_kept():
    rng = np.random.default_rng(7)
    lines = ((40, 0.12), (71, 0.1))
    power = spectrum_of(rng, 9, lines)
    out = smooth(power - 0.9, 9, 0.9, LIKELY)
    assert np.mean(out) == pytest.approx(np.mean(power - 0.9), abs=0.004)
    along = out[1:].mean(0)
    for frequency, amplitude in lines:
        assert along[frequency] - along[frequency + 3] == pytest.approx(amplitude**2 * SIZE[1] / 2, rel=0.25)
        assert abs(along[frequency + 2] - along[frequency + 5]) < 0.1 * along[frequency]


def test_white_noise_stays_white():
    power = spectrum_of(np.random.default_rng(8), 9, ())
    out = smooth(power - 0.5, 9, 0.5, LIKELY)
    assert np.std(out[1:, 1:]) < 0.05
    assert np.mean(out) == pytest.approx(0.5, abs=0.01)


def frames_of(rng, fixed, frames, colour=None, columns=None, waves=0.0):
    """Frames of a fixed pattern under noise that is redrawn: by its spectrum, with columns noisier than
    others, and a wave of another phase in each."""
    out = rng.standard_normal((frames, *SIZE))
    if columns is not None:
        out *= columns
    if colour is not None:
        out = np.fft.ifft2(np.fft.fft2(out) * np.sqrt(colour)).real
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    phase = 2 * np.pi * rng.random((frames, 1, 1))
    return fixed + out + waves * np.cos(2 * np.pi * (0.0713 * y + 0.311 * x) + phase)


def pattern_beside_nothing(frames):
    values = mean_of(
        frames.mean(0), np.tensordot(helmert(len(frames)), frames, 1), np.ones(SIZE, bool), len(frames), 1.0
    )
    return Pattern(values, Mean(np.zeros(SIZE), np.zeros(SIZE), np.zeros(SIZE), 1e6))


def hump():
    """Waves of some twelve pixels along rows: half of the variance."""
    away = np.abs(np.abs(np.fft.fftfreq(SIZE[1])) - 0.083)
    shape = np.exp(-((away / 0.012) ** 2) / 2)
    return np.broadcast_to(0.5 + 0.5 * shape / shape.mean(), SIZE)


def speckle():
    """Grains of 1.6 pixels."""
    y, x = np.meshgrid(np.fft.fftfreq(SIZE[0]), np.fft.fftfreq(SIZE[1]), indexing="ij")
    shape = np.exp(-((2 * np.pi * 1.6) ** 2) * (x**2 + y**2))
    return 0.3 + 0.7 * shape / shape.mean()


NOISY = np.where(np.arange(SIZE[1]) % 14 == 5, 2.5, 1.0)
REDRAWN = {
    "waves that wander": {"colour": hump()},
    "speckle": {"colour": speckle()},
    "columns with a noise of their own": {"columns": NOISY},
    "one wave": {"waves": 0.7},
}


@pytest.mark.parametrize("noise", REDRAWN)
def test_noise_that_is_redrawn_leaves_no_fixed_pattern(noise):
    frames = frames_of(np.random.default_rng(21), np.zeros(SIZE), 9, **REDRAWN[noise])
    added = missing(pattern_beside_nothing(frames), 1)
    # Chance lines and frequencies of the mean, of which the noise is a third.
    assert np.std(added) < 0.08


@pytest.mark.parametrize("noise", REDRAWN)
@pytest.mark.parametrize("kind", ["pixels", "rows", "hot", "one wave"])
def test_a_fixed_pattern_keeps_its_strength_under_noise_that_is_redrawn(noise, kind):
    rng = np.random.default_rng(22)
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    true = {
        "pixels": 0.4 * rng.standard_normal(SIZE),
        "rows": 0.4 * rng.standard_normal((SIZE[0], 1)) * np.ones(SIZE),
        "hot": 30.0 * (rng.random(SIZE) < 0.002),
        "one wave": 0.3 * np.cos(2 * np.pi * (20 * x / SIZE[1] + 11 * y / SIZE[0])),
    }[kind]
    added = missing(pattern_beside_nothing(frames_of(rng, true, 9, **REDRAWN[noise])), 1)
    assert np.std(added) == pytest.approx(np.std(true), rel=0.1)


def test_one_wave_is_counted_once():
    """Not in its broad shape, its row and its column besides."""
    rng = np.random.default_rng(23)
    frames = frames_of(rng, np.zeros(SIZE), 12, waves=2.0)
    power = np.mean(np.abs(np.fft.fft2(frames)) ** 2, 0) / np.prod(SIZE)
    out = smooth(power - 0.9, 12, 0.9, LIKELY)
    assert np.mean(out) == pytest.approx(np.mean(power - 0.9), abs=0.05)


def test_pixels_that_stand_still_have_a_mean_as_any():
    """Noise far below a code: one pixel in 150 moves, and no other."""
    rng = np.random.default_rng(8)
    moves = rng.random((48, 64)) < 1 / 150
    contrasts = np.rint(5 * rng.standard_normal((3, 48, 64))) * moves
    one = mean_of(np.zeros((48, 64)), contrasts, np.ones((48, 64), bool), 4, 1e-6)
    assert one.noise > 0 and combined((one, one), np.array([1.0, -1.0])).contrasts >= 1
    assert np.isfinite(missing(Pattern(one, one), 1)).all()
