"""Noise Flow learns by likelihood what Poisson-Gaussian levels do not say."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.training.flow import FlowRecipe, flow_noise, held_out_nats, train_flow

SHOT, READ = 2e-3, 1e-5


def pairs(factor=1.4, count=64):
    """Noise of two ISOs, `factor` times as strong as its published level."""
    rng = np.random.default_rng(0)
    iso = np.repeat([100, 400], count // 2)
    shot = SHOT * iso / 100
    clean = rng.uniform(0.02, 0.4, (count, 1, 1, 4)) * np.ones((1, 16, 16, 1))
    sigma = factor * np.sqrt(shot[:, None, None, None] * clean + READ)
    return SimpleNamespace(
        clean=clean, noisy=clean + sigma * rng.normal(size=clean.shape), iso=iso, sigma=sigma,
        shot=np.repeat(shot[:, None], 4, 1), read=np.full((count, 4), READ), camera=np.zeros(count, int),
    )  # fmt: skip


def test_likelihood_finds_the_level_and_reaches_the_entropy():
    data = pairs()
    flow = train_flow(data, 1, 0, FlowRecipe(steps=120, batch_size=8, patch=16, rate=2e-2, depth=1))
    noise = np.asarray(flow_noise(flow, jax.random.key(1), data.clean, data.camera, data.iso))
    for iso in (100, 400):
        own = data.iso == iso
        ratio = (noise[own] / data.sigma[own]).std()
        assert ratio == pytest.approx(1, abs=0.06), iso
    entropy = -np.mean(np.log(data.sigma * np.sqrt(2 * np.pi * np.e)))
    assert held_out_nats(flow, data) == pytest.approx(entropy, abs=0.03)


def test_small_patches_are_refused():
    with pytest.raises(BadInput, match="32"):
        train_flow(pairs(count=4), 1, 0)
