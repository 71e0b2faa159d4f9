"""What neighbours that are alike hide from a high-pass residual: found where it is, not where texture is."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from cannoise_jax.physics.hidden_level import _BLENDS, _HIDDEN, WEIGHTS, hidden_level
from cannoise_jax.physics.single_image import estimate_nlf, high_pass, residual_nlf
from cannoise_jax.physics.synthetic.scenes import draw_scenes, mosaic
from cannoise_jax.recordings.packing import pack

estimate, of_residual = jax.jit(estimate_nlf), jax.jit(residual_nlf)


def blended(rng, shape, weight):
    """Noise of unit variance whose pixels are blended with their four neighbours."""
    n, height, width, planes = shape
    white = rng.normal(size=(n, height + 2, width + 2, planes))
    around = white[:, :-2, 1:-1] + white[:, 2:, 1:-1] + white[:, 1:-1, :-2] + white[:, 1:-1, 2:]
    noise = (1 - weight) * white[:, 1:-1, 1:-1] + weight / 4 * around
    return noise / np.sqrt((1 - weight) ** 2 + weight**2 / 4)


def level(found, clean):
    shot, read = (np.asarray(v) for v in found)
    return np.sqrt(np.mean(shot * clean + read))


def scenes(count):
    for scene in draw_scenes(jax.random.key(4), "train", count, (160, 160)):
        yield np.asarray(pack(np.asarray(mosaic(scene.image, "RGGB")), "RGGB"), np.float64)[:64, :64]


@pytest.mark.parametrize("weight", [0.0, 0.15, 0.3])
def test_the_curves_are_the_covariances_of_blended_noise(weight):
    residual = np.asarray(high_pass(blended(np.random.default_rng(0), (1, 800, 800, 4), weight)))[0]
    kept = np.interp(weight, WEIGHTS, np.exp(-2 * _HIDDEN))
    assert np.var(residual) == pytest.approx(kept, rel=0.01)
    i = int(np.argmin(np.abs(WEIGHTS - weight)))
    lags = [residual * residual, residual[:, 1:] * residual[:, :-1], residual[1:, 1:] * residual[:-1, :-1]]
    found = np.array([np.mean(x) for x in lags]) / np.var(residual)
    np.testing.assert_allclose(found, _BLENDS[i, :3] / _BLENDS[i, 0], atol=0.01)


@pytest.mark.parametrize(("images", "error"), [(1, 0.09), pytest.param(6, 0.035, marks=pytest.mark.slow)])
def test_the_level_of_blended_noise_is_found_and_that_of_white_noise_left(images, error):
    """The residual reads 12 % and 22 % low; one image that is not sure is believed by half."""
    rng = np.random.default_rng(1)
    for weight in (0.0, 0.15, 0.25):
        ratios = [
            level(estimate((0.3 + 0.01 * blended(rng, (images, 64, 64, 4), weight)).astype(np.float32)), 0.3)
            for _ in range(12)
        ]
        assert np.mean(ratios) / 0.01 == pytest.approx(1, abs=0.01 if not weight else error), weight


def test_texture_is_no_blend():
    """White noise on scenes is left as it is; the same blended is given most of what it lacks."""
    rng = np.random.default_rng(2)
    errors = {0.0: [], 0.2: []}
    for image in scenes(14):
        truth = np.sqrt(1e-3 * np.maximum(image, 0) + 1e-5)
        for weight, found in errors.items():
            noisy = (image + truth * blended(rng, (1, 64, 64, 4), weight)[0]).astype(np.float32)
            before, after = (
                np.log(level(f(noisy), np.maximum(image, 0)) / np.sqrt(np.mean(truth**2)))
                for f in (of_residual, estimate)
            )
            found.append((before, after))
    white, dull = (np.array(errors[w]) for w in (0.0, 0.2))
    assert np.median(np.abs(white[:, 1] - white[:, 0])) < 0.005
    assert np.median(dull[:, 0]) < -0.12 and abs(np.median(dull[:, 1])) < 0.06


def test_pixels_at_the_rails_do_not_lower_the_level():
    rng = np.random.default_rng(3)
    clean = np.full((64, 64, 4), 0.3)
    clean[:, 40:] = 1.3
    noisy = np.clip(clean + 0.02 * rng.normal(size=clean.shape), None, 1).astype(np.float32)
    assert level(estimate(noisy), 0.3) == pytest.approx(0.02, rel=0.04)


def test_noise_of_less_than_a_code_in_the_dark_does_not_silence_the_rest():
    rng = np.random.default_rng(4)
    clean = np.where(np.arange(64)[:, None, None] < 32, 0.0, 0.4) + np.zeros((64, 64, 4))
    noise = np.sqrt(2e-5 * clean + 1e-9) * rng.normal(size=clean.shape)
    noisy = (np.round((clean + noise) * 1023) / 1023).astype(np.float32)
    assert level(estimate(noisy), 0.4) == pytest.approx(np.sqrt(8e-6 + 1 / 12 / 1023**2), rel=0.1)


def test_weights_of_zero_are_no_evidence():
    hidden, weight = hidden_level(np.zeros((1, 62, 62, 4), np.float32), np.zeros((1, 62, 62), np.float32))
    assert max(float(hidden), float(weight)) < 1e-6
