"""Two amplifiers whose offsets move against each other are told, and make no noise that pixels share."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.mechanisms import LISTED
from cannoise_jax.physics.transfer.faults import faults
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.model import find_mechanisms
from cannoise_jax.physics.transfer.photon_transfer import photon_transfer
from cannoise_jax.physics.transfer.regions import drifting_halves
from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE, FRAMES, READ = (96, 128), 8, 3.3


def dark(seed=0, halves=0.0, columns=0.0, rows=0.0, wave=0.0, frames=FRAMES):
    """Noise of READ DN. halves: of the offset of the right half, columns, rows: each anew in every frame;
    wave: amplitude of one of free phase across, DN."""
    rng = np.random.default_rng(seed)
    values = READ * rng.standard_normal((frames, *SIZE))
    values[:, :, SIZE[1] // 2 :] += halves * rng.standard_normal((frames, 1, 1))
    values += columns * rng.standard_normal((frames, 1, SIZE[1])) + rows * rng.standard_normal(
        (frames, SIZE[0], 1)
    )
    phase = 2 * np.pi * rng.random((frames, 1, 1))
    values += wave * np.sin(0.05 * np.arange(SIZE[1]) + phase)
    return Recording(np.rint(500 + values).astype(np.uint16), "MONO", (500.0,) * 4, 16383.0, "c", "dark")


@pytest.mark.parametrize("moves", (1.0, 3.0))
def test_halves_that_move_are_told_and_are_no_pink_or_column_noise(moves):
    taken = dark(halves=moves)
    said = drifting_halves(frame_statistics(taken))
    assert "move against each other by" in said and "two amplifiers" in said
    rng, flats = np.random.default_rng(1), []
    for light in (4000, 9000):
        values = 500 + rng.poisson(light, (FRAMES, *SIZE)) + READ * rng.standard_normal((FRAMES, *SIZE))
        codes = np.rint(values).astype(np.uint16)
        flats.append(Recording(codes, "MONO", (500.0,) * 4, 16383.0, "c", "flat"))
    (transfer,) = photon_transfer(CaptureSet("c", (taken, *flats)))
    assert faults(transfer.statistics).halves == said
    findings = find_mechanisms(transfer.statistics, transfer.baseline, LISTED)
    there = {f.mechanism for f in findings if f.measured is not None}
    assert not {"pink_noise", "column_noise", "banding", "row_noise", "in_camera_denoising"} & there


@pytest.mark.parametrize("other", ({}, {"columns": 2.0}, {"rows": 2.0}, {"wave": 2.0}), ids=str)
def test_what_frames_share_otherwise_are_no_halves_that_move(other):
    for seed in range(8):
        assert drifting_halves(frame_statistics(dark(seed, **other))) == "", seed
