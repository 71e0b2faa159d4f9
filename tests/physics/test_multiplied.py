"""An electron multiplying gain that files state is said with what it does to gain and read noise."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cannoise_jax.physics.transfer.doubts import doubts
from cannoise_jax.physics.transfer.photon_transfer import photon_transfer
from cannoise_jax.recordings.fits_readout import em_gain_of
from cannoise_jax.recordings.recording import CaptureSet, Recording


def recordings(em_gain, register=30.0):
    rng, out = np.random.default_rng(0), []
    for kind, light in (("dark", 0.0), ("flat", 300.0), ("flat", 900.0)):
        charge = rng.poisson(light, (8, 64, 96))
        many = np.where(charge > 0, rng.gamma(np.maximum(charge, 1e-9), register), 0.0)
        codes = np.rint(200 + many / 12 + 3 * rng.standard_normal(charge.shape)).clip(0).astype(np.uint16)
        taken = Recording(codes, "MONO", (200.0,) * 4, 65535.0, "c", kind, exposure_s=1.0)
        out.append(dataclasses.replace(taken, em_gain=em_gain))
    return CaptureSet("c", tuple(out))


def test_the_gain_of_multiplied_charge_is_twice_the_true_one_and_said_to_be():
    (transfer,) = photon_transfer(recordings(30.0))
    (said,) = (line for line in doubts(transfer) if "electron multiplying gain of 30" in line)
    assert "up to 1.97 times" in said
    assert np.mean(transfer.baseline.gain) / 1.97 == pytest.approx(30 / 12, rel=0.05)


@pytest.mark.parametrize("em_gain", (None, 0.0, 1.0))
def test_without_one_nothing_is_said(em_gain):
    (transfer,) = photon_transfer(recordings(em_gain))
    assert not any("multiplying" in line for line in doubts(transfer))


@pytest.mark.parametrize(
    ("header", "gain"),
    [
        ({"EMREALGN": 300, "EMGAIN": 290}, 300.0),
        ({"EMGAIN": "50", "OUTPTAMP": "Electron Multiplying"}, 50.0),
        ({"EMREALGN": 300, "OUTPTAMP": "Conventional"}, None),
        ({"GAIN": 100}, None),
    ],
)
def test_headers_state_it_in_words_of_their_own(header, gain):
    assert em_gain_of(header) == gain
