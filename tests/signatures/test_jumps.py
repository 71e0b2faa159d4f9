"""Pixels that jump are told from pixels that merely have more noise."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.recordings.recording import CaptureSet, Recording
from cannoise_jax.signatures.jumps import jumps_over_noise, merely_noisy
from cannoise_jax.signatures.squares import square_map

SIZE = (96, 128)
_RNG = np.random.default_rng


def noisy(rng, size):
    """Normal noise of another strength in every pixel."""
    return rng.lognormal(-0.05, 0.3, size[1:]) * rng.standard_normal(size)


def jumping(rng, size, traps=1):
    """Some pixels with a trap, or two, that is full in a share of the frames of its own."""
    share = rng.uniform(0.1, 0.9, size[1:]) * (rng.random(size[1:]) < 0.03)
    full = sum((rng.random(size) < share) for _ in range(traps))
    return rng.standard_normal(size) + rng.exponential(5.0, size[1:]) * full


def darks(draw, seed, frames=(8, 16)):
    rng = _RNG(seed)
    codes = [np.round(200 + 4 * draw(rng, (n, *SIZE))).astype(np.uint16) for n in frames]
    shots = zip(codes, (0.0, 10.0), strict=True)
    return [Recording(c, "MONO", (200.0,) * 4, 4095.0, kind="dark", exposure_s=s) for c, s in shots]


def answer(draw, seed, frames=(8, 16)):
    capture = CaptureSet("camera", tuple(darks(draw, seed, frames)))
    fields = prepare(capture, all_frames(split_recordings(capture)), False).fields
    return merely_noisy(fields, *square_map(fields))


@pytest.mark.parametrize("frames", [(8, 16), pytest.param((10, 10), marks=pytest.mark.slow), (6, 30)])
def test_noise_of_each_pixels_own_is_no_jump_and_jumps_are_none(frames):
    for seed in range(3):
        assert answer(noisy, seed, frames)
        assert not answer(jumping, seed, frames)


def test_pixels_of_two_traps_jump():
    assert not answer(lambda rng, size: jumping(rng, size, traps=2), 1)


def test_where_no_pixel_is_noisy_nothing_is_told():
    assert not answer(lambda rng, size: rng.standard_normal(size), 1)


def test_the_answer_does_not_depend_on_how_noisy_the_pixels_are():
    """Normal pixels look like jumping ones as often whatever their noise, and those of two levels the more
    often the farther these are apart."""
    rng, shares, found = _RNG(0), [], []
    for scale in (1.8, 2.5, 4.0):
        normal = [scale * rng.standard_normal((n, 800)) for n in (8, 16)]
        shares.append(np.mean(jumps_over_noise([x - x.mean(0) for x in normal]) > 0))
        levels = [rng.standard_normal((n, 800)) + 2 * scale * (rng.random((n, 800)) < 0.5) for n in (8, 16)]
        found.append(np.mean(jumps_over_noise([x - x.mean(0) for x in levels]) > 0))
    assert max(shares) < 0.15 and found == sorted(found) and found[-1] > 0.95
