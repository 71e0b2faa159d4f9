"""Lines of the spectrum beside coloured noise, and what taking one out leaves alone."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.discovery.search.fit import stepwise
from cannoise_jax.discovery.search.model import extended_model
from cannoise_jax.physics.core.sensor import Settings
from cannoise_jax.signatures.fields import helmert
from cannoise_jax.signatures.phasors import about_centre
from cannoise_jax.signatures.wave_fields import wave_absorb
from cannoise_jax.signatures.wave_shares import of_all
from cannoise_jax.signatures.waves import wave_score
from tests.discovery.capture import capture_set
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
    (left,) = wave_absorb((field,), score, stays=False)
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


def test_a_strong_slanted_wave_is_found_first_and_wholly_and_drawn_as_it_was():
    """Of twice the read noise, on which all that compares neighbours bears as well."""
    down, across, amplitude, read = -0.113, 0.2071, 9.0, 4.5
    y, x = np.indices(SIZE)

    def alter(rng):
        return lambda dn, *_: dn + amplitude * np.cos(2 * np.pi * (down * y + across * x + rng.uniform()))

    capture = capture_set(21, alter, kinds="df", size=SIZE, frames=12)
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    names = ("wave_redrawn", "lags_any", "lags_read", "lags_demosaicing", "warm", "wave_redrawn_2")
    looks = tuple(s for s in prepared.signatures if s.name in names)
    found = stepwise(prepared.fields, looks, frozenset({"banding", "demosaicing"}), np.log(0.01))
    assert [s.named.signature.name for s in found.steps] == ["wave_redrawn"]
    model = extended_model(capture, prepared, found.steps)
    (wave,) = model.mechanisms
    told = {name: float(value) for name, value in wave.parameters.items()}
    reported = found.steps[0].named.score.parameters
    for name, truth in (("frequency_y", down), ("frequency_x", across)):
        assert told[name] == pytest.approx(reported[name][0], abs=1e-6)
        assert told[name] == pytest.approx(truth, abs=3e-4)
    assert told["amplitude_dn"] == pytest.approx(amplitude, rel=0.01)
    assert np.mean(model.read_noise_e * model.gain_dn_per_e) == pytest.approx(read, rel=0.01)
    dark = np.asarray(model.sample(jax.random.key(3), np.zeros(SIZE), Settings(frames=12)), float)
    turn = np.exp(-2j * np.pi * (down * y + across * x))
    drawn = 2 * np.abs(np.mean((dark - dark.mean((1, 2), keepdims=True)) * turn, (1, 2)))
    assert drawn == pytest.approx(amplitude, abs=0.4)


def test_a_wave_has_its_strength_whatever_the_phases_of_a_few_frames_are():
    phases = np.exp(2j * np.pi * np.array([0.02, 0.1, 0.17, 0.3, 0.33, 0.41]))  # of half of the circle
    seen = 3.0 * (phases - phases.mean())
    assert np.abs(about_centre(seen)) == pytest.approx(3.0)


def test_lines_are_most_of_what_is_alike_and_broad_noise_is_no_line():
    rng = _RNG(5)
    power = rng.gamma(10, 0.1, (128, 97))
    line = power.copy()
    line[20:23, 30:33] += 4000.0
    assert of_all(line, (21, 31), 10) > 0.9
    fy, fx = np.fft.fftfreq(128)[:, None], np.arange(97) / 192
    broad = power * (1 + 20 * np.exp(-((fy - 0.15) ** 2 + (fx - 0.2) ** 2) / 0.002))
    at = np.unravel_index(int(np.argmax(broad)), broad.shape)
    assert of_all(broad, (int(at[0]), int(at[1])), 10) < 0.3


def test_a_wave_of_new_phases_leaves_steps_between_regions_and_nothing_that_stays():
    """A step has a share of every wave: taken out with that, it would come back as one once it is found."""
    (field,) = white(_RNG(9), kinds=("dark",), frames=8, size=SIZE)
    x = np.arange(SIZE[1])
    frames = 1.2 * np.cos(2 * np.pi * 0.137 * x + 2 * np.pi * _RNG(10).random((8, 1, 1))) / 3.0
    step = 4.0 * np.sign(x - SIZE[1] / 2 + 0.5) / 3.0
    seen = np.tensordot(helmert(8), frames, 1) + field.contrasts
    whole = field.static + np.sqrt(8) * (frames.mean(0) + step)
    field = field._replace(contrasts=seen.astype(np.float32), static=whole.astype(np.float32))
    frozen, taps = SIGNATURES["wave_frozen"], SIGNATURES["taps"]
    assert frozen.score((field,)).log_p < -7
    moved = wave_score((field,), time="redrawn")
    assert moved.parameters["amplitude"][0] == pytest.approx(1.2, rel=0.1)
    left = wave_absorb((field,), moved, stays=False)
    steps = taps.score(left)
    assert steps.amplitude == pytest.approx(8.0, rel=0.02)
    again = frozen.again(taps.absorb(left, steps), moved)
    assert again is None or again.log_p > -3
    # What stays is in no contrast: one that stays takes no evidence from one that does not.
    assert wave_score(wave_absorb((field,), moved, stays=True), time="redrawn").log_p == moved.log_p


def test_a_wave_along_the_rows_is_found_again_whichever_way_it_seems_to_run():
    y = np.arange(SIZE[0])[:, None]
    found = []
    for seed in range(6):
        (field,) = white(_RNG([11, seed]), kinds=("dark",), frames=6, size=SIZE)
        phase = 2 * np.pi * _RNG([12, seed]).random((5, 1, 1))
        wave = 0.9 * np.cos(2 * np.pi * 0.083 * y + phase) / 3.0
        field = field._replace(contrasts=(field.contrasts + wave).astype(np.float32))
        found.append(wave_score((field,), time="redrawn"))
    signs = {np.sign(s.parameters["frequency_y"][0]) for s in found}
    assert signs == {-1.0, 1.0}
    assert all(found[0].same_spot(s) for s in found)
