"""The shape of the dark noise of few frames: chance taken out."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.shape import lamp_notes, shape_quantities
from cannoise_jax.recordings.recording import Recording, per_channel

SIGMA = 6.0


def shapes(frames, noisy=0.0, seed=0):
    """Quantities of a dark in which a share of the pixels is four times as noisy."""
    rng = np.random.default_rng(seed)
    sigma = np.where(rng.random((128, 192)) < noisy, 4.0, 1.0) * SIGMA
    codes = np.rint(200 + sigma * rng.normal(size=(frames, 128, 192))).astype(np.uint16)
    dark = Recording(codes, "RGGB", per_channel(200.0), 4095.0, kind="dark")
    return {q.name: q.outcome for q in shape_quantities(frame_statistics(dark))}


@pytest.mark.parametrize("frames", [3, 4, 8, 32])
def test_few_frames_do_not_bias_the_typical_noise(frames):
    found = shapes(frames)["typical pixel noise"]
    truth = np.sqrt(SIGMA**2 + 1 / 12)
    assert abs(found.value - truth) < 4 * found.stderr < 0.02 * truth


@pytest.mark.parametrize("frames", [3, 4, 8, 32])
def test_chance_makes_no_noisy_pixels(frames):
    found = shapes(frames)
    for factor in (2, 3):
        share = found[f"pixels above {factor} x typical"]
        assert share.value <= 4 * share.stderr + 1e-9 and share.ci90[0] <= 0.05
        assert share.value < 0.3


def test_noisy_pixels_are_counted():
    share = shapes(16, noisy=0.03)["pixels above 2 x typical"]
    assert share.value == pytest.approx(3.0, rel=0.1)


def test_the_light_of_a_flat_that_shows_none_is_not_said_to_move():
    rng, said = np.random.default_rng(3), {}
    for level in (-1.0, 900.0):
        light = np.maximum(level, 0.0) * (1 + 0.1 * (np.arange(4) == 0))[:, None, None]
        codes = np.rint(200 + min(level, 0.0) + light + SIGMA * rng.normal(size=(4, 64, 96)))
        flat = Recording(codes.astype(np.uint16), "RGGB", per_channel(200.0), 4095.0, kind="flat")
        said[level] = lamp_notes([frame_statistics(flat)])
    assert said[-1.0] == [] and "frame 1 is +10.0 %" in said[900.0][0]
