"""One convention for the level: what a trained model makes is as loud as its camera, however it is asked."""

from __future__ import annotations

from pathlib import Path
from runpy import run_path
from unittest import mock

import jax
import numpy as np
import pytest

from cannoise_jax.evaluation.compare import draw_noise, model_columns
from cannoise_jax.evaluation.kl import clipped_noise
from cannoise_jax.model_file import load_model
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.sampling import sample_noise
from cannoise_jax.training import loop
from cannoise_jax.training.data import load_data
from cannoise_jax.training.result import samplers_of, write_model
from cannoise_jax.training.step import choose_level

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
STEPS, TOLERANCE = 24, 0.15
"""A model that corrects a level twice, or takes one for another, is off by 0.3 and more on some camera. The
tolerance: of a model that small, trained that short, which does not yet know what denoising in the camera
hides from the estimate (G4: 0.12)."""


class Silent:
    def update(self, n=1):
        pass

    def set_postfix(self, ordered_dict=None, refresh=True, **numbers):
        pass


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The tiny config, asked for the virtual cameras, which it never saw."""
    config = run_path(str(CONFIGS / "ci.py"))["get_config"]()
    config.update({"steps": STEPS, "evaluate_every": STEPS, "checkpoint_every": STEPS, "batch_size": 4})
    config.optimiser.update({"generator_rate": 3e-3, "encoder_rate": 3e-3, "warmup": 6})
    config.data.update({"cameras": 12, "references": 1, "scenes": 6, "per_scene": 4, "test_scenes": 12})
    config.data.update({"held_out_per_scene": 1, "calibration_scenes": 15})
    config.loss.adversarial = 0.0
    folder = tmp_path_factory.mktemp("run")
    data = load_data(config, folder)
    # Validation chooses among steps: the last is the only one here.
    with mock.patch.object(loop, "_validate", lambda *_: 0.0):
        outcome = loop.train(config, folder, data, lambda *_: Silent())
    write_model(config, outcome.state, data, folder)
    return config, data, load_model(folder)


def ratios(noise, test, cameras):
    real = clipped_noise(test.noisy - test.clean, test.clean)
    return {n: noise[test.camera == c].std() / real[test.camera == c].std() for c, n in enumerate(cameras)}


@pytest.mark.parametrize("way", ["model", "model_given"])
def test_noise_is_as_loud_as_the_cameras_with_and_without_nlf(trained, way):
    config, data, model = trained
    samplers = samplers_of(model, config)
    columns = model_columns(
        samplers.usual, data.test, jax.random.key(1), data.recalibrated, 2, samplers.given
    )
    found = ratios(draw_noise(columns[way], data.test, jax.random.key(2), 16), data.test, data.cameras)
    assert all(abs(ratio - 1) < TOLERANCE for ratio in found.values()), found


def test_a_level_of_another_source_is_refused(trained):
    _, data, model = trained
    clean, noisy, key = data.test.clean[0], data.test.noisy[1], jax.random.key(0)
    with pytest.raises(ValueError, match="nlf: missing"):
        sample_noise(model.replace(level="given"), key, clean, noisy)
    with pytest.raises(ValueError, match="leave nlf out"):
        sample_noise(model.replace(level="estimated"), key, clean, noisy, (1e-3, 1e-6))


def test_the_way_travels_in_the_file_and_older_files_are_refused(trained, tmp_path):
    import json

    from cannoise_jax.model_file import save_model

    model = trained[2].replace(level="estimated")
    save_model(tmp_path / "model.npz", model)
    assert load_model(tmp_path).level == "estimated"
    with np.load(tmp_path / "model.npz") as file:
        arrays = dict(file)
    description = json.loads(str(arrays["description"]))
    del description["sha256"]  # they had none
    for older in ("cannoise/model/1", "cannoise/model/2", "cannoise/model/3"):
        arrays["description"] = np.array(json.dumps({**description, "format": older}))
        np.savez(tmp_path / "model.npz", **arrays)
        with pytest.raises(BadInput, match="older version.*train it again") as error:
            load_model(tmp_path)
        assert "\n" not in str(error.value)


def test_the_level_of_training_is_that_of_sampling():
    from cannoise_jax.physics.single_image import estimate_nlf

    rng = np.random.default_rng(0)
    anchor = (0.1 + 0.01 * rng.standard_normal((6, 32, 32, 4))).astype(np.float32)
    given = np.full((6, 4), 7.0, np.float32)
    batch = {"clean": anchor, "anchor": anchor, "shot": given, "read": given}
    key = jax.random.key(3)
    np.testing.assert_array_equal(choose_level("given", key, batch).shot, given)
    chosen = jax.jit(choose_level, static_argnums=0)
    estimated = chosen("estimated", key, batch)
    np.testing.assert_allclose(estimated.shot[2], jax.jit(estimate_nlf)(anchor[2])[0], rtol=1e-4)
    both = chosen("both", key, batch)
    known = np.asarray(both.known) == 1
    assert 0 < known.sum() < 6
    np.testing.assert_array_equal(both.read[known], given[known])
    # Two programs, which round differently.
    np.testing.assert_allclose(both.read[~known], estimated.read[~known], rtol=1e-6)
