"""Interpolated sites: told from noise that neighbours share where the light of the sites differs."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.signatures.lattice import lattice_score
from tests.discovery.capture import capture_set


def along_the_raster(rng):
    """1/f noise along the readout of a frame, beside lit sites of two levels."""

    def alter(dn, signal, kind, exposure):
        spectrum = rng.standard_normal(dn.size // 2 + 1) + 1j * rng.standard_normal(dn.size // 2 + 1)
        spectrum[1:] /= np.sqrt(np.arange(1, spectrum.size))
        noise = np.fft.irfft(spectrum, dn.size).reshape(dn.shape)
        green = np.indices(dn.shape).sum(0) % 2 == 1
        light = np.where(green & (kind == "flat"), rng.poisson(signal / 1.5) * 1.5, 0)
        return dn + light + 4 * noise / noise.std()

    return alter


def interpolated(rng):
    """Every other pixel holds 60 % of the mean of its neighbours, as it was stored."""

    def alter(dn, signal, kind, exposure):
        mean = sum(np.roll(dn, s, a) for s, a in ((2, 0), (-2, 0), (2, 1), (-2, 1))) / 4
        return np.where(np.indices(dn.shape).sum(0) % 4 // 2 == 1, 0.4 * dn + 0.6 * mean, dn)

    return alter


@pytest.mark.parametrize(("alter", "there"), [(along_the_raster, False), (interpolated, True)])
def test_noise_that_neighbours_share_is_no_interpolated_site(alter, there):
    capture = capture_set(3, alter, kinds="df")
    score = lattice_score(prepare(capture, all_frames(split_recordings(capture)), False).fields, mono=False)
    assert score is not None
    assert (score.log_p < -20) == there
