"""A noise of each pixel's own is there in all frames; pixels that are hit are noisy in one."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.discovery.proof.white_maps import noisy_again
from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE = (128, 160)


def doubt(factor, hits, seed):
    """What speaks against the map of noise of two darks. factor: of the noise of every pixel; hits: share of
    the values that are hit."""
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
    assert score.log_p < -20
    named = SimpleNamespace(mechanism=signature.mechanism, signature=signature, score=score)
    return noisy_again(SimpleNamespace(before=prepared.fields, named=named))


@pytest.mark.parametrize("seed", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 2))])
def test_hits_are_no_map_of_noise_and_a_map_is(seed):
    assert doubt(np.random.default_rng(seed).lognormal(0, 0.2, SIZE), 0.0, seed) is None
    found = doubt(np.ones(SIZE), 2e-3, seed)
    assert found is not None and "in some frames and in others" in found.against[0]
