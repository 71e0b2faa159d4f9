"""What runs train on: splits that share nothing, noise levels that are measured, one-line refusals."""

from __future__ import annotations

from pathlib import Path
from runpy import run_path

import numpy as np
import pytest

from cannoise_jax.recordings.native import write_recording
from cannoise_jax.recordings.recording import BadInput, Recording, per_channel
from cannoise_jax.training.data import HeldOut, load_data
from cannoise_jax.training.recorded import _parted
from tests.recordings.test_sidd import write_instance

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
SPAN, BLACK = 4000.0, 95.0
SIZE = (128, 384)


def configured():
    found = run_path(str(CONFIGS / "ci.py"))["get_config"]()
    found.data.source = "recordings"
    found.data.half_real_scenes = 3
    return found


@pytest.fixture
def config():
    return configured()


def write_camera(
    folder: Path, cfa: str, gain: float, flats: bool = True, darks: bool = True, dark_frames: int = 10
) -> Path:
    """Flats at half range and darks of a camera with this gain (DN/e-) and a read noise of 8 DN."""
    folder.mkdir()
    rng = np.random.default_rng(len(cfa) + int(100 * gain))

    def write(name: str, kind: str, level_e: float, count: int = 10) -> None:
        charge = rng.poisson(level_e, (count, *SIZE)) * gain
        frames = np.round(BLACK + charge + 8 * rng.standard_normal((count, *SIZE))).astype(np.uint16)
        recording = Recording(
            frames, cfa, per_channel(BLACK), BLACK + SPAN, camera=folder.name, kind=kind, exposure_s=0.01
        )
        write_recording(folder / f"{name}.h5", recording)

    if flats:
        write("flat", "flat", 0.4 * SPAN / gain)
    if darks:
        write("dark", "dark", 0.0, dark_frames)
    return folder


@pytest.fixture(scope="module")
def of_two(tmp_path_factory):
    """The data of two cameras in folders."""
    folder, config = tmp_path_factory.mktemp("two"), configured()
    config.data.recordings = (
        str(write_camera(folder / "a", "RGGB", 2.0)),
        str(write_camera(folder / "b", "GBRG", 0.5)),
    )
    return load_data(config, folder)


def test_folders_of_two_cameras_with_unknown_noise_levels(of_two):
    data = of_two
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


def test_no_frame_is_in_two_splits(of_two):
    data = of_two
    train = {data.train[i]["noisy"].tobytes() for i in range(len(data.train))}
    validation = {patch.tobytes() for patch in data.validation.noisy}
    test = {patch.tobytes() for patch in data.test.noisy}
    assert not (train & validation or train & test or validation & test)


@pytest.mark.parametrize("count", [3, pytest.param(6, marks=pytest.mark.slow)])
def test_few_darks_are_enough(count, config, tmp_path):
    config.data.recordings = (str(write_camera(tmp_path / "a", "RGGB", 2.0, dark_frames=count)),)
    config.loss.triplet = 0.0
    data = load_data(config, tmp_path)
    for part in (data.validation, data.test):
        assert len(np.unique(part.scene)) == 1 + config.data.half_real_scenes  # the flat, and those on darks


@pytest.mark.parametrize("count", range(40))
def test_parts_are_whole_and_none_is_empty_from_three_on(count):
    parts = _parted(count)
    assert np.concatenate(parts).tolist() == list(range(count))
    assert len(parts[0]) >= max(len(parts[1]), len(parts[2]))
    assert count < 3 or min(map(len, parts)) >= 1


def write_scenes(folder: Path, frames: int, isos: tuple[int, ...]) -> str:
    """One recording for every ISO, with a noise-free image of its own."""
    folder.mkdir()
    rng = np.random.default_rng(len(isos))
    for n, iso in enumerate(isos):
        clean = np.full(SIZE, 0.1 + 0.02 * n, np.float32)
        noisy = np.round(BLACK + SPAN * clean + 8 * rng.standard_normal((frames, *SIZE))).astype(np.uint16)
        recording = Recording(
            noisy, "RGGB", per_channel(BLACK), BLACK + SPAN, camera=folder.name, clean=clean, iso=iso,
            shot=per_channel(1e-4), read=per_channel(1e-5), reference="independent",
        )  # fmt: skip
        write_recording(folder / f"{n:02d}.h5", recording)
    return str(folder)


