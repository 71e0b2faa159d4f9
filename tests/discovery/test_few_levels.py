"""Three levels of light show that the variance is no straight line; straight ones do not."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.recordings.recording import CaptureSet
from tests.discovery.capture import capture_set


def louder(share):
    """Noise of a share of the signal's own, above 2,000 DN."""

    def alter(rng):
        def change(dn, signal, *_):
            extra = np.sqrt(share * 1.5 * signal) * (signal > 2000)
            return dn + extra * rng.standard_normal(dn.shape)

        return change

    return alter


def curve_of(alter, seed):
    given = capture_set(seed, alter, kinds="df")
    kept = (*given.recordings[:2], *given.recordings[2::2], given.recordings[-1])  # darks, three flats
    capture = CaptureSet(given.camera, kept)
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    (signature,) = (s for s in prepared.signatures if s.axes.law == "variance curve")
    return signature.score(prepared.fields)


@pytest.mark.parametrize("share", [0.1, pytest.param(0.3, marks=pytest.mark.slow)])
def test_a_variance_that_leaves_the_line_is_found(share):
    score = curve_of(louder(share), 5)
    assert score is not None and score.log_p < np.log(1e-8)
    assert 0.1 * share < score.amplitude < share


def test_straight_lines_of_three_levels_are_straight():
    # One level for each: fewer cameras make it no easier.
    log_p = [curve_of(None, seed).log_p for seed in range(2)]
    assert min(log_p) > np.log(1e-3)
