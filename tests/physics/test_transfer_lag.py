"""Charge that comes with the next frame, in plain NumPy: its share, and the gain without it."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.mechanisms import LISTED
from cannoise_jax.physics.transfer.estimate import Estimate, NotMeasurable
from cannoise_jax.physics.transfer.estimators.lag import _doubt, _seen, image_lag
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.model import find_mechanisms, sensor_model
from cannoise_jax.physics.transfer.photon_transfer import photon_transfer
from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE, GAIN, READ_E = (120, 160), 0.5, 6.0


def recordings(share=0.0, frames=8, averaged=0.0, binomial=False, drift=0.0, seed=0):
    """Biases and flats of two levels. share: of the charge that comes with the next frame, of each electron
    by itself where binomial; averaged: of a frame in the next, as stored; drift: of the light, per frame."""
    rng = np.random.default_rng(seed)
    out, across = [], np.linspace(-1, 1, SIZE[1])
    for kind, light in (("bias", 0.0), ("flat", 8000.0), ("flat", 20000.0)):
        lit = light * (1 + drift * np.arange(frames + 1)[:, None, None] * across)
        charge = rng.poisson(lit * np.ones(SIZE)).astype(float)
        late = rng.binomial(charge.astype(int), share) if binomial else share * charge
        charge = (charge - late)[1:] + late[:-1]
        codes = 500 + GAIN * (charge + READ_E * rng.standard_normal(charge.shape))
        for t in range(1, frames):
            codes[t] = (1 - averaged) * codes[t] + averaged * codes[t - 1]
        stored = np.rint(codes).astype(np.uint16)
        out.append(Recording(stored, "MONO", (500.0,) * 4, 65535.0, "c", kind, exposure_s=light / 1e4))
    return CaptureSet("c", tuple(out))


def lag(capture):
    return image_lag([frame_statistics(r) for r in capture.recordings])


@pytest.mark.parametrize(
    ("share", "frames"),
    [
        (0.03, 12),
        (0.2, 4),
        pytest.param(0.03, 4, marks=pytest.mark.slow),
        pytest.param(0.2, 12, marks=pytest.mark.slow),
    ],
)
def test_the_share_and_the_gain_without_it(share, frames):
    capture = recordings(share, frames)
    found = lag(capture)["fraction"]
    assert found.value == pytest.approx(share, abs=3.5 * found.stderr)
    transfers = photon_transfer(capture)
    assert np.mean(transfers[0].baseline.gain) < GAIN * ((1 - share) ** 2 + share**2) * 1.02
    findings = find_mechanisms(transfers[0].statistics, transfers[0].baseline, LISTED)
    model = sensor_model(transfers, findings)
    assert "image_lag" in {f.mechanism for f in model.mechanisms}
    assert np.mean(model.gain_dn_per_e) == pytest.approx(GAIN, rel=0.03)
    assert np.mean(model.read_noise_e) == pytest.approx(READ_E, rel=0.04)


def test_its_error_is_that_of_repeats():
    found = [lag(recordings(0.02, 5, seed=n))["fraction"] for n in range(12)]
    off = np.array([(e.value - 0.02) / e.stderr for e in found])
    assert abs(off.mean()) < 3 / 12**0.5 and 0.5 < off.std() < 1.6


@pytest.mark.parametrize("count", (3, 4, 7, 20))
def test_what_the_mean_of_the_frames_takes_is_that_of_the_matrices(count):
    following = np.eye(count, k=1) + np.eye(count, k=-1)
    others = 1 - np.eye(count) - following
    mean = np.eye(count) - 1 / count
    weights = mean @ (following / following.sum() - others / others.sum()) @ mean
    assert _seen(count) == pytest.approx(2 * np.trace(weights, 1))
    product = (1 - 1 / count) ** 2 * (1 + 2 / (count - 1) ** 2)
    assert _doubt(count) == pytest.approx(2 * np.sum(weights**2) / product)


def test_electrons_that_stay_one_by_one_leave_shot_noise_as_it_is():
    found = lag(recordings(0.05, binomial=True))["fraction"]
    assert abs(found.value) < 4 * found.stderr


def test_frames_averaged_over_time_are_no_lag():
    found = lag(recordings(averaged=0.1))
    assert isinstance(found, NotMeasurable) and "in darks as well" in found.record


@pytest.mark.parametrize("drift", (3e-4, 1e-3, 4e-3))
def test_light_that_drifts_is_no_lag(drift):
    found = lag(recordings(drift=drift))
    if isinstance(found, NotMeasurable):
        assert "the light moves" in found.record
    else:
        assert isinstance(found["fraction"], Estimate)
        assert abs(found["fraction"].value) < 3 * found["fraction"].stderr


def test_two_frames_tell_nothing():
    found = lag(recordings(0.1, frames=2))
    assert isinstance(found, NotMeasurable) and "3 frames" in found.record
