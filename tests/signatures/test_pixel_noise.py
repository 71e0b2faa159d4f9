"""The read noise of every pixel is told beside noise that all pixels have more of in long darks, and pixels
far noisier than the others are as noisy as they are."""

from __future__ import annotations

import numpy as np

from cannoise_jax.discovery.frames.splits import prepare_split, split_recordings
from cannoise_jax.signatures.pixels import noise_factors
from tests.discovery.capture import SIZE, capture_set

SPREAD, LOUD = 0.3, 8.0


def test_draws_of_read_noise_have_its_law_and_its_loud_pixels():
    rng = np.random.default_rng(5)
    width = np.sqrt(np.log1p(SPREAD**2))
    truth = np.exp(width * rng.standard_normal(SIZE) - width**2)
    loud = rng.random(SIZE) < 0.01
    truth[loud] = LOUD

    def alter(rng):
        def change(dn, signal, kind, exposure):
            charge = rng.poisson(300 * exposure, SIZE) - 300 * exposure
            return dn + 4.5 * truth * rng.standard_normal(SIZE) + 1.5 * charge

        return change

    capture = capture_set(74, alter, kinds="df", read=0.1, frames=16)
    fields = prepare_split(capture, split_recordings(capture)).fields
    drawn = noise_factors(fields, SPREAD, np.random.default_rng(6))
    ratio = drawn[~loud] / np.median(drawn[~loud])
    own = truth[~loud] / np.median(truth[~loud])
    for q in (0.05, 0.2, 0.8, 0.95):
        assert abs(np.log(np.quantile(ratio, q) / np.quantile(own, q))) < 0.08, q
    assert abs(np.log(np.median(drawn[loud]) / np.median(drawn[~loud]) / (LOUD / np.median(truth)))) < 0.25
    assert np.corrcoef(np.log(ratio), np.log(own))[0, 1] > 0.45