@pytest.mark.parametrize("frames", [1, 5])
def test_scenes_are_parted_whole_within_an_iso(frames, config, tmp_path):
    config.data.recordings = (write_scenes(tmp_path / "a", frames, (100, 800) * 5),)
    config.loss.triplet = 0.0
    data = load_data(config, tmp_path)
    seen = [
        {float(np.mean(patch)) for patch in part.clean} for part in (data.train, data.validation, data.test)
    ]
    assert [len(levels) for levels in seen] == [6, 2, 2]
    assert not (seen[0] & seen[1] or seen[0] & seen[2] or seen[1] & seen[2])
    assert set(data.test.iso) == set(data.validation.iso) == {100, 800}


def test_single_frames_at_an_iso_each_are_parted_together(config, tmp_path):
    config.data.recordings = (write_scenes(tmp_path / "a", 1, (100, 200, 400, 800)),)
    config.loss.triplet = 0.0
    data = load_data(config, tmp_path)
    assert set(data.validation.iso) == {400} and set(data.test.iso) == {800}


def scenes_of(data):
    return [
        set(np.unique(np.round(p.clean.mean((1, 2, 3)), 3))) for p in (data.train, data.validation, data.test)
    ]


@pytest.mark.parametrize("isos", [(100, 200, 400), (100, 100, 100, 800, 800), (100, 100, 200)])
def test_scenes_of_scattered_isos_are_parted_whole(isos, config, tmp_path):
    config.data.recordings = (write_scenes(tmp_path / "a", 5, isos),)
    config.loss.triplet = 0.0
    train, validation, test = scenes_of(load_data(config, tmp_path))
    assert train and validation and test
    assert not (train & validation or train & test or validation & test)
    assert len(train) + len(validation) + len(test) == len(isos)


def test_two_scenes_are_shared_by_frame_with_a_warning(config, tmp_path, caplog):
    config.data.recordings = (write_scenes(tmp_path / "a", 5, (100, 200)),)
    config.loss.triplet = 0.0
    train, _, test = scenes_of(load_data(config, tmp_path))
    assert train == test
    assert caplog.text.count("share them") == 1


def write_sidd(folder: Path) -> Path:
    """Made-up SIDD Medium folders of two cameras: three test scenes, one for validation, one to train on."""
    rng = np.random.default_rng(0)
    for n, scene in enumerate(("001", "002", "008", "010", "003")):
        for c, (camera, cfa) in enumerate((("S6", "GRBG"), ("GP", "BGGR"))):
            write_instance(folder, 2 * n + c + 1, scene, camera, cfa, rng.integers(70, 1000, (2, 140, 150)))
    return folder


def test_sidd_gives_training_and_test_scenes_their_numbers_of_patches(tmp_path):
    config = run_path(str(CONFIGS / "paper.py"))["get_config"]()
    config.data.update({"path": str(write_sidd(tmp_path / "sidd")), "train_patches": 30, "test_patches": 14})
    data = load_data(config, tmp_path / "run")
    assert set(data.cameras) == {"S6", "GP"}
    assert len(data.test.camera) == 14 and len(data.train) + len(data.validation.camera) == 30
    assert min(len(data.train), len(data.validation.camera)) >= 14
    assert data.test.clean.shape[1:] == (64, 64, 4)
    assert not set(data.validation.scene) & set(data.test.scene)


def test_sidd_without_the_validation_scene_is_refused(tmp_path):
    config = run_path(str(CONFIGS / "paper.py"))["get_config"]()
    config.data.update({"path": str(write_sidd(tmp_path / "sidd")), "train_patches": 30, "test_patches": 14})
    config.data.validation_scene = "009"
    with pytest.raises(BadInput, match="config.data.validation_scene: '009': use one of 003, 010"):
        load_data(config, tmp_path / "run")


