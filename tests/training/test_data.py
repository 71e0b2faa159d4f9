"""What runs train on: splits that share nothing, noise levels that are measured, one-line refusals."""

from __future__ import annotations

from pathlib import Path
from runpy import run_path

import numpy as np
import pytest

from cannoise_jax.recordings.native import write_recording
from cannoise_jax.recordings.recording import BadInput, Recording, per_channel
from cannoise_jax.training.data import HeldOut, load_data

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
SPAN, BLACK = 4000.0, 95.0
SIZE = (128, 384)


@pytest.fixture
def config():
    found = run_path(str(CONFIGS / "ci.py"))["get_config"]()
    found.data.source = "recordings"
    found.data.half_real_scenes = 3
    return found


def write_camera(folder: Path, cfa: str, gain: float, flats: bool = True, darks: bool = True) -> Path:
    """Flats at half range and darks of a camera with this gain (DN/e-) and a read noise of 8 DN."""
    folder.mkdir()
    rng = np.random.default_rng(len(cfa) + int(100 * gain))

    def write(name: str, kind: str, level_e: float) -> None:
        charge = rng.poisson(level_e, (10, *SIZE)) * gain
        frames = np.round(BLACK + charge + 8 * rng.standard_normal((10, *SIZE))).astype(np.uint16)
        recording = Recording(
            frames, cfa, per_channel(BLACK), BLACK + SPAN, camera=folder.name, kind=kind, exposure_s=0.01
        )
        write_recording(folder / f"{name}.h5", recording)

    if flats:
        write("flat", "flat", 0.4 * SPAN / gain)
    if darks:
        write("dark", "dark", 0.0)
    return folder


def test_folders_of_two_cameras_with_unknown_noise_levels(config, tmp_path):
    config.data.recordings = (
        str(write_camera(tmp_path / "a", "RGGB", 2.0)),
        str(write_camera(tmp_path / "b", "GBRG", 0.5)),
    )
    data = load_data(config, tmp_path)
    assert data.cameras == ("a", "b")
    for camera, gain in enumerate((2.0, 0.5)):
        own = np.asarray(data.train.camera) == camera
        assert own.sum() > 10
        for part in (data.validation, data.test):
            assert (part.camera == camera).any()
        np.testing.assert_allclose(
            np.stack([data.train[i]["shot"] for i in np.flatnonzero(own)]), gain / SPAN, rtol=0.1
        )
        np.testing.assert_allclose(
            np.stack([data.train[i]["read"] for i in np.flatnonzero(own)]), (8 / SPAN) ** 2, rtol=0.1
        )
        shot, read = data.recalibrated[camera, 0]
        assert shot == pytest.approx(gain / SPAN, rel=0.15)
        assert read == pytest.approx((8 / SPAN) ** 2, rel=0.15)


def test_no_frame_is_in_two_splits(config, tmp_path):
    config.data.recordings = (
        str(write_camera(tmp_path / "a", "RGGB", 2.0)),
        str(write_camera(tmp_path / "b", "GBRG", 0.5)),
    )
    data = load_data(config, tmp_path)
    train = {data.train[i]["noisy"].tobytes() for i in range(len(data.train))}
    validation = {patch.tobytes() for patch in data.validation.noisy}
    test = {patch.tobytes() for patch in data.test.noisy}
    assert not (train & validation or train & test or validation & test)


def test_one_camera_needs_the_triplet_switched_off(config, tmp_path):
    config.data.recordings = (str(write_camera(tmp_path / "a", "RGGB", 2.0)),)
    with pytest.raises(BadInput, match="one camera only.*--config.loss.triplet=0"):
        load_data(config, tmp_path)
    config.loss.triplet = 0.0
    assert load_data(config, tmp_path).cameras == ("a",)


def test_darks_without_flats_cannot_give_shot_noise(config, tmp_path):
    config.data.recordings = (str(write_camera(tmp_path / "a", "RGGB", 2.0, flats=False)),)
    config.loss.triplet = 0.0
    with pytest.raises(BadInput, match="shot and read are unknown.*record") as refused:
        load_data(config, tmp_path)
    assert "\n" not in str(refused.value)


def test_virtual_scenes_are_disjoint(config, tmp_path):
    config.data.source = "virtual"
    data = load_data(config, tmp_path)
    assert not set(data.validation.scene) & set(data.test.scene)
    clean = {data.train[i]["clean"].tobytes() for i in range(len(data.train))}
    assert not clean & {patch.tobytes() for patch in (*data.test.clean, *data.validation.clean)}


def test_unknown_source(config, tmp_path):
    config.data.source = "nothing"
    with pytest.raises(BadInput, match="config.data.source.*virtual"):
        load_data(config, tmp_path)


def test_some_of_a_held_out_set_is_spread_evenly():
    ramp = np.arange(10)
    image = np.zeros((10, 2, 2, 4))
    part = HeldOut(image, image, image, image, ramp, ramp, ramp).some(4)
    assert part.camera.tolist() == [0, 3, 6, 9]
    assert part.clean.shape == (4, 2, 2, 4)
    assert HeldOut(image, image, image, image, ramp, ramp, ramp).some(99).camera.tolist() == ramp.tolist()
