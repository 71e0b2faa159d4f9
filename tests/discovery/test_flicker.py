"""Mains light through a rolling shutter, from just above the noise to a hundred times it."""

import dataclasses

import jax
import numpy as np
import pytest

from cannoise_jax.discovery.frames.splits import prepare_split, split_recordings
from cannoise_jax.discovery.search.declare import registered
from cannoise_jax.discovery.search.fit import stepwise
from cannoise_jax.discovery.search.model import extended_model
from cannoise_jax.physics.core.sensor import Settings
from tests.discovery.capture import capture_set

SIZE = (192, 128)
PERIOD = 41.3


def flickering(strength, colours=(1.0, 1.0, 1.0, 1.0)):
    """A sinusoid of the light along the rows, its phase new in every frame; strength by mosaic site."""
    site = 2 * (np.arange(SIZE[0])[:, None] % 2) + np.arange(SIZE[1])[None] % 2

    def alter(rng):
        def change(dn, signal, kind, exposure):
            wave = np.cos(2 * np.pi * (np.arange(SIZE[0]) / PERIOD + rng.random()))[:, None]
            wave = wave + 0.1 * wave**2
            share = strength * np.asarray(colours)[site] * wave
            return dn + signal * share

        return change

    return alter


def looked_at(capture):
    first = prepare_split(capture, split_recordings(capture))
    return first, stepwise(
        first.fields, first.signatures, frozenset(e.id for e in registered(())), np.log(0.01)
    )


@pytest.mark.parametrize("kinds", ["df", pytest.param("sdf", marks=pytest.mark.slow)])
def test_strong_flicker_is_named_and_does_not_bend_the_photon_transfer_curve(kinds):
    capture = capture_set(3, flickering(0.2, (1.0, 0.95, 0.95, 0.85)), kinds=kinds, size=SIZE)
    first, fitted = looked_at(capture)
    np.testing.assert_allclose(first.baselines[0].gain, 1.5, rtol=0.03)
    np.testing.assert_allclose(first.baselines[0].read_noise, 4.5, rtol=0.05)
    found = fitted.steps[0].named
    assert found.mechanism == "flicker"
    assert found.score.amplitude == pytest.approx(0.2 * 0.94, rel=0.05)
    assert found.score.where["period_px"] == pytest.approx(PERIOD, rel=0.05)
    (said,) = (
        dict(m.parameters)
        for m in extended_model(capture, first, fitted.steps).mechanisms
        if m.record.id == "flicker"
    )
    got = np.array([said["amplitude"] * said[f"share_{s}"] for s in ("00", "01", "10", "11")], float)
    np.testing.assert_allclose(got / got[0], [1.0, 0.95, 0.95, 0.85], rtol=0.02)
    assert got.mean() == pytest.approx(0.2 * 0.94, rel=0.05)


@pytest.mark.slow
def test_the_extended_model_flickers_at_the_gain_of_the_camera():
    capture = capture_set(3, flickering(0.2), kinds="df", size=SIZE)
    first, fitted = looked_at(capture)
    model = extended_model(capture, first, fitted.steps)
    np.testing.assert_allclose(model.gain_dn_per_e, 1.5, rtol=0.04)
    drawn = np.asarray(
        model.sample(jax.random.key(0), np.full(SIZE, 0.5, np.float32), Settings(100.0, 0.01, None, 8)), float
    )
    rows = drawn.mean(2) - 200
    assert np.std(rows / rows.mean()) == pytest.approx(0.2 / np.sqrt(2), rel=0.15)
    within = drawn - drawn.mean(2, keepdims=True)
    assert within.var() == pytest.approx(1.5 * rows.mean() + 4.5**2, rel=0.06)


def test_white_offsets_of_rows_of_light_are_no_flicker():
    def alter(rng):
        return lambda dn, signal, kind, t: dn + 0.05 * signal * rng.standard_normal((dn.shape[0], 1))

    first, fitted = looked_at(capture_set(5, alter, kinds="df", size=SIZE))
    assert [(s.named.mechanism, s.named.signature.name) for s in fitted.steps] == [
        ("unknown", "row_relative_temporal")
    ]
    np.testing.assert_allclose(first.baselines[0].gain, 1.5, rtol=0.03)


