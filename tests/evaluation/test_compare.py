"""The comparison: baselines as defined, references of the right camera, whole results."""

from __future__ import annotations

import json
import math
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from cannoise_jax.evaluation import baselines, compare
from cannoise_jax.evaluation.figures import noise_figure
from cannoise_jax.evaluation.tables import results_table, write_results
from cannoise_jax.physics.synthetic.virtual import VirtualPatches

NAMES = ("A", "B")
SHOT, READ = 0.004, 0.00002
COUNT = 24


@pytest.fixture(scope="module")
def patches():
    """Two cameras whose true noise is 1.3 and 0.8 times the published Poisson-Gaussian."""
    rng = np.random.default_rng(0)
    clean = np.clip(
        rng.lognormal(-2.3, 0.6, (COUNT, 1, 1, 4)) * np.linspace(0.5, 1.5, 32)[:, None, None], 0, 0.8
    )
    clean = np.broadcast_to(clean, (COUNT, 32, 32, 4)).astype(np.float32)
    camera = np.repeat(np.arange(2), COUNT // 2).astype(np.int32)
    true = np.where(camera == 0, 1.3, 0.8)[:, None, None, None]
    noise = true * np.sqrt(SHOT * clean + READ) * rng.normal(size=clean.shape)
    return VirtualPatches(
        clean,
        (clean + noise).astype(np.float32),
        np.full((COUNT, 4), SHOT, np.float32),
        np.full((COUNT, 4), READ, np.float32),
        camera,
        np.full(COUNT, 100, np.int32),
        (np.arange(COUNT) % 4).astype(np.int32),
    )


@jax.jit
def oracle(key, clean, reference_noisy, shot, read):
    """Knows the camera from the reference alone: its scale is that of neighbouring differences."""
    sigma = jnp.sqrt(shot * jnp.mean(reference_noisy, axis=(1, 2, 3)) + read)
    steps = jnp.std(jnp.diff(reference_noisy, axis=3), axis=(1, 2, 3)) / math.sqrt(2)
    scale = jnp.mean(steps / sigma, axis=1)[:, None, None, None]
    return scale * baselines.poisson_gaussian(key, clean, reference_noisy, shot, read)


@pytest.fixture(scope="module")
def results(patches):
    noise = patches.noisy - patches.clean
    fitted = baselines.calibrate_by_setting(patches.clean, noise, patches.camera, patches.iso)
    return compare.evaluate_model(oracle, patches, NAMES, jax.random.key(1), recalibrated=fitted, batch=16)


def test_results_have_every_camera_and_model(results):
    assert set(results["cameras"]) == set(NAMES)
    for row in (*results["cameras"].values(), results["pooled"]):
        # One reference: the last column would be the model's again; no model that obeys a level was given.
        assert set(row) == set(compare.MODELS) - {"model_one_reference", "model_given"}
        for numbers in row.values():
            assert {"kl", "kl_floor", "kl_smoothed", "patches"} <= set(numbers)
            assert all(math.isfinite(v) for v in numbers.values())
    assert results["pooled"]["model"]["patches"] == COUNT


def test_models_rank_as_their_construction_says(results):
    for row in results["cameras"].values():
        kl = {name: numbers["kl"] for name, numbers in row.items()}
        assert kl["poisson_gaussian_recalibrated"] < 0.4 * kl["poisson_gaussian"] < kl["gaussian"]
        assert kl["model"] < 0.5 * kl["poisson_gaussian"]
        assert kl["model_wrong_reference"] > 3 * kl["model"]
        best = row["poisson_gaussian_recalibrated"]
        assert best["kl"] == pytest.approx(best["kl_floor"], rel=0.4)


def test_cameras_and_isos_add_up(patches):
    """Numbers by ISO are those of the patches of that ISO; a camera's are their mean over patches."""
    mixed = patches._replace(iso=np.where(np.arange(COUNT) % 3 == 0, 100, 400).astype(np.int32))
    made = compare.evaluate_model(None, mixed, NAMES, jax.random.key(1), batch=16)
    by_iso = made["settings"]["A"]
    assert list(by_iso) == ["100", "400"]
    counts = [by_iso[i]["gaussian"]["patches"] for i in by_iso]
    assert counts == [4, 8]
    mean = sum(n * by_iso[i]["gaussian"]["kl"] for i, n in zip(by_iso, counts, strict=True)) / 12
    assert made["cameras"]["A"]["gaussian"]["kl"] == pytest.approx(mean)


def test_same_key_same_results(patches, results):
    told = []
    again = compare.evaluate_model(
        oracle,
        patches,
        NAMES,
        jax.random.key(1),
        batch=16,
        columns=("model",),
        tell=lambda *at: told.append(at),
    )
    assert again["pooled"]["model"] == results["pooled"]["model"]
    assert told == [(n, len(told)) for n in range(1, len(told) + 1)] and len(told) > 1


def test_a_model_that_looks_at_no_reference_is_the_same_with_any(patches):
    made = compare.evaluate_model(
        baselines.poisson_gaussian, patches, NAMES, jax.random.key(1), batch=16, references=2
    )["pooled"]
    assert made["model"] == made["model_wrong_reference"] == made["model_one_reference"]
    assert made["model"]["kl"] != made["poisson_gaussian"]["kl"]


def test_references_are_of_the_same_camera_and_another_scene(patches):
    right, wrong = compare.choose_references(patches.camera, patches.scene, jax.random.key(0))
    assert right.shape == wrong.shape == (COUNT, 1)
    assert (patches.camera[right] == patches.camera[:, None]).all()
    assert (patches.scene[right] != patches.scene[:, None]).all()
    assert (patches.camera[wrong] != patches.camera[:, None]).all()


def test_references_are_of_the_setting_where_it_has_another_patch():
    camera, scene = np.repeat([0, 1], 8), np.arange(16)
    setting = np.tile([100, 100, 400, 400], 4)
    right, _ = compare.choose_references(camera, scene, jax.random.key(0), 2, setting)
    assert (setting[right] == setting[:, None]).all() and (camera[right] == camera[:, None]).all()
    assert (right != np.arange(16)[:, None]).all()
    alone, _ = compare.choose_references(camera[:2], scene[:2], jax.random.key(0), 1, np.array([100, 400]))
    np.testing.assert_array_equal(alone, [[1], [0]])


def test_several_references_are_different_and_of_one_camera():
    camera, scene = np.repeat(np.arange(3), 10), np.arange(30)
    right, wrong = compare.choose_references(camera, scene, jax.random.key(0), 4)
    for i in range(30):
        assert len(set(right[i])) == len(set(wrong[i])) == 4
        assert i not in right[i] and set(camera[right[i]]) == {camera[i]}
        assert len(set(camera[wrong[i]])) == 1 and camera[wrong[i][0]] != camera[i]
    few, _ = compare.choose_references(camera[:2], scene[:2], jax.random.key(0), 4)
    np.testing.assert_array_equal(few, [[1] * 4, [0] * 4])


def test_several_references_bring_a_column_with_one(patches):
    seen = []

    def sampler(key, clean, reference, shot, read):
        seen.append(reference.shape[1])
        return baselines.poisson_gaussian(key, clean, reference, shot, read)

    made = compare.evaluate_model(sampler, patches, NAMES, jax.random.key(1), references=3)
    assert "model_one_reference" in made["pooled"] and "1 ref." in results_table(made)
    assert sorted(set(seen)) == [1, 3] and seen.count(3) == 2 * seen.count(1)


def test_one_camera_has_no_wrong_reference():
    right, wrong = compare.choose_references(np.zeros(3, int), np.zeros(3, int), jax.random.key(0))
    assert (right != np.arange(3)[:, None]).all() and (wrong == -1).all()


def test_gaussian_baseline_takes_shot_as_variance():
    clean = jnp.full((4, 64, 64, 4), 0.3)
    noise = baselines.gaussian(jax.random.key(0), clean, clean, jnp.full((4, 4), 0.0025), jnp.zeros((4, 4)))
    assert float(noise.std()) == pytest.approx(0.05, rel=0.01)


def test_poisson_gaussian_baseline_follows_the_noise_level_function():
    clean = jnp.linspace(0.0, 1.0, 64)[None, :, None, None] * jnp.ones((16, 64, 64, 4))
    ones = jnp.ones((16, 4))
    noise = baselines.poisson_gaussian(jax.random.key(0), clean, clean, 0.01 * ones, 0.001 * ones)
    variance = np.asarray(noise).var(axis=(0, 2, 3))
    assert variance == pytest.approx(0.01 * np.linspace(0, 1, 64) + 0.001, rel=0.12)


@pytest.mark.parametrize("shot, read", [(0.004, 0.00002), (0.0005, 0.0), (0.0, 0.0003)])
def test_calibration_recovers_the_noise_level_function(shot, read):
    """Also with an offset of a read sigma and saturated parts, neither of which may enter."""
    rng = np.random.default_rng(1)
    clean = np.minimum(rng.lognormal(-2.3, 0.9, 400_000), 1)
    noise = rng.normal(size=clean.size) * np.sqrt(shot * clean + read) + math.sqrt(read)
    noise = np.where(clean > 0.95, 0, noise)
    fitted = baselines.calibrate_nlf(clean, noise)
    assert fitted[0] == pytest.approx(shot, rel=0.02, abs=1e-5)
    assert fitted[1] == pytest.approx(read, rel=0.05, abs=2e-6)


def test_calibration_needs_enough_values():
    with pytest.raises(ValueError, match="at least 1000"):
        baselines.calibrate_nlf(np.full(5000, 0.99), np.zeros(5000))


def test_table_shows_every_row_and_the_floor(results):
    text = results_table(results)
    for word in ("A", "B", "pooled", "PG published", "wrong refs.", "lag-1"):
        assert word in text
    numbers = results["pooled"]["model"]
    assert f"{numbers['kl']:.4f} ({numbers['kl_floor']:.4f})" in text


def test_results_file_follows_its_schema(results, tmp_path):
    path = tmp_path / "results.json"
    write_results(path, results, seconds=1.5)
    read = json.loads(path.read_text())
    assert read["schema"] == "cannoise/results/1" and read["seconds"] == 1.5
    assert read["cameras"]["A"]["model"]["kl"] == results["cameras"]["A"]["model"]["kl"]
    assert [p.name for p in tmp_path.iterdir()] == ["results.json"]


@pytest.mark.parametrize(("mask", "mode"), [(0o022, 0o644), (0o027, 0o640)])
def test_results_file_is_readable_as_the_umask_says(mask, mode, results, tmp_path):
    before = os.umask(mask)
    try:
        write_results(tmp_path / "results.json", results, seconds=1.0)
    finally:
        os.umask(before)
    assert (tmp_path / "results.json").stat().st_mode & 0o777 == mode


def test_results_that_are_not_finite_write_nothing(results, tmp_path):
    path = tmp_path / "results.json"
    path.write_text("old")
    with pytest.raises(ValueError):
        write_results(path, {**results, "pooled": {"model": {"kl": math.nan}}}, seconds=1.0)
    assert path.read_text() == "old" and len(list(tmp_path.iterdir())) == 1


def test_a_structure_that_noise_does_not_have_is_null(results, tmp_path):
    row = {**results["pooled"], "model": {**results["pooled"]["model"], "excess_kurtosis": math.nan}}
    write_results(tmp_path / "results.json", {**results, "pooled": row}, seconds=1.0)
    read = json.loads((tmp_path / "results.json").read_text())["pooled"]["model"]
    assert read["excess_kurtosis"] is None and read["kl"] == results["pooled"]["model"]["kl"]


def test_figure_is_a_picture_with_colour(patches, tmp_path):
    path = tmp_path / "noise.png"
    noise_figure(path, oracle, patches, NAMES, jax.random.key(0), batch=16)
    with Image.open(path) as file:
        pixels = np.asarray(file.convert("RGB")).astype(int)
    red_or_blue = np.abs(pixels[..., 0] - pixels[..., 2]) > 60
    assert pixels.shape[0] > 300 and red_or_blue.mean() > 0.05
