"""Smooth shading and the likeness of neighbours, which fixed patterns are measured beside."""

import numpy as np

from cannoise_jax.physics.transfer.spatial import correlation_loss, shading


def test_shading_keeps_pixels_and_takes_the_slope():
    y, x = np.mgrid[-1:1:64j, -1:1:96j]
    surface = 1 + 0.3 * x - 0.2 * y * x + 0.1 * y**2
    assert np.abs(shading(surface) - surface).max() < 1e-3
    noise = np.random.default_rng(12).normal(size=(64, 96))
    assert shading(noise).std() < 0.1


def test_correlation_thins_out_degrees_of_freedom():
    white = np.random.default_rng(13).normal(size=(20, 200))
    assert correlation_loss(white) < 1.05
    paired = white[:, 1:] + white[:, :-1]
    assert 1.4 < correlation_loss(paired) < 1.6  # 1 + 2 * 0.5^2
