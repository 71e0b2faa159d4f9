"""Frames noisier than others have no heavy tails, and heavy tails are found among them."""

import numpy as np
import pytest

from cannoise_jax.signatures.fields import helmert
from cannoise_jax.signatures.shape import kurtosis_score
from tests.discovery.looks import white


def of_frames(seed, draw):
    """Fields of darks whose standardised frames are drawn."""
    out = []
    for f in white(np.random.default_rng(seed), size=(64, 96), kinds=("dark", "dark")):
        frames = draw(np.random.default_rng([seed, f.number]), (f.frames, *f.mean.shape))
        contrasts = np.einsum("nt,tij->nij", helmert(f.frames), frames).astype(np.float32)
        static = (frames.mean(0) * np.sqrt(f.frames)).astype(np.float32)
        out.append(f._replace(contrasts=contrasts[: len(f.contrasts)], static=static))
    return tuple(out)


def noise_of(shape):
    noise = np.linspace(0.8, 1.2, shape[0])
    return (noise / np.sqrt(np.mean(noise**2)))[:, None, None]


def test_a_mixture_of_frames_is_no_tail():
    def loud(rng, shape):
        return noise_of(shape) * rng.standard_normal(shape)

    p = [np.exp(kurtosis_score(of_frames(seed, loud)).log_p) for seed in range(20)]
    assert min(p) > 1e-3


def test_tails_among_frames_of_several_noises_have_their_size():
    def heavy(rng, shape):
        return noise_of(shape) * rng.standard_t(16, shape) / np.sqrt(16 / 14)

    found = kurtosis_score(of_frames(1, heavy))
    assert found.log_p < -50 and found.amplitude == pytest.approx(6 / 12, rel=0.25)
