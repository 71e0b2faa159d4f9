"""Maps and spectra as few recordings show them: what is added has the power that is missing, no more."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.compare.patterns import Mean, Pattern, mean_of, missing
from cannoise_jax.discovery.compare.shapes import LIKELY, smooth

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