@pytest.mark.slow
def test_steady_light_leaves_the_curve_as_it_is():
    capture = capture_set(6, kinds="sdf", size=SIZE)
    first, fitted = looked_at(capture)
    assert not fitted.steps
    np.testing.assert_allclose(first.baselines[0].gain, 1.5, rtol=0.02)


@pytest.mark.slow
def test_drift_of_the_light_is_not_taken_for_the_level_of_a_weak_sinusoid():
    """A period and a half to the frame: its phases reach the level of a frame, by far less than the drift."""

    def alter(rng):
        def change(dn, signal, kind, exposure):
            wave = np.cos(2 * np.pi * (1.5 * np.arange(SIZE[0]) / SIZE[0] + rng.random()))[:, None]
            return dn + signal * (0.01 * wave + 0.02 * rng.standard_normal())

        return change

    _, fitted = looked_at(capture_set(7, alter, kinds="df", size=SIZE))
    assert {s.named.mechanism for s in fitted.steps} == {"flicker", "illumination_drift"}


@pytest.mark.slow
def test_row_noise_is_measured_beside_a_lamp_that_flickers_in_no_sinusoid():
    """What rows of light share beside the sinusoid is not read as offsets of rows, which the darks tell."""

    def lamp(rng):
        def change(dn, signal, kind, exposure):
            turn = np.abs(np.sin(np.pi * (np.arange(SIZE[0]) / PERIOD + rng.random())))[:, None]
            return dn + 0.3 * signal * (turn - turn.mean()) + 1.0 * rng.standard_normal((SIZE[0], 1))

        return change

    _, fitted = looked_at(capture_set(5, lamp, kinds="df", size=SIZE))
    found = {s.named.mechanism: s.named.score for s in fitted.steps}
    assert {"flicker", "row_noise"} <= set(found) and "row_pink_noise" not in found
    assert found["row_noise"].amplitude == pytest.approx(1.0, rel=0.08)


@pytest.mark.slow
def test_each_colours_own_wave_is_in_the_model():
    """Blue is a quarter stronger and later than green, as phosphors are: one wave would miss by far more than
    the noise."""
    shares, late = np.array([1.0, 0.95, 1.3, 1.0]), np.array([0.0, 0.14, -0.25, 0.0])
    site = 2 * (np.arange(SIZE[0])[:, None] % 2) + np.arange(SIZE[1])[None] % 2

    def lamp(rng):
        def change(dn, signal, kind, exposure):
            turn = 2 * np.pi * (np.arange(SIZE[0])[:, None] / PERIOD + rng.random())
            return dn + signal * 0.2 * shares[site] * np.cos(turn - late[site])

        return change

    capture = capture_set(4, lamp, kinds="df", size=SIZE)
    first, fitted = looked_at(capture)
    model = extended_model(capture, first, fitted.steps)
    (said,) = (dict(m.parameters) for m in model.mechanisms if m.record.id == "flicker")
    got = np.array([said["amplitude"] * said[f"share_{s}"] for s in ("00", "01", "10", "11")], float)
    np.testing.assert_allclose(got, 0.2 * shares, rtol=0.02)
    phases = np.array([said[f"late_{s}"] for s in ("00", "01", "10", "11")], float)
    np.testing.assert_allclose(phases - phases[0], late, atol=0.01)
    assert float(said["frequency"]) == pytest.approx(1 / PERIOD, abs=2e-5)


@pytest.mark.slow
def test_light_that_moves_is_not_taken_for_offsets_of_frames():
    """One flat, whose light moves by fifty times the offsets of darks: each by its own amount."""

    def alter(rng):
        def change(dn, signal, kind, exposure):
            lamp = 0.003 * rng.standard_normal() if kind == "flat" else 0.0
            return dn + 0.6 * rng.standard_normal() + lamp * signal

        return change

    capture = capture_set(12, alter, kinds="df", size=SIZE, frames=8)
    recordings = (*capture.recordings[:2], capture.recordings[-1])
    _, fitted = looked_at(dataclasses.replace(capture, recordings=recordings))
    found = {s.named.mechanism: s.named.score.amplitude for s in fitted.steps}
    assert set(found) == {"offset_drift", "illumination_drift"}
    assert found["offset_drift"] == pytest.approx(0.6, rel=0.35)
    assert found["illumination_drift"] == pytest.approx(0.003, rel=0.45)
