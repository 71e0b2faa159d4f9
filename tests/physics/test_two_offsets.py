"""Flats on another offset than the darks, in plain NumPy: told, and no response that bends."""

from __future__ import annotations

import re

import numpy as np
import pytest

from cannoise_jax.physics.transfer.doubts import doubts
from cannoise_jax.physics.transfer.estimate import NotMeasurable
from cannoise_jax.physics.transfer.estimators.light import nonlinearity
from cannoise_jax.physics.transfer.photon_transfer import photon_transfer
from cannoise_jax.physics.transfer.two_offsets import two_offsets
from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE, GAIN = (96, 128), 0.5


def series(offset=0.0, loss=0.0, late=0.0, cfa="MONO", seed=0):
    """Flats of 1 to 4 s and biases. offset: of the flats above the biases, DN; loss: share of the signal that
    is missing at 20,000 DN; late: by which the shutter opens late, s."""
    rng, out = np.random.default_rng(seed), []
    colours = 1.0 if cfa == "MONO" else np.tile([[0.6, 1.0], [1.0, 0.8]], (SIZE[0] // 2, SIZE[1] // 2))
    for kind, seconds in (("bias", 0.0), ("flat", 1.0), ("flat", 2.0), ("flat", 4.0)):
        light = 9000.0 * max(seconds - late, 0.0) * colours * np.ones(SIZE)
        signal = GAIN * rng.poisson(light, (8, *SIZE))
        signal = signal * (1 - loss * signal / 20000) + 3.0 * rng.standard_normal(signal.shape)
        codes = np.rint(500 + (offset if kind == "flat" else 0.0) + signal).astype(np.uint16)
        out.append(Recording(codes, cfa, (500.0,) * 4, 65535.0, "c", kind, exposure_s=seconds))
    return CaptureSet("c", tuple(out))


@pytest.mark.parametrize("offset", (250.0, -250.0))
@pytest.mark.parametrize("cfa", ("MONO", "RGGB"))
def test_flats_of_another_offset_are_told_by_noise_and_light(offset, cfa):
    (transfer,) = photon_transfer(series(offset, cfa=cfa))
    said = two_offsets(transfer.statistics)
    assert said in doubts(transfer)
    away, side, gain = re.search(r"dark (\d+) DN (above|below) .* \(([\d.]+) DN/e-", said).groups()
    assert float(away) == pytest.approx(abs(offset), rel=0.05) and (side == "above") == (offset > 0)
    assert float(gain) == pytest.approx(GAIN, rel=0.03)
    bent = nonlinearity(transfer.statistics, transfer.baseline)
    assert isinstance(bent, NotMeasurable) and "two offsets" in bent.record


@pytest.mark.parametrize(
    "effect",
    ({}, pytest.param({"loss": 0.05}, marks=pytest.mark.slow), {"loss": 0.2}, {"late": 0.05}),
    ids=str,
)
def test_what_else_bends_or_moves_the_light_is_no_offset(effect):
    for seed in range(4):
        (transfer,) = photon_transfer(series(seed=seed, **effect))
        assert two_offsets(transfer.statistics) == ""
