"""Virtual cameras: their recordings show the noise that their truth says, and not what they publish."""

from __future__ import annotations

import math

import jax
import numpy as np
import pytest

from cannoise_jax.physics.core.poisson_gaussian import nlf_from_electrons
from cannoise_jax.physics.synthetic import half_real, virtual
from cannoise_jax.recordings.load import load_capture_set
from cannoise_jax.recordings.packing import pack
from cannoise_jax.recordings.recording import BadInput, Recording

SIZE = (256, 256)
CAMERAS = {camera.name: camera for camera in virtual.virtual_cameras()}


def shots(camera, key, clean, iso, count=8):
    """Noise-free signal and `count` frames of it (normalised), drawn one by one: they share compiled code."""
    keys = jax.random.split(key, count)
    taken = [virtual.record(camera, k, clean, iso) for k in keys]
    frames = np.stack([t[0][0] for t in taken]).astype(np.float64)
    return taken[0][1], (frames - camera.black_level) / (camera.white_level - camera.black_level)


@pytest.fixture(scope="module")
def flats():
    """Noise of each camera at its highest ISO on a flat of 0.2, eight frames; with the camera's settings."""

    def noise(camera):
        clean, frames = shots(camera, jax.random.key(5), np.full(SIZE, 0.2, np.float32), camera.isos[-1])
        return frames - clean

    return {name: noise(camera) for name, camera in CAMERAS.items()}


def true_nlf(camera, iso):
    """Shot and read noise of the camera's sensor, without what its mechanisms add."""
    n, span = camera.isos.index(iso), camera.white_level - camera.black_level
    gain, read_e = (float(table[n, 0]) for table in (camera.sensor.gain_dn_per_e, camera.sensor.read_noise_e))
    return virtual.Nlf(*(float(v) for v in nlf_from_electrons(gain, read_e, span)))


@pytest.mark.parametrize("ratio", [0.65, 1.6])
def test_a_ratio_sets_the_noise_against_what_is_published(ratio):
    """Pixels alone; rows and offsets come on top."""
    for camera in virtual.virtual_cameras(ratio):
        nlf, true = camera.published[camera.isos[0]], true_nlf(camera, camera.isos[0])
        kept = 0.85**2 + 0.15**2 / 4 if camera.denoises else 1.0
        assert math.sqrt(true.shot * kept / nlf.shot) == pytest.approx(ratio)
        assert math.sqrt(true.read * kept / nlf.read) == pytest.approx(ratio)


@pytest.fixture(scope="module")
def patches():
    return virtual.virtual_patches(jax.random.key(0), "test", scenes=5, per_scene=4)


def test_cameras_have_the_names_patterns_and_published_functions_of_sidd():
    assert list(CAMERAS) == ["IP", "GP", "S6", "N6", "G4"]
    assert [c.cfa for c in CAMERAS.values()] == ["RGGB", "BGGR", "GRBG", "BGGR", "BGGR"]
    assert CAMERAS["S6"].published[3200] == pytest.approx((0.01993, 0.000002))
    assert true_nlf(CAMERAS["S6"], 3200) == pytest.approx((0.01581424, 2.07e-5))


@pytest.mark.parametrize("name", CAMERAS)
def test_variance_is_that_of_the_truth(flats, name):
    camera = CAMERAS[name]
    shot, read = true_nlf(camera, camera.isos[-1])
    span = camera.white_level - camera.black_level
    expected = shot * 0.2 + read + 1 / 12 / span**2
    if camera.denoises:
        expected *= 0.85**2 + 0.15**2 / 4
    # Differences of frames drop frozen black-level errors; row noise adds at most 0.16^2 of the read part.
    measured = np.var(flats[name][1:] - flats[name][:-1]) / 2
    assert measured == pytest.approx(expected + 0.0256 * read / 2, rel=0.015 + 0.02 * read / expected)


@pytest.mark.parametrize("name, iso, ratio", [("IP", 1600, 1.45), ("S6", 100, 1.84), ("G4", 100, 0.755)])
def test_published_function_is_wrong_by_the_measured_ratio(name, iso, ratio):
    """Standard deviation over the published one's at a tenth of the range."""
    camera = CAMERAS[name]
    _, frames = shots(camera, jax.random.key(1), np.full(SIZE, 0.1, np.float32), iso)
    sigma = frames.std(axis=(1, 2)).mean()
    shot, read = camera.published[iso]
    assert sigma / math.sqrt(0.1 * shot + read) == pytest.approx(ratio, rel=0.02)


def test_rows_of_n6_share_slow_noise_and_those_of_gp_hardly(flats):
    def power(noise):
        rows = pack(noise, "BGGR")[..., 1].mean(axis=2)
        return np.abs(np.fft.rfft(rows - rows.mean(axis=1, keepdims=True), axis=1)) ** 2

    def low_over_high(spectra):
        return spectra[:, 1:9].mean() / spectra[:, 33:].mean()

    # Eight frames give 3.16 +- 0.52 over 24 draws of them, too loose for the bound: pool the draws.
    camera, flat = CAMERAS["N6"], np.full(SIZE, 0.2, np.float32)
    draws = [shots(camera, jax.random.key(100 + n), flat, camera.isos[-1]) for n in range(24)]
    assert low_over_high(np.concatenate([power(frames - clean) for clean, frames in draws])) > 3
    assert low_over_high(power(flats["GP"])) < 1.6


