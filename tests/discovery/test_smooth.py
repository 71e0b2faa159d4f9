"""The smooth surface of a flat against plain least squares over all pixels at once."""

import dataclasses

import numpy as np
import pytest

from cannoise_jax.discovery.frames.contrasts import stack
from cannoise_jax.discovery.frames.smooth import START, surface_of
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import Recording
from cannoise_jax.signatures.fields import surfaces

SIZE = (60, 90)


def flat(rng: np.random.Generator, frames: int = 4) -> Recording:
    """A flat whose light leans and bends, by polynomials of no more than degree 4."""
    y, x = (np.linspace(-1, 1, n) for n in SIZE)
    light = 900 * (1 + 0.2 * x - 0.1 * y[:, None] - 0.2 * (x * y[:, None]) ** 2)
    drawn = rng.normal(100 + light, 4.0, (frames, *SIZE)).round().astype(np.uint16)
    return Recording(drawn, "MONO", (100.0,) * 4, 4095.0, "made up", "flat", exposure_s=0.01)


@pytest.mark.parametrize("left_out", [False, True])
def test_it_is_least_squares_over_all_pixels(left_out):
    rng = np.random.default_rng(3)
    recording = flat(rng)
    dust = None
    if left_out:
        dust = np.zeros(SIZE, bool)
        dust[20:30, 40:60] = True
        frames = np.asarray(recording.frames).copy()
        frames[:, dust] = 700
        recording = dataclasses.replace(recording, frames=frames)
    taken = stack(recording, 0, [0, 1, 2, 3], 1.0)
    told = surface_of(taken, dust)
    for c, at in enumerate(SITES):
        kept = np.ones(told[at].size, bool) if dust is None else ~dust[at].ravel()
        basis, values = surfaces(SIZE, START, c), taken.mean[at].ravel().astype(np.float64)
        expected = basis @ np.linalg.lstsq(basis[kept], values[kept], rcond=None)[0]
        np.testing.assert_allclose(told[at].ravel(), expected, atol=0.02)
