"""Smooth shading and the likeness of neighbours, which fixed patterns are measured beside."""

import numpy as np
import pytest

from cannoise_jax.physics.transfer.photon_transfer import photon_transfer
from cannoise_jax.physics.transfer.response import response_of
from cannoise_jax.physics.transfer.spatial import (
    TemporalParts,
    correlation_loss,
    shading,
    spatial_split,
    temporal_mean_square,
)
from cannoise_jax.recordings.recording import CaptureSet, Recording


def test_shading_keeps_pixels_and_takes_the_slope():
    y, x = np.mgrid[-1:1:64j, -1:1:96j]
    surface = 1 + 0.3 * x - 0.2 * y * x + 0.1 * y**2
    assert np.abs(shading(surface).surface - surface).max() < 1e-9
    noise = np.random.default_rng(12).normal(size=(64, 96))
    found = shading(noise)
    assert found.surface.std() < 0.1 and found.degree == 4


def test_dark_corners_are_no_pattern():
    """cos^4 down to a fifth of the light, and 1 % of sensitivities under it."""
    y, x = np.mgrid[-1:1:120j, -1:1:160j]
    light = 0.2 ** ((y**2 + x**2) / 2)
    found = shading(light / light.mean())
    assert found.degree > 4 and np.abs(found.surface - light / light.mean()).max() < 3e-3
    patterns = 1 + 0.01 * np.random.default_rng(3).standard_normal((5, *light.shape))
    for gains in light * patterns / light.mean():
        response = response_of(gains, np.ones(light.shape, bool))
        spread = np.sqrt(np.mean(response.pattern**2) / response.square)
        assert abs(spread - 0.01) < 3 * 0.01 / np.sqrt(light.size)


def test_pixels_that_answer_oddly_bend_no_light():
    rng = np.random.default_rng(4)
    gains = 1 + 0.005 * rng.standard_normal((80, 100))
    odd = rng.random(gains.shape) < 0.01
    response = response_of(np.where(odd, 0.02, gains), np.ones(gains.shape, bool))
    assert np.array_equal(~response.keep, odd) and np.abs(response.light - 1).max() < 2e-3


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


@pytest.mark.parametrize("turn", [0.0, 0.05])
def test_light_that_leans_to_another_side_hides_no_pattern(turn):
    """As of a sky behind a mount that turns round, half way through the flats."""
    rng, size, frames = np.random.default_rng(8), (96, 128), 8
    response = 1 + 0.006 * rng.standard_normal(size)
    lean = 1 + turn * np.linspace(-1, 1, size[1])
    light = 15000 * np.stack([response * (lean if n < frames // 2 else lean[::-1]) for n in range(frames)])

    def stored(kind, electrons):
        codes = 300 + 0.5 * (rng.poisson(electrons) + 4 * rng.standard_normal((frames, *size)))
        codes = np.rint(codes).astype(np.uint16)
        return Recording(codes, "MONO", (300.0,) * 4, 65535.0, kind=kind, exposure_s=1.0)

    capture = CaptureSet("c", (stored("dark", np.zeros((frames, *size))), stored("flat", light)))
    (transfer,) = photon_transfer(capture)
    found, *_ = transfer.outcomes("PRNU1288", "%")
    assert found.value == pytest.approx(0.6, rel=0.03) and found.ci90[1] - found.ci90[0] < 0.05
