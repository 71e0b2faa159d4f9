"""A noise of each pixel's own is there in all frames; pixels that are hit are noisy in one."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.discovery.proof.shared_noise import shared_map
from cannoise_jax.discovery.proof.white_maps import noisy_again
from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE = (128, 160)


def doubt(factor, hits, seed, against=noisy_again, surely=True):
    """What speaks `against` the map of noise of two darks. factor: of the noise of every pixel; hits:
    share of the values that are hit."""
    rng = np.random.default_rng(seed)
    shots = []
    for seconds in (0.0, 10.0):
        size = (12, *SIZE)
        values = factor * rng.standard_normal(size) + (rng.random(size) < hits) * rng.exponential(4.0, size)
        codes = np.round(200 + 4 * values).astype(np.uint16)
        shots.append(Recording(codes, "MONO", (200.0,) * 4, 4095.0, kind="dark", exposure_s=seconds))
    capture = CaptureSet("camera", tuple(shots))
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    (signature,) = [s for s in prepared.signatures if s.name == "pixel_spread"]
    score = signature.score(prepared.fields)
    assert score.log_p < -20 or not surely
    named = SimpleNamespace(mechanism=signature.mechanism, signature=signature, score=score)
    return against(SimpleNamespace(before=prepared.fields, named=named))


@pytest.mark.parametrize("seed", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 2))])
def test_hits_are_no_map_of_noise_and_a_map_is(seed):
    assert doubt(np.random.default_rng(seed).lognormal(0, 0.2, SIZE), 0.0, seed) is None
    found = doubt(np.ones(SIZE), 2e-3, seed)
    assert found is not None and "in some frames and in others" in found.against[0]


def test_noise_that_is_stronger_in_parts_of_the_frame_is_no_map_of_single_pixels():
    rng, (y, x) = np.random.default_rng(5), np.indices(SIZE)
    spot = np.exp(-((y - 40) ** 2 + (x - 90) ** 2) / 2 / 20**2)
    alone = rng.lognormal(0, 0.2, SIZE)
    lines = rng.lognormal(0, 0.1, (1, SIZE[1]))
    for factor in (alone, alone * (1 + 0.1 * spot), alone * lines):
        assert doubt(factor, 0.0, 5, shared_map) is None
    for factor in (1 + 0.25 * spot, 1 + 0.1 * np.sin(x / 6 + y / 9)):
        found = doubt(factor, 0.0, 5, shared_map, surely=False)
        assert found is not None and found.left > 0.6
