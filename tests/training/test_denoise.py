"""Denoisers: disjoint parts, sources that keep their promises, pairing, files, and what is refused."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

from cannoise_jax.evaluation.denoising import psnr
from cannoise_jax.networks import Generator
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.recordings.packing import pack
from cannoise_jax.recordings.recording import BadInput, CaptureSet, Recording
from cannoise_jax.sampling import make_model
from cannoise_jax.training import worth
from cannoise_jax.training.denoise import (
    Denoiser,
    Recipe,
    applied,
    crops,
    load_denoiser,
    noisy_pool,
    save_denoiser,
    train_denoiser,
)
from cannoise_jax.training.denoise_data import dim_scenes, half_real, held_out_images, training_part
from cannoise_jax.training.noise_sources import NAMED, LightWarning, open_source, refined, sensor
from cannoise_jax.training.refine import iso_of, refine_data, span_of

GAIN, READ_E, BLACK = 2.0, 3.0, 200.0
SMALL = Recipe(steps=120, batch_size=4, patch=16, features=8, depth=3, scenes=2, realisations=1)


@pytest.fixture(scope="module")
def capture() -> CaptureSet:
    """Flats and darks of a Poisson-Gaussian sensor, with rows that share an offset in the long darks."""
    rng = np.random.default_rng(0)

    def taken(kind, electrons, exposure, frames, rows=0.0):
        noise = rng.poisson(electrons, (frames, 64, 128)) + READ_E * rng.normal(size=(frames, 64, 128))
        noise = noise + rows * rng.normal(size=(frames, 64, 1))
        values = np.rint(BLACK + GAIN * noise).astype(np.uint16)
        return Recording(
            values, "RGGB", (BLACK,) * 4, 4095.0, "toy", kind, exposure_s=exposure, code_step=1.0, iso=100.0
        )

    flats = [taken("flat", level, 0.01, 6) for level in (40, 200, 800)]
    return CaptureSet("toy", (*flats, taken("bias", 0, 1e-4, 8), taken("dark", 0, 10.0, 5, rows=4.0)))


@pytest.fixture(scope="module")
def data(capture):
    return half_real(capture, 10.0)


def test_parts_share_no_pixel_and_no_frame(capture, data):
    frames = np.asarray(capture.recordings[-1].frames, np.float32)
    black = np.array(data.black_level).reshape(2, 2)
    span = data.span_dn
    restored = data.train * span + np.tile(black, (32, 32))
    np.testing.assert_allclose(restored, frames[:3, :, :64], atol=1e-2)
    restored = data.test * span + np.tile(black, (32, 32))
    np.testing.assert_allclose(restored, frames[3:, :, 64:], atol=1e-2)
    for whole, part in zip(capture.recordings, training_part(capture).recordings, strict=True):
        assert part.count < whole.count and part.size == (64, 64)
    assert data.gain_dn_per_e == pytest.approx(GAIN, rel=0.1)
    assert data.read_noise_e == pytest.approx(READ_E, rel=0.1)


def test_sources_have_the_level_that_they_say(data):
    clean = np.full((64, 64), 0.3, np.float32)
    shot, floor = 0.3 / data.full_scale_e, float(np.var(data.train))
    expected = {
        "gaussian": 1 / data.full_scale_e,
        "gaussian_pooled": shot + floor,
        "pg": shot + (READ_E / data.full_scale_e) ** 2,
        "pg_at_exposure": shot + floor,
        "pg_estimated": None,  # the estimate of a few small images is loose
        "random_phase": shot + floor,
        "real_darks": shot + floor,
    }
    assert set(expected) == set(NAMED)
    for name, variance in expected.items():
        source = open_source(name, data, {})
        noise = np.stack([source(jax.random.key(i), clean) for i in range(12)]) - clean
        assert noise.shape == (12, 64, 64) and np.isfinite(noise).all()
        rows = noise.mean(2).var() * 64 / noise.var()
        if variance is not None:
            assert noise.var() == pytest.approx(variance, rel=0.12), name
        # Rows: 4 e- in 30 e-^2 + 25 e-^2 of variance are shared in the darks, and kept by the spectrum.
        assert (rows > 5) == (name in ("random_phase", "real_darks")), name


def test_a_sensor_model_is_sampled_in_the_datas_own_units(data):
    model = SensorModel.poisson_gaussian(GAIN, READ_E, 64.0, 1023.0, "RGGB")
    clean = np.full((64, 64), 0.3, np.float32)
    source = open_source("calibrated", data, {"calibrated": model})
    noise = np.stack([source(jax.random.key(i), clean) for i in range(8)]) - clean
    expected = 0.3 / data.full_scale_e + (READ_E**2 + 1 / 12 / GAIN**2) / data.full_scale_e**2
    # Up to the error of the measured gain, with which the data's units are made.
    assert noise.mean() == pytest.approx(0, abs=0.02)
    assert noise.var() == pytest.approx(expected, rel=0.15)


def test_a_camera_is_taken_without_the_light_of_its_recordings(data, tmp_path):
    model = SensorModel.poisson_gaussian(GAIN, READ_E, 64.0, 1023.0, "RGGB")
    model.save(tmp_path / "alone.json")
    model.with_mechanism("flicker", amplitude=0.5, frequency=0.1).save(tmp_path / "lit.json")
    with pytest.warns(LightWarning, match="flicker"):
        lit = open_source(str(tmp_path / "lit.json"), data, {})
    alone = open_source(str(tmp_path / "alone.json"), data, {})
    clean, key = np.full((64, 64), 0.3, np.float32), jax.random.key(1)
    np.testing.assert_array_equal(lit(key, clean), alone(key, clean))


def test_a_learned_part_is_judged_by_what_denoisers_gain_on_frames_held_back(data):
    inner = worth.parted(data)
    np.testing.assert_array_equal(np.concatenate([inner.train, inner.test]), data.train)
    assert worth.parted(dataclasses.replace(data, train=data.train[:1])) is None
    recipe = dataclasses.replace(SMALL, scenes=4, steps=80)
    darks, weak = open_source("real_darks", inner, {}), open_source("gaussian", inner, {})
    gain = worth.gain_of(inner, darks, weak, recipe, seeds=1)
    assert gain.low > 0, gain
    assert worth.gain_of(inner, darks, darks, recipe, seeds=1) == (0, 0, 0)


DARK_E_S, PATTERN_DN = 9.0, 12.0


@pytest.fixture(scope="module")
def unit():
    """A sensor with dark charge and a frozen pattern, in other levels than those of the recordings."""
    model = SensorModel.poisson_gaussian(GAIN, READ_E, 64.0, 4095.0, "RGGB")
    model = model.with_mechanism("dark_current", e_per_s=DARK_E_S)
    return model.with_mechanism("dsnu", sigma_dn=PATTERN_DN).with_maps((64, 64))


def test_a_generator_that_learned_nothing_gives_its_sensors_noise(data, unit):
    """Dark charge of the exposure and the frozen pattern included, about the median of its own darks."""
    generator = Generator(1 / 64, hidden=4, spectral=False, physics=False)
    image, key = np.ones((1, 32, 32, 4), np.float32), jax.random.key(0)
    shapes = jax.eval_shape(
        lambda: generator.init({"params": key, "noise": key}, image, image, image[:, 0, 0, :1], image,
                               train=False)
    )  # fmt: skip
    silent = jax.tree.map(lambda leaf: np.zeros(leaf.shape, np.float32), shapes)
    model = dataclasses.replace(
        make_model(generator, silent, None, {}, level="given", exposure_s=data.exposure_s), sensors=(unit,)
    )
    clean = np.full((64, 64), 0.3, np.float32)
    made = {}
    for name, source in (("ours", refined(data, model)), ("sensor", sensor(data, unit))):
        made[name] = np.stack([source(jax.random.key(i), clean) for i in range(8)]) - clean
    temporal = 0.3 / data.full_scale_e + (READ_E**2 + DARK_E_S * data.exposure_s) / data.full_scale_e**2
    for noise in made.values():
        assert noise.mean() == pytest.approx(0, abs=0.02)
        assert noise.var(axis=0, ddof=1).mean() == pytest.approx(temporal, rel=0.1)
    frozen = [noise.mean(0) for noise in made.values()]
    # What 8 frames leave of the temporal noise is in both, independently.
    kept = (PATTERN_DN / data.span_dn) ** 2
    expected = kept / (kept + temporal / 8)
    assert np.corrcoef(frozen[0].ravel(), frozen[1].ravel())[0, 1] == pytest.approx(expected, abs=0.08)


def test_generators_learn_from_the_darks_of_the_exposure_in_the_sensors_units(data, unit):
    made = refine_data(data, unit)
    scale = data.span_dn / span_of(unit, iso_of(data, unit))
    noise = (made.train.noisy - made.train.clean) / scale
    shift = DARK_E_S * data.exposure_s * GAIN / data.span_dn
    assert noise.mean() == pytest.approx(shift, rel=0.1)
    shot = made.train.clean.mean() / scale / data.full_scale_e
    assert noise.var() == pytest.approx(shot + np.var(data.train), rel=0.15)
    np.testing.assert_allclose(made.train.shot, scale / data.full_scale_e, rtol=1e-5)
    assert not np.isin(made.validation.clean, made.train.clean).all()


def test_five_synthetic_to_one_real(data):
    clean = np.zeros((64, 64), np.float32)
    source = open_source("pg+real_darks", data, {})
    rows = [float(source(jax.random.key(i), clean).mean(1).var()) for i in range(120)]
    share = np.mean(np.array(rows) > 4 * np.median(rows))
    assert share == pytest.approx(1 / 6, abs=0.12)


def test_batches_of_two_noise_models_are_paired(data):
    clean = dim_scenes(jax.random.key(0), "train", 2, (64, 64), "RGGB")
    both = []
    for name in ("pg", "real_darks"):
        noisy = noisy_pool(open_source(name, data, {}), clean, 2, jax.random.key(3))
        both.append(crops(np.random.default_rng(4), clean, noisy, SMALL, "RGGB"))
    np.testing.assert_array_equal(both[0][0], both[1][0])
    floors = [noisy - truth for truth, noisy in both]
    # The same photons: the noises agree as far as shot noise goes, not at all in the floor.
    assert np.corrcoef(floors[0].ravel(), floors[1].ravel())[0, 1] > 0.15


def test_training_improves_images_and_the_file_keeps_it(data, tmp_path):
    clean = dim_scenes(jax.random.key(1), "train", 2, (64, 64), "RGGB")
    source = open_source("pg", data, {})
    first, again = (train_denoiser(SMALL, source, clean, "RGGB", 0, {"noise": "pg"}) for _ in range(2))
    assert all(jax.tree.leaves(jax.tree.map(lambda a, b: bool((a == b).all()), first[1], again[1])))
    save_denoiser(tmp_path / "d.npz", first)
    read = load_denoiser(tmp_path / "d.npz")
    assert read.recipe == SMALL and read.about == {"noise": "pg"}
    truth = dim_scenes(jax.random.key(2), "test", 2, (64, 64), "RGGB")
    noisy = held_out_images(data, truth, jax.random.key(3))
    for t, n in zip(pack(truth, "RGGB"), pack(noisy.astype(np.float32), "RGGB"), strict=True):
        out = np.asarray(applied(SMALL)(read.variables, n[None]))[0]
        assert psnr(t, out) > psnr(t, n) + 0.5


def test_what_cannot_be_used_is_refused(capture, data, tmp_path):
    with pytest.raises(BadInput, match="10 s|0.0001"):
        half_real(capture, 3.0)
    with pytest.raises(BadInput, match="gain"):
        half_real(CaptureSet("toy", capture.of_kind("dark", "bias")), 10.0)
    with pytest.raises(BadInput, match="neither"):
        open_source("nonsense", data, {})
    (tmp_path / "bad.npz").write_bytes(b"PK nothing")
    other = {"params": {"Conv_0": {"kernel": np.ones((3, 3, 1, 2), np.float32)}}}
    save_denoiser(tmp_path / "other.npz", Denoiser(SMALL, other, {}))
    for name in ("bad", "other"):
        with pytest.raises(BadInput, match="train it again"):
            load_denoiser(tmp_path / f"{name}.npz")
    with pytest.raises(BadInput, match="patches need"):
        train_denoiser(Recipe(steps=1), NAMED["pg"](data), np.zeros((1, 32, 32), np.float32), "RGGB", 0)