def test_only_g4_correlates_neighbours_of_one_colour(flats):
    """Blend weight w leaves 2 (1 - w) (w/4) of the variance in each neighbour: 0.0875 at 0.15."""
    for name, noise in flats.items():
        z = noise - noise.mean(axis=0)
        lag = np.mean(z[:, 2:] * z[:, :-2]) / np.var(z)
        assert lag == pytest.approx(0.0876 if name == "G4" else 0.0, abs=0.02)


def test_clean_signal_of_a_denoising_camera_is_what_its_frames_average_to():
    camera, rng = CAMERAS["G4"], np.random.default_rng(0)
    clean = rng.uniform(0.1, 0.8, SIZE).astype(np.float32)
    expected, frames = shots(camera, jax.random.key(2), clean, 100)
    mean = frames.mean(axis=0)
    error = (mean - expected)[4:-4, 4:-4]
    assert error.std() < 1.2 * math.sqrt(0.45 * 5.8e-4 * 0.73 / 8)
    assert (expected - clean).std() > 5 * error.std()


def test_patches_are_complete_and_consistent(patches):
    assert patches.clean.shape == patches.noisy.shape == (100, 64, 64, 4)
    assert patches.clean.dtype == patches.noisy.dtype == np.float32
    assert np.bincount(patches.camera).tolist() == [20] * 5
    for c, camera in enumerate(virtual.virtual_cameras()):
        here = patches.camera == c
        assert set(patches.iso[here].tolist()) == set(camera.isos)
        iso = patches.iso[here][0]
        assert patches.shot[here][0] == pytest.approx(camera.published[iso].shot)
        assert patches.read[here][0] == pytest.approx(camera.published[iso].read)
    noise = patches.noisy - patches.clean
    assert abs(noise.mean()) < 0.002 and 0.002 < noise.std() < 0.1


def test_patches_depend_on_their_key_alone(patches):
    again = virtual.virtual_patches(jax.random.key(0), "test", scenes=5, per_scene=4)
    assert all(np.array_equal(a, b) for a, b in zip(patches, again, strict=True))


def test_patches_are_on_the_code_lattice(patches):
    camera = CAMERAS["IP"]
    codes = patches.noisy[patches.camera == 0] * (camera.white_level - camera.black_level)
    assert np.abs(codes - np.round(codes)).max() < 1e-3


def test_splits_have_no_scene_number_in_common(patches):
    other = virtual.virtual_patches(jax.random.key(0), "validation", scenes=2, per_scene=4)
    assert not set(patches.scene) & set(other.scene)


@pytest.fixture
def dark():
    rng = np.random.default_rng(0)
    floor = 4 * np.round(rng.normal(100, 3, (4, *SIZE))).astype(np.uint16)
    return Recording(floor, "GRBG", (400.0, 400.0, 400.0, 400.0), 65532.0, camera="real", kind="dark")


def test_half_real_frames_are_the_dark_plus_counted_photons(dark):
    clean = np.full(SIZE, 0.1, np.float32)
    made = half_real.half_real_recording(jax.random.key(0), clean, dark, gain_dn_per_e=40.0)
    light = made.frames.astype(np.float64) - dark.frames
    expected = 0.1 * (65532 - 400)
    assert light.mean() == pytest.approx(expected, rel=1e-3)
    assert light.var() == pytest.approx(40 * expected, rel=0.02)
    assert made.code_step == 4 and not (made.frames % 4).any()
    assert made.kind == "scene" and made.read is None
    assert made.shot == pytest.approx((40 / (65532 - 400),) * 4)


def test_a_scene_without_light_gives_the_dark_back(dark):
    made = half_real.half_real_recording(jax.random.key(0), np.zeros(SIZE, np.float32), dark, 2.0)
    assert np.array_equal(made.frames, dark.frames)


def test_half_real_on_a_real_floor_keeps_its_hot_pixels(real_data):
    darks = load_capture_set(real_data / "asi178")
    dark = next(r for r in darks.of_kind("dark") if r.exposure_s == 100)
    clean = np.full(dark.size, 0.02, np.float32)
    made = half_real.half_real_recording(jax.random.key(0), clean, dark, gain_dn_per_e=4.22)
    scene, floor = np.asarray(made.frames[0:2], float), np.asarray(dark.frames[0:2], float)
    hot = floor.mean(axis=0) > np.median(floor) + 2000
    assert hot.sum() > 50
    assert np.median(scene.mean(axis=0)[hot]) > np.median(scene) + 2000
    assert made.code_step == 4


def test_bad_requests_are_refused_in_one_line(dark):
    with pytest.raises(BadInput, match="no ISO 50"):
        virtual.record(CAMERAS["IP"], jax.random.key(0), np.zeros(SIZE, np.float32), 50)
    with pytest.raises(BadInput, match="at least as large"):
        half_real.half_real_recording(jax.random.key(0), np.zeros((8, 8), np.float32), dark, 1.0)
    with pytest.raises(ValueError, match="square"):
        virtual.virtual_patches(jax.random.key(0), per_scene=5)
