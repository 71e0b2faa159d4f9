"""A sensor model at its settings: tables and laws over ISO, exposure and temperature, and what is said beyond
the calibrated range."""

import dataclasses
import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.physics.core.mechanism import Scaling
from cannoise_jax.physics.core.sensor import ExtrapolationWarning, IsoTable, SensorModel, Settings
from cannoise_jax.physics.core.settings import baseline_at, context_of, resolve, settings_of
from cannoise_jax.recordings.recording import Recording

SIZE = (32, 32)
FLAT = np.full(SIZE, 0.2, np.float32)
MODEL = SensorModel.poisson_gaussian(0.5, 3.0, (60, 64, 68, 72), 1084, "RGGB")
KEY = jax.random.key(1)


def test_baseline_between_and_beyond_the_calibrated_isos():
    model = SensorModel.poisson_gaussian([[0.1], [0.4]], [[4.0], [2.0]], 64, 1023, iso=(100, 400))
    for iso, gain, read in ((100, 0.1, 4), (250, 0.25, 3), (400, 0.4, 2), (800, 0.8, 2), (50, 0.05, 4)):
        got = baseline_at(model, iso)
        np.testing.assert_allclose(got[0], gain, rtol=1e-5)
        np.testing.assert_allclose(got[1], read, rtol=1e-5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.sample(KEY, FLAT, Settings(iso=250))
    with pytest.warns(ExtrapolationWarning, match="proportional to ISO") as caught:
        model.sample(KEY, FLAT, Settings(iso=800))
    assert len(caught) == 1


def test_laws_of_mechanisms_beyond_their_isos_are_in_the_same_warning():
    base = SensorModel.poisson_gaussian([[0.1], [0.4]], [[4.0], [2.0]], 64, 1023, iso=(100, 400))
    table = IsoTable(np.array([100.0, 200.0]), np.array([0.5, 0.7]))
    model = base.with_mechanism("row_noise", sigma_dn=table).with_mechanism("column_noise", sigma_dn=0.3)
    for iso, words in (
        (800, ["gain is taken", "row_noise is held at its value of ISO 200", r"column_noise.*gain\^1"]),
        (50, ["gain is taken", "row_noise is held at its value of ISO 100", r"column_noise.*gain\^1"]),
        (300, ["sigma_dn of row_noise is held at its value of ISO 200"]),
    ):
        with pytest.warns(ExtrapolationWarning) as caught:
            asked(model, Settings(iso=iso))
        assert len(caught) == 1
        assert all(re.search(word, str(caught[0].message)) for word in words)
        assert ("column_noise" in str(caught[0].message)) == (len(words) == 3)
    preset = SensorModel.preset("sony_a7s2")
    law = r"outside the calibrated .*gain.*sigma_dn of row_noise is held"
    with pytest.warns(ExtrapolationWarning, match=law):
        asked(preset, Settings(iso=4 * float(np.asarray(preset.iso)[-1])))


def test_a_model_of_one_iso_does_not_speak_of_a_span():
    base = SensorModel.poisson_gaussian(0.5, 3.0, 64, 1023)
    said = "ISO 800 is not the calibrated 100, which also stands for .* a camera without ISO"
    with pytest.warns(ExtrapolationWarning, match=said):
        asked(base, Settings(iso=800.0))


def asked(model, settings=None):
    """What is said of a sample is said before it is drawn: nothing need be compiled."""
    jax.eval_shape(lambda: model.sample(KEY, FLAT, settings or Settings()))


def values_at(model, **settings):
    return resolve(model, context_of(model, jnp.zeros((1, *SIZE)), Settings(**settings)))[0]


def test_scaling_laws_and_tables():
    base = SensorModel.poisson_gaussian([[0.1], [0.4]], [[4.0], [2.0]], 64, 1023, iso=(100, 400))
    row = base.with_mechanism("row_noise", sigma_dn=0.5)
    np.testing.assert_allclose(values_at(row, iso=400.0)["sigma_dn"], 2.0, rtol=1e-5)
    table = base.with_mechanism(
        "row_noise", sigma_dn=IsoTable(np.array([100.0, 400.0]), np.array([0.5, 0.7]))
    )
    np.testing.assert_allclose(values_at(table, iso=250.0)["sigma_dn"], 0.6, rtol=1e-5)
    law = Scaling(exposure=1.0, doubling_c=6.0, reference_temperature_c=20.0)
    dark = base.with_mechanism("dark_current", e_per_s=3.0, scaling=law)
    warm = values_at(dark, iso=100.0, exposure_s=2.0, temperature_c=32.0)
    np.testing.assert_allclose(warm["e_per_s"], 3 * 2 * 4, rtol=1e-5)
    np.testing.assert_allclose(values_at(dark, iso=100.0, exposure_s=2.0)["e_per_s"], 6, rtol=1e-5)


def test_a_temperature_that_no_law_covers_is_said_once():
    known = Scaling(exposure=1.0, doubling_c=7.0, reference_temperature_c=20.0)
    blind = MODEL.with_mechanism("dark_current", e_per_s=3.0)
    told = MODEL.with_mechanism("dark_current", e_per_s=3.0, scaling=known)
    for model, celsius, words in (
        (blind, 40.0, "reference temperature is unknown"),
        (told, 40.0, "double every 7 K"),
    ):
        with pytest.warns(ExtrapolationWarning, match=words) as caught:
            asked(model, Settings(temperature_c=celsius))
        assert len(caught) == 1 and "dark_current" in str(caught[0].message)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        asked(told, Settings(temperature_c=22.0))
        measured = Scaling(exposure=1.0, exposure_low_s=0.001, exposure_high_s=30.0)
        ranged = MODEL.with_mechanism("dark_current", e_per_s=3.0, scaling=measured)
        asked(ranged)
        asked(blind)
    with pytest.warns(ExtrapolationWarning, match=r"0.001 to 30 s of dark_current.*exposure\^1"):
        asked(ranged, Settings(exposure_s=100.0))


def test_settings_are_an_argument_of_jit_and_vmap():
    model, settings = MODEL.with_mechanism("dark_current", e_per_s=100.0), Settings(exposure_s=0.5, frames=2)
    eager = np.asarray(model.sample(KEY, FLAT, settings))
    traced = np.asarray(jax.jit(model.sample)(KEY, FLAT, settings))
    assert traced.shape == (2, *SIZE) and np.mean(traced != eager) < 1e-3  # fused arithmetic rounds otherwise
    times = np.array([0.0, 2.0, 4.0], np.float32)
    series = jax.vmap(lambda t: model.sample(KEY, FLAT, Settings(exposure_s=t, frames=2)))(times)
    along = Settings(iso=None, exposure_s=0, frames=2)
    given = Settings(iso=100.0, exposure_s=times, frames=2)
    again = jax.vmap(model.sample, in_axes=(None, None, along))(KEY, FLAT, given)
    np.testing.assert_array_equal(series, again)
    each = jax.tree.map(lambda v: np.full(3, v, np.float32), Settings(exposure_s=0.5))
    drawn = jax.vmap(model.sample, in_axes=(None, None, jax.tree.map(lambda v: 0, each)))(KEY, FLAT, each)
    assert drawn.shape == (3, 1, *SIZE)
    rise = np.diff(np.asarray(series, np.float64).mean((1, 2, 3)))
    np.testing.assert_allclose(rise, 0.5 * 100.0 * 2.0, rtol=0.05)  # K mu_I t


def test_what_is_no_settings_is_refused():
    with pytest.raises(TypeError, match="settings is a dict: expected Settings"):
        MODEL.sample(KEY, FLAT, {"iso": 100})
    with pytest.raises(ValueError, match="iso is None: give a number"):  # among `in_axes` None is one
        MODEL.sample(KEY, FLAT, Settings(iso=None))
    for frames in (True, None):
        with pytest.raises(ValueError, match=f"frames must be a whole number from 1, got {frames}"):
            Settings(frames=frames)


def test_a_recording_is_drawn_at_its_settings_and_at_a_known_exposure():
    frames = np.zeros((3, 4, 4), np.uint16)
    known = Recording(frames, "RGGB", (0.0,) * 4, 1023.0, kind="dark", exposure_s=0.0, temperature_c=-5.0)
    assert settings_of(known, 400.0, 7) == Settings(400.0, 0.0, -5.0, 7)
    unknown = dataclasses.replace(known, exposure_s=None)
    assert settings_of(unknown, 400.0, 7).exposure_s == Settings().exposure_s