def test_two_single_frames_cannot_be_parted(config, tmp_path):
    config.data.recordings = (write_scenes(tmp_path / "a", 1, (100, 100)),)
    config.loss.triplet = 0.0
    with pytest.raises(BadInput, match="too few frames for .*3 scenes"):
        load_data(config, tmp_path)


def test_one_camera_needs_the_triplet_switched_off(config, tmp_path):
    config.data.recordings = (str(write_camera(tmp_path / "a", "RGGB", 2.0)),)
    with pytest.raises(BadInput, match="one camera only.*--config.loss.triplet=0"):
        load_data(config, tmp_path)
    config.loss.triplet = 0.0
    assert load_data(config, tmp_path).cameras == ("a",)


def test_frames_that_show_no_noise_are_left_out_with_a_warning(config, tmp_path, caplog):
    folder = write_camera(tmp_path / "a", "RGGB", 2.0)
    white = np.full((10, *SIZE), round(BLACK + SPAN), np.uint16)
    bright = np.random.default_rng(1).integers(4070, 4100, (10, *SIZE)).astype(np.uint16)
    bright[..., :160] -= 100
    copied = np.repeat(np.random.default_rng(2).integers(3000, 3200, (1, *SIZE)).astype(np.uint16), 10, 0)
    for name, frames in {"white": white, "bright": bright, "copied": copied}.items():
        write_recording(
            folder / f"{name}.h5",
            Recording(frames, "RGGB", per_channel(BLACK), BLACK + SPAN, camera="a", kind="flat"),
        )
    config.data.recordings, config.loss.triplet = (str(folder),), 0.0
    data = load_data(config, tmp_path)
    assert max(data.train[i]["clean"].mean() for i in range(len(data.train))) < 0.6
    assert f"{folder}/white.h5: frames 1 to 10: every pixel is at or above the white level" in caplog.text
    assert f"{folder}/bright.h5: 100 % of the values are above 0.9" in caplog.text
    assert f"{folder}/copied.h5: frames 2 to 10: a copy of frame 1" in caplog.text


def test_stated_levels_of_no_noise_are_refused(config, tmp_path):
    frames = np.random.default_rng(0).integers(900, 1100, (10, *SIZE)).astype(np.uint16)
    (tmp_path / "a").mkdir()
    levels = {"shot": (0.0,) * 4, "read": (0.0,) * 4}
    write_recording(
        tmp_path / "a" / "x.h5",
        Recording(frames, "RGGB", per_channel(BLACK), BLACK + SPAN, kind="flat", **levels),
    )
    config.data.recordings, config.loss.triplet = (str(tmp_path / "a"),), 0.0
    with pytest.raises(BadInput, match=r"x.h5: shot and read are both zero") as refused:
        load_data(config, tmp_path)
    assert "\n" not in str(refused.value)


def test_darks_without_flats_cannot_give_shot_noise(config, tmp_path):
    config.data.recordings = (str(write_camera(tmp_path / "a", "RGGB", 2.0, flats=False)),)
    config.loss.triplet = 0.0
    with pytest.raises(BadInput, match="shot and read are unknown.*record") as refused:
        load_data(config, tmp_path)
    assert "\n" not in str(refused.value)


def test_drawn_cameras_train_and_the_virtual_ones_are_the_test(config, tmp_path):
    config.data.source = "drawn"
    data = load_data(config, tmp_path)
    assert len(data.train) == data.known == config.data.cameras
    assert set(np.unique(data.test.camera)) == set(range(5)) and len(data.cameras) == 5
    assert len(data.validation_cameras) == config.data.validation_cameras
    assert len(data.validation.camera) == config.data.validation_cameras * (config.references + 1)
    seen = {patch.tobytes() for patch in data.train.scenes}
    assert not seen & {patch.tobytes() for patch in data.test.clean}
    # The levels by name are those that recordings show, not the published ones.
    for name, camera in data.examples.items():
        for iso, setting in camera.settings.items():
            wanted = data.recalibrated[data.cameras.index(name), int(iso)]
            np.testing.assert_allclose(setting.shot, wanted[0], rtol=1e-5)


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
