"""Camera presets: the tables come out in the frames that they promise."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

from cannoise_jax.physics.core import tukey_lambda
from cannoise_jax.physics.core.presets import PHONES, preset_names, read_table
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.core.settings import baseline_at
from cannoise_jax.recordings.recording import BadInput

SIZE = (256, 256)


def darks(model, iso, frames=8, seed=0):
    clean = np.zeros(SIZE, np.float32)
    taken = model.sample(jax.random.key(seed), clean, Settings(iso=iso, frames=frames))
    return np.asarray(taken, np.float64) - np.asarray(model.black_level).mean()


def row_sigma(frames):
    """Row noise from the variance of row means less what the pixels leave in them."""
    centred = frames - frames.mean(axis=(1, 2), keepdims=True)
    within = (centred - centred.mean(axis=2, keepdims=True)).var() * frames.shape[2] / (frames.shape[2] - 1)
    return np.sqrt(centred.mean(axis=2).var() - within / frames.shape[2]), np.sqrt(within)


@pytest.fixture(scope="module")
def sony():
    return SensorModel.preset("sony_a7s2")


def test_dual_gain_switch_lowers_the_read_noise(sony):
    """ISO 2000 is quieter than ISO 1600, in DN, by the tabulated 0.42: the camera switches its gain there."""
    before, after = (row_sigma(darks(sony, iso)) for iso in (1600, 2000))
    assert after[1] / before[1] == pytest.approx(2.654 / 6.299, rel=0.02)
    assert after[0] / before[0] == pytest.approx(0.331 / 0.989, rel=0.1)


@pytest.mark.parametrize(
    "iso, row, read",
    [(100, 0.1391, 1.0067), (1600, 0.989, 6.299), (6400, 0.7219, 7.116), (25600, 2.276, 25.85)],
)
def test_row_and_read_noise_are_the_tabulated_ones(sony, iso, row, read):
    measured_row, measured_read = row_sigma(darks(sony, iso))
    assert measured_row == pytest.approx(row, rel=0.06)
    assert measured_read == pytest.approx(read, rel=0.02)


@pytest.mark.parametrize("iso, shape", [(1600, -0.0441), (25600, -0.09089)])
def test_tails_are_those_of_the_tabulated_shape(sony, iso, shape):
    frames = darks(sony.without("row_noise"), iso, frames=24)
    centred = frames - frames.mean(axis=(1, 2), keepdims=True)
    kurtosis = (centred**4).mean() / (centred**2).mean() ** 2 - 3
    assert kurtosis == pytest.approx(float(tukey_lambda.excess_kurtosis(shape)), rel=0.15)


def test_one_iso_equals_the_whole_table_there(sony):
    key, clean = jax.random.key(3), np.full(SIZE, 0.1, np.float32)
    one = SensorModel.preset("sony_a7s2", iso=1600)
    settings = Settings(iso=1600, frames=8)
    assert np.array_equal(one.sample(key, clean, settings), sony.sample(key, clean, settings))


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_gives_frames_between_its_rails_with_its_gain(name):
    # Name and pattern are static under jit: with one of each, and one ISO, presets share compiled code.
    iso = float(np.asarray(SensorModel.preset(name).iso)[-1])
    model = dataclasses.replace(SensorModel.preset(name, iso), camera="camera", cfa="RGGB")
    gain = float(np.asarray(model.gain_dn_per_e)[-1, 0])
    span = float(model.white_level) - float(model.black_level[0])
    clean = np.full(SIZE, min(0.3, 400 * gain / span), np.float32)
    frames = np.asarray(model.sample(jax.random.key(1), clean, Settings(iso=iso, frames=2)), np.float64)
    assert frames.min() >= 0 and frames.max() <= float(model.white_level)
    read = gain * float(np.asarray(model.read_noise_e)[-1, 0])
    expected = gain * clean[0, 0] * span + read**2 + 1 / 12
    # The difference of two frames drops what is frozen; row noise and drift add at most a few per cent.
    assert np.var(frames[1] - frames[0]) / 2 == pytest.approx(expected, rel=0.05)


def test_every_table_names_its_source():
    for table in (*read_table("cameras")["cameras"].values(), read_table("phones")["published"]):
        assert table["source"]
    assert {short for short, _ in PHONES.values()} <= set(read_table("phones")["published"])


def test_the_dual_gain_switches_between_isos_at_once(sony):
    reads = [float(baseline_at(sony, iso)[1][0]) for iso in (1600, 1800, 1990, 2000, 2200)]
    np.testing.assert_allclose(reads[:3], np.sqrt(6.2992**2 - 1 / 12) / 1.53008, rtol=1e-3)
    assert max(reads[3:]) < 1.5
    gains = [float(baseline_at(sony, iso)[0][0]) / iso for iso in (1600, 1800, 1990, 2000)]
    np.testing.assert_allclose(gains, gains[0], rtol=1e-3)


def test_unknown_names_and_isos_are_refused():
    with pytest.raises(BadInput, match="no such preset"):
        SensorModel.preset("nokia_3310")
    with pytest.raises(TypeError, match="iso is 'x': give an ISO"):
        SensorModel.preset("sony_a7s2", iso="x")
    with pytest.raises(BadInput, match="no values for ISO 123"):
        SensorModel.preset("sony_a7s2", iso=123)
