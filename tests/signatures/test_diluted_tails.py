"""Shot noise of dark charge, which has no tails, hides those of the read noise in long darks alone."""

import numpy as np
import pytest

from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.recordings.recording import CaptureSet, Recording
from cannoise_jax.signatures.shape import kurtosis_score

SIZE, GAIN, READ, BLACK = (96, 128), 1.2, 3.0, 300.0


def score(freedom, rate, seed=3):
    """Of darks of 0 to 40 s and a flat, in plain NumPy. freedom: of Student's t; None: normal noise."""
    rng, taken = np.random.default_rng(seed), []
    shots = (("bias", 0.0, 0.0), ("dark", 1.0, 0.0), ("dark", 8.0, 0.0), ("dark", 40.0, 0.0))
    for kind, seconds, light in (*shots, ("flat", 0.1, 2000.0)):
        size = (10, *SIZE)
        if freedom is None:
            read = rng.standard_normal(size)
        else:
            read = rng.standard_t(freedom, size) / np.sqrt(freedom / (freedom - 2))
        charge = rng.poisson(rate * seconds + light, size) + READ * read
        codes = np.clip(np.rint(BLACK + GAIN * charge), 0, 65535).astype(np.uint16)
        taken.append(Recording(codes, "MONO", (BLACK,) * 4, 65535.0, kind=kind, exposure_s=seconds))
    capture = CaptureSet("camera", tuple(taken))
    return kurtosis_score(prepare(capture, all_frames(split_recordings(capture)), False).fields)


@pytest.mark.parametrize("rate", [0.0, 1.0, 4.0])
def test_tails_of_the_read_noise_are_as_heavy_whatever_the_dark_charge(rate):
    """Student's t of six degrees of freedom has an excess kurtosis of 3, of which far values are cut off."""
    found = score(6, rate)
    assert found.log_p < -50 and found.amplitude == pytest.approx(score(6, 0.0).amplitude, rel=0.3)
    assert 1.4 < found.amplitude < 3.5


@pytest.mark.parametrize("rate", [0.0, 1.0, 4.0])
def test_dark_charge_has_no_tails(rate):
    assert score(None, rate).log_p > -7
