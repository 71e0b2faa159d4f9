"""Smooth shading and the likeness of neighbours, which fixed patterns are measured beside."""

import numpy as np

from cannoise_jax.physics.transfer.spatial import (
    TemporalParts,
    correlation_loss,
    shading,
    spatial_split,
    temporal_mean_square,
)


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


def test_pixels_that_are_left_out_make_no_lines():
    found = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        frames = rng.normal(size=(8, 96, 128)) * 0.1
        pattern = rng.normal(size=(96, 128)) + frames.mean(0)
        keep = rng.random(pattern.shape) < 0.6
        rows, columns = (temporal_mean_square(frames.mean(axis)) for axis in (2, 1))
        parts = TemporalParts(0.01, 7.0 * keep.sum(), *rows, *columns, 8)
        found.append(spatial_split(pattern, keep, parts))
    lines = np.array([(f.row.value, f.column.value) for f in found])
    assert np.all(np.abs(lines.mean(0)) < 3 * lines.std(0) / np.sqrt(20))
