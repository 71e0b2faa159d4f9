"""A noise level function from one image: against known functions, on scenes, flats and real recordings."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from cannoise_jax.evaluation.baselines import calibrate_nlf
from cannoise_jax.physics.single_image import estimate_nlf, high_pass, local_mean
from cannoise_jax.physics.synthetic.scenes import draw_scenes, mosaic
from cannoise_jax.physics.synthetic.virtual import virtual_patches
from cannoise_jax.recordings.packing import pack
from tests.conftest import SIMULATION

estimate = jax.jit(estimate_nlf)


def told(tables, what, error):
    """Notes an error for the table of docs/training.md."""
    tables.add("reference_nlf", ("from one image", "error"), [(what, f"{100 * error:.2g} %")], SIMULATION[1:])


def sigma(clean, shot, read):
    return np.sqrt(np.mean(np.asarray(shot) * clean + np.asarray(read)))


def test_high_pass_keeps_white_noise_and_cancels_planes():
    y, x = np.mgrid[:40, :50].astype(np.float64)
    plane = (0.3 + 0.02 * x - 0.01 * y + 1e-3 * x * y)[..., None]
    assert np.abs(high_pass(plane)).max() < 1e-5
    noise = np.random.default_rng(0).normal(size=(400, 400, 1))
    residual = np.asarray(high_pass(noise))
    assert abs(residual.var() - 1) < 0.02
    assert abs(np.mean(residual * np.asarray(local_mean(noise)))) < 0.01


@pytest.mark.parametrize(
    ("shot", "read"), [pytest.param(1e-3, 1e-5, marks=pytest.mark.slow), (8e-3, 1e-4), (2e-4, 4e-6)]
)
def test_recovered_on_smooth_scenes(shot, read):
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:64, :64] / 64
    found = []
    for _ in range(30):
        clean = (0.02 + 0.3 * rng.random() * x + 0.1 * y)[..., None] + np.zeros(4)
        noisy = clean + np.sqrt(shot * clean + read) * rng.normal(size=clean.shape)
        found.append(sigma(clean, *estimate(noisy.astype(np.float32))) / sigma(clean, shot, read))
    assert abs(np.mean(found) - 1) < 0.01 and np.std(found) < 0.03


def test_recovered_on_textured_scenes():
    """Dead leaves and photographs, one 64x64 packed crop each: the median within 5 %, most within 15 %."""
    rng = np.random.default_rng(2)
    shot, read, ratios = 5e-3, 1e-5, []
    for scene in draw_scenes(jax.random.key(0), "test", 12, (256, 256)):
        image = np.asarray(pack(np.asarray(mosaic(scene.image, "RGGB")), "RGGB"), np.float64)[:64, :64]
        noisy = image + np.sqrt(shot * np.maximum(image, 0) + read) * rng.normal(size=image.shape)
        ratios.append(sigma(image, *estimate(noisy.astype(np.float32))) / sigma(image, shot, read))
    assert abs(np.median(ratios) - 1) < 0.05
    assert np.mean(np.abs(np.array(ratios) - 1) < 0.15) > 0.7


@pytest.mark.parametrize("scenes", [5, pytest.param(15, marks=pytest.mark.slow)])
def test_virtual_cameras_at_all_isos_against_fits_that_know_the_clean_image(scenes, tables):
    patches = virtual_patches(jax.random.key(5), "test", scenes, 1)
    estimated = np.stack([np.mean(v, -1) for v in jax.jit(jax.vmap(estimate_nlf))(patches.noisy)], -1)
    errors = []
    for setting in sorted(set(zip(patches.camera.tolist(), patches.iso.tolist(), strict=True))):
        here = (patches.camera == setting[0]) & (patches.iso == setting[1])
        wanted = calibrate_nlf(patches.clean[here], (patches.noisy - patches.clean)[here])
        found = estimated[here]
        grey = [sigma(0.18, *nlf) / sigma(0.18, *wanted) - 1 for nlf in found]
        errors += zip(np.abs(found[:, 0] / wanted[0] - 1), np.abs(grey), strict=True)
    shot, grey = np.median(errors, axis=0)
    if scenes > 5:
        far = np.quantile(np.array(errors)[:, 1], 0.9)
        told(tables, f"one 64×64 patch of {len(errors)} scenes and settings: shot, median error", shot)
        told(tables, "the same: σ at 18 % grey, median error", grey)
        told(tables, "the same: one in ten is off by more than", far)
    assert len(errors) == 5 * scenes and shot < 0.25 and grey < 0.09, (shot, grey)


def test_images_without_noise_have_none():
    for level in (0.0, 0.3, 1.0):
        shot, read = estimate(np.full((4, 64, 64, 4), level, np.float32))
        assert not np.any(shot) and np.max(read) < 1e-9


def test_a_flat_gives_its_own_variance_and_nothing_is_negative():
    rng = np.random.default_rng(3)
    for level in (0.0, 0.3):
        noisy = level + 0.01 * rng.normal(size=(4, 64, 64, 4))
        shot, read = (np.asarray(v) for v in estimate(noisy.astype(np.float32)))
        assert np.all(shot >= 0) and np.all(read >= 0)
        np.testing.assert_allclose(np.sqrt(shot * level + read), 0.01, rtol=0.05)


def test_real_recordings_against_frame_differences(real_data, tables):
    """The variance within one frame against that of two frames' difference, where no scene can raise it.

    Biases, the shortest darks, flats: in longer darks hot pixels, the same in every frame, count as noise in
    one frame. Row offsets (noise, and lamp flicker under a rolling shutter) are not part of the estimate:
    each row of the difference is brought to zero.
    """
    from cannoise_jax.recordings.load import load_recording

    found = {}
    for camera in ("asi120", "asi178"):
        folder = real_data / camera
        for path in sorted([*folder.glob("bias*"), *folder.glob("dark_0.1s*"), *folder.glob("flat*")]):
            recording = load_recording(path)
            frames = np.asarray(recording.frames[1:3]).astype(np.float64)
            dark = recording.black_map()
            height, width = (s // 2 * 2 for s in recording.size)
            first, second = (
                np.asarray(
                    pack(((f - dark) / (recording.white_level - dark))[:height, :width], recording.cfa)
                )
                for f in frames
            )
            y, x = height // 4 - 32, width // 4 - 32
            a, b = (p[y : y + 64, x : x + 64] for p in (first, second))
            difference = (a - b) - np.mean(a - b, 1, keepdims=True)
            wanted = np.sqrt(np.mean(np.square(difference)) * 64 / 63 / 2)
            found[f"{camera} {path.stem}"] = sigma(np.maximum(a, 0), *estimate(a.astype(np.float32))) / wanted
    for name, ratio in found.items():
        told(tables, f"{name}: σ", ratio - 1)
    assert len(found) == 6
    assert abs(np.median(list(found.values())) - 1) < 0.06, found
    assert all(abs(ratio - 1) < 0.15 for ratio in found.values()), found
