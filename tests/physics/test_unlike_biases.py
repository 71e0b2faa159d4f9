"""Biases that are no repeats of the darks, darks of two levels, light that moves and two amplifiers."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.physics.transfer.doubts import doubts
from cannoise_jax.physics.transfer.faults import faults
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.photon_transfer import channel_lines, photon_transfer
from cannoise_jax.physics.transfer.regions import uneven_halves
from cannoise_jax.physics.transfer.several_gains import several_gains
from cannoise_jax.physics.transfer.smoothed import moving
from cannoise_jax.physics.transfer.stated import levels_line
from cannoise_jax.physics.transfer.unlike_biases import unlike_biases
from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE, FRAMES, GAIN, READ, OFFSET = (64, 96), 8, 0.5, 6.0, 300.0


def stored(codes, kind, seconds):
    frames = np.rint(codes).clip(0, 65535).astype(np.uint16)
    return Recording(frames, "MONO", (OFFSET,) * 4, 65535.0, "c", kind, exposure_s=seconds, code_step=1.0)


def dark(seconds, rate=1.0, averaged=1, noise=READ, offset=OFFSET, clamped=False, seed=0):
    """Darks of e-/s, or biases of 0 s. clamped: the camera subtracts the level of the charge."""
    rng, shape = np.random.default_rng([seed, int(10 * seconds)]), (FRAMES, averaged, *SIZE)
    charge = rng.poisson(rate * seconds, shape) - clamped * rate * seconds
    codes = offset + GAIN * (charge + noise * rng.standard_normal(shape))
    return stored(codes.mean(1), "dark" if seconds else "bias", seconds or None)


def said(*recordings, gain=GAIN):
    return unlike_biases([frame_statistics(r) for r in recordings], gain)


@pytest.mark.parametrize("longer", [(1.0,), (1.0, 60.0), (1.0, 60.0, 300.0)])
def test_biases_that_are_averages_or_of_another_readout_are_said(longer):
    darks = [dark(t) for t in longer]
    for bias in (dark(0.0, averaged=4), dark(0.0, averaged=2), dark(0.0, noise=READ / 2)):
        assert "averages, or of another readout" in said(bias, *darks)
    assert not said(dark(0.0), *darks)


def test_dark_charge_is_no_other_readout():
    for rate in (0.0, 0.5, 5.0, 50.0):
        assert not said(dark(0.0, rate), dark(10.0, rate)), rate
        assert not said(dark(0.0, rate), dark(10.0, rate), dark(100.0, rate), gain=0.0), rate
        series = [dark(t, rate, clamped=True) for t in (0.0, 10.0, 100.0)]
        assert not said(*series), rate
    # Of two exposures a level that is subtracted looks the same: both are said.
    line = said(dark(0.0, 50.0, clamped=True), dark(10.0, 50.0, clamped=True))
    assert "or the camera subtracts the level" in line


def test_biases_of_another_offset_are_said():
    darks = [dark(t) for t in (1.0, 60.0)]
    assert "lie 100 DN above biases" in said(dark(0.0, offset=OFFSET - 100), *darks)
    assert not said(dark(0.0, offset=OFFSET - 1), *darks)
    assert not said(dark(0.0, 20.0), *(dark(t, 20.0) for t in (10.0, 60.0)))


def flat(light, shift=0.0, shape=None, seed=3):
    """A flat whose light has 10 % of waves, that `shift` moves from frame to frame by pixels."""
    rng, columns = np.random.default_rng(seed), np.arange(SIZE[1])
    wave = [0.1 * np.sin((columns + shift * rng.uniform(0, 40)) / 12) for _ in range(FRAMES)]
    charge = rng.poisson(light * (1 + np.stack(wave))[:, None], (FRAMES, *SIZE))
    return stored(OFFSET + GAIN * (charge + READ * rng.standard_normal((FRAMES, *SIZE))), "flat", 0.1)


def test_light_that_moves_under_the_flats_is_said_and_is_no_other_gain():
    still, moved = frame_statistics(flat(8000.0)), frame_statistics(flat(8000.0, shift=1.0))
    assert not moving(still) and "apart in the flats is alike" in moving(moved)
    (transfer,) = photon_transfer(CaptureSet("c", (dark(0.0), flat(8000.0, shift=1.0))))
    assert any("the light moves" in line and "gain is not to be trusted" in line for line in doubts(transfer))
    others = [frame_statistics(r) for r in (dark(0.0), flat(2000.0))]
    assert not several_gains([*others, moved])
    for last, said in ((moved, True), (still, False)):
        told = faults([*others, last], channel_lines([*others, last]))
        assert ("the light moves" in told.flats) == said and (told.flats in told.stated)


@pytest.mark.parametrize("axis", [0, 1])
def test_two_amplifiers_of_unlike_gains_are_said(axis):
    rng = np.random.default_rng(9)
    response = 1 + 0.01 * rng.standard_normal(SIZE) + 0.003 * rng.standard_normal(SIZE[1])
    response *= np.linspace(0.8, 1.1, SIZE[0])[:, None]
    half = np.ones(SIZE)
    np.moveaxis(half, axis, 0)[SIZE[axis] // 2 :] = 1.05
    for gains, steps in ((half, True), (np.ones(SIZE), False)):
        charge = rng.poisson(8000 * response * gains, (FRAMES, *SIZE))
        recordings = dark(0.0), stored(OFFSET + GAIN * charge, "flat", 0.1)
        found = faults([frame_statistics(r) for r in recordings])
        assert ("as of two amplifiers" in found.uneven) == steps
    assert uneven_halves(None, None) == ""


def test_darks_of_two_levels_are_said_and_an_offset_that_wanders_is_not():
    both = np.concatenate([dark(t, seed=n).frames for n, t in enumerate((60.0, 300.0))])
    said = levels_line([frame_statistics(stored(both, "dark", 60.0))])
    assert "8 of its 16 frames lie 120 DN above the others" in said
    steps = np.random.default_rng(2).normal(0, 20, (2 * FRAMES, 1, 1))
    assert not levels_line([frame_statistics(stored(both[:FRAMES].repeat(2, 0) + steps, "dark", 60.0))])
