"""The error of the read noise where what moves whole frames is a part of it."""

from __future__ import annotations

import numpy as np

from cannoise_jax.discovery.frames.calibrate import fit_baseline
from cannoise_jax.discovery.frames.contrasts import stack
from cannoise_jax.recordings.recording import Recording

SIZE, FRAMES, READ, WAVE = (64, 96), 8, 2.0, 1.5


def baseline(seed: int, wave: float):
    """Of darks and flats with a wave of a phase of its own in every frame, which the flats drown."""
    rng = np.random.default_rng(seed)
    along = 2 * np.pi * 0.21 * np.arange(SIZE[1])
    shots = []
    for n, (kind, light) in enumerate((("dark", 0.0), ("flat", 400.0), ("flat", 1600.0))):
        phase = rng.uniform(0, 2 * np.pi, (FRAMES, 1, 1))
        own = rng.poisson(light, (FRAMES, *SIZE)) + READ * rng.standard_normal((FRAMES, *SIZE))
        codes = np.round(200 + own + wave * np.cos(along + phase)).astype(np.uint16)
        shot = Recording(codes, "MONO", (200.0,) * 4, 4095.0, kind=kind, exposure_s=0.01)
        shots.append(stack(shot, n, list(range(FRAMES)), 1.0))
    return fit_baseline(shots, None)


def test_a_wave_of_few_phases_makes_the_read_noise_unsure():
    """Its variance over few frames scatters with the phases that they happen to have: all channels together
    lie within what is said, and without a wave no more is said than of independent pixels."""
    true = READ**2 + WAVE**2 / 2
    off = []
    # Of so few cameras the spread is less sure and the largest smaller: both bounds are as far.
    for seed in range(12):
        b = baseline(seed, WAVE)
        error = 2 * b.read_noise * b.read_stderr
        off.append(float(np.mean(b.read_noise**2 - true)) / float(np.linalg.norm(error) / 4))
    assert np.std(off) < 1.6 and np.max(np.abs(off)) < 4.5
    quiet = [baseline(seed, 0.0).read_stderr.mean() for seed in range(3)]
    assert np.max(quiet) < 1.3 * READ / np.sqrt(2 * (FRAMES - 1) * SIZE[0] * SIZE[1] / 4)
