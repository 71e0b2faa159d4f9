"""The extended model draws what was found: as strong, in the same place, with or without a name."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from scipy import stats

from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.frames.simulate import simulate_like
from cannoise_jax.discovery.frames.splits import prepare_split, split_recordings
from cannoise_jax.discovery.search.declare import registered
from cannoise_jax.discovery.search.fit import stepwise
from cannoise_jax.discovery.search.model import baseline_model, extended_model, with_addition
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.core.sensor_json import write_sensor
from cannoise_jax.physics.core.settings import ExtrapolationWarning
from cannoise_jax.physics.transfer.model import measured_at
from cannoise_jax.signatures.covariance import neighbour_kernel
from cannoise_jax.signatures.handed import Addition
from tests.discovery.capture import (
    SIZE,
    capture_set,
    column_pattern,
    frame_offsets,
    offset_map,
    response_map,
    row_offsets,
)


def looked_at(capture):
    return prepare_split(capture, split_recordings(capture))


def found(capture, without=()):
    first = looked_at(capture)
    fitted = stepwise(
        first.fields, first.signatures, frozenset(e.id for e in registered(without)), float(np.log(0.01))
    )
    return first, fitted.steps


@pytest.mark.parametrize(
    "alter, hidden, expected",
    [
        pytest.param(row_offsets(2.0), (), "row_noise", marks=pytest.mark.slow),
        pytest.param(
            row_offsets(2.0),
            ("row_noise", "row_pink_noise"),
            "unknown_row_additive_temporal",
            marks=pytest.mark.slow,
        ),
        pytest.param(offset_map(3.0), (), "dsnu", marks=pytest.mark.slow),
        (response_map(0.01), ("prnu",), "unknown_pixel_relative_static"),
    ],
)
def test_draws_show_the_finding_as_strong_as_the_recordings_did(alter, hidden, expected):
    capture = capture_set(51, alter, kinds="df")
    first, steps = found(capture, hidden)
    model = extended_model(capture, first, steps[:1])
    assert [f.mechanism for f in model.mechanisms] == [expected]
    again = looked_at(simulate_like(capture, model.sample, jax.random.key(0), True))
    named = steps[0].named
    signature = next(p for p in again.signatures if p.name == named.signature.name)
    score = signature.score(again.fields)
    assert score.amplitude == pytest.approx(named.score.amplitude, abs=4 * named.score.error, rel=0.1)
    # The noise that the effect was part of is not counted twice.
    for before, after in zip(first.baselines, again.baselines, strict=True):
        np.testing.assert_allclose(after.read_noise, before.read_noise, rtol=0.04)
        np.testing.assert_allclose(after.gain, before.gain, rtol=0.04)


def test_a_frozen_pattern_is_this_camera_s_own():
    rng = np.random.default_rng(0)
    pattern = 2.0 * rng.standard_normal((1, SIZE[1]))
    capture = capture_set(52, lambda rng: lambda dn, signal, kind, t: dn + pattern, kinds="d")
    first, steps = found(capture)
    model = extended_model(capture, first, steps)
    drawn = np.asarray(
        model.sample(jax.random.key(0), np.zeros(SIZE, np.float32), Settings(100.0, 0.01, None, 64))
    )
    columns = drawn.mean((0, 1)) - drawn.mean()
    assert np.corrcoef(columns, pattern[0])[0, 1] > 0.95
    assert np.std(columns) == pytest.approx(np.std(pattern), rel=0.1)
    other = model.with_unit(jax.random.key(9)).sample(
        jax.random.key(0), np.zeros(SIZE), Settings(100.0, 0.01)
    )
    assert abs(np.corrcoef(np.asarray(other).mean((0, 1)), pattern[0])[0, 1]) < 0.4


def test_read_noise_is_that_of_short_darks_though_others_are_noisier():
    """Light that flickers and dark current that the clamp hides bend the line that the baseline is fitted
    to."""

    def alter(rng):
        def change(dn, signal, kind, exposure):
            flicker = 0.02 * signal * rng.standard_normal((dn.shape[0], 1))
            return dn + flicker + 80 * exposure * rng.standard_normal(dn.shape)

        return change

    capture = capture_set(57, alter, kinds="df")
    first, steps = found(capture)
    model = extended_model(capture, first, steps)
    drawn = np.asarray(
        model.sample(jax.random.key(0), np.zeros(SIZE, np.float32), Settings(100.0, 0.01, None, 8)), float
    )
    temporal = np.sqrt(np.median(drawn.var(0, ddof=1)) * 7 / stats.chi2.median(7))
    assert temporal == pytest.approx(np.hypot(4.5, 0.8), rel=0.05)
    assert first.baselines[0].read_noise.min() > 1.3 * temporal


def test_what_whole_frames_share_does_not_lower_the_noise_of_pixels():
    """The baseline is fitted without drift of whole frames: none of it may be taken out of the read noise."""
    capture = capture_set(58, frame_offsets(4.0), kinds="df")
    first, steps = found(capture)
    assert [s.named.mechanism for s in steps] == ["offset_drift"]
    model = extended_model(capture, first, steps)
    drawn = np.asarray(
        model.sample(jax.random.key(0), np.zeros(SIZE, np.float32), Settings(100.0, 0.01, None, 8)), float
    )
    within = (drawn - drawn.mean((1, 2), keepdims=True)).std()
    assert within == pytest.approx(4.5, rel=0.03)
    assert drawn.mean((1, 2)).std() > 1.5


def test_an_unnamed_model_survives_its_file(tmp_path):
    capture = capture_set(53, column_pattern(2.0), kinds="d")
    first, steps = found(capture, ("column_fpn", "dsnu", "column_noise"))
    model = extended_model(capture, first, steps)
    assert model.mechanisms and all(f.mechanism.startswith("unknown") for f in model.mechanisms)
    write_sensor(tmp_path / "sensor.json", model)
    read = SensorModel.load(tmp_path / "sensor.json")
    clean, settings = np.zeros(SIZE, np.float32), Settings(100.0, 0.01, None, 2)
    both = [np.asarray(m.sample(jax.random.key(1), clean, settings)) for m in (model, read)]
    np.testing.assert_array_equal(*both)


def test_thermal_charge_keeps_the_temperature_at_which_it_was_found(recwarn):
    recordings = capture_set(59, kinds="d").recordings
    cold = [
        dataclasses.replace(r, temperature_c=-5.0 - n, exposure_s=9.0 - n) for n, r in enumerate(recordings)
    ]
    step = SimpleNamespace(named=SimpleNamespace(mechanism="dark_current"))
    model = SensorModel.poisson_gaussian(1.5, 2.0, 100.0, 1100.0)
    model = with_addition(model, step, Addition({"e_per_s": 2.0}), measured_at(cold))
    assert model.mechanisms[0].scaling.reference_temperature_c == -5.0
    model.sample(jax.random.key(0), np.zeros(SIZE, np.float32), Settings(100.0, 9.0, -5.0))
    assert not [w for w in recwarn if issubclass(w.category, ExtrapolationWarning)]


def test_without_findings_it_is_the_baseline():
    capture = capture_set(54, kinds="df")
    first = looked_at(capture)
    model, bare = extended_model(capture, first, ()), baseline_model(capture, first)
    assert model.mechanisms == () and np.array_equal(model.gain_dn_per_e, bare.gain_dn_per_e)
    np.testing.assert_allclose(bare.gain_dn_per_e, 1.5, rtol=0.05)


@pytest.mark.slow
def test_the_written_model_is_no_mismatch_to_its_own_recordings(tmp_path):
    capture = capture_set(55, row_offsets(2.0), kinds="df")
    run = diagnose(capture, compare=False)
    write_sensor(tmp_path / "sensor.json", run.model)
    again = diagnose(capture, str(tmp_path / "sensor.json"), compare=False)
    assert run.findings == ["row_noise"] and again.findings == []


@pytest.mark.slow
def test_a_function_gains_by_the_composite_score_and_has_no_likelihood():
    capture = capture_set(56, row_offsets(4.0), kinds="f", frames=4, size=(64, 96))
    capture = dataclasses.replace(capture, recordings=capture.recordings[:2])

    def camera(key, clean, settings):
        signal = clean * 16183.0
        return 200.0 + signal + jax.random.normal(key, clean.shape) * np.sqrt(1.5 * signal + 4.5**2)

    run = diagnose(capture, camera)
    assert "row_noise" in run.findings
    proof = run.proofs[run.findings.index("row_noise")]
    assert proof.basis == "composite" and proof.log_e is None and proof.gain > 0
    assert (
        run.proven.before is None and run.quality.after.composite.mean() > run.quality.before.composite.mean()
    )


def test_correlations_without_a_name_are_drawn_by_a_kernel_that_survives_its_file(tmp_path):
    wanted = {(0, 1): -0.08, (0, 2): 0.05, (1, 0): 0.04, (1, 1): -0.06}
    kernel, share = neighbour_kernel(list(wanted), list(wanted.values()))
    point = Point("readout", "signal", "pixel", "redrawn", spectrum="kernel", kernel=kernel)
    model = SensorModel.poisson_gaussian(1.0, 4.0 * np.sqrt(1 - share), 500.0)
    model = model.with_mechanism("unknown_lags", point=point, sigma_dn=float(4.0 * np.sqrt(share)))
    write_sensor(tmp_path / "sensor.json", model)
    read = SensorModel.load(tmp_path / "sensor.json")
    dark, settings = np.zeros((128, 128), np.float32), Settings(100.0, 0.01, None, 16)
    frames = np.asarray(read.sample(jax.random.key(0), dark, settings), float) - 500
    power = np.mean(frames**2)
    assert power == pytest.approx(16 + 1 / 12, rel=0.02)
    for (dy, dx), rho in {**wanted, (1, -1): 0.0, (3, 3): 0.0}.items():
        product = frames * np.roll(frames, (-dy, -dx), (1, 2))
        assert product.mean() / power == pytest.approx(rho, abs=0.008)


@pytest.mark.parametrize("over, step", [("diagonal", 1), ("antidiagonal", -1)])
def test_diagonal_offsets_are_shared_along_their_diagonal(over, step):
    point = Point("readout", "signal", over, "redrawn")
    model = SensorModel.poisson_gaussian(1.0, 2.0, 500.0).with_mechanism("unknown", point=point, sigma_dn=4.0)
    frames = np.asarray(
        model.sample(jax.random.key(1), np.zeros((64, 96)), Settings(100.0, 0.01, None, 4)), float
    )
    frames -= frames.mean()
    along = np.mean(frames * np.roll(frames, (-1, -step), (1, 2))) / np.mean(frames**2)
    across = np.mean(frames * np.roll(frames, (-1, step), (1, 2))) / np.mean(frames**2)
    assert along > 0.6 and abs(across) < 0.15


def test_a_dark_current_that_moves_is_not_drawn_twice():
    """Temperature drift beside a dark current adds its changes alone."""
    bare = SensorModel.poisson_gaussian(2.0, 3.0, 200.0, 4095.0)
    both = bare.with_mechanism("dark_current", e_per_s=50.0)
    both = both.with_mechanism("temperature_drift", sigma_k=1.0, e_per_s=50.0, memory_frames=1.0, base=0.0)
    setting = Settings(exposure_s=1.0, frames=256)
    drawn = np.asarray(both.sample(jax.random.key(0), np.zeros((32, 32), np.float32), setting), float)
    assert drawn.mean() == pytest.approx(200 + 2 * 50, abs=2.5)
    assert drawn.mean((1, 2)).std() == pytest.approx(2 * 50 * np.log(2) / 7, rel=0.15)
    closed = both.expected(np.zeros((32, 32), np.float32), setting)
    assert float(np.mean(closed)) == pytest.approx(drawn.mean(), abs=2.5)


def own_currents(mean, variation, clamped, gain=1.5):
    """Every pixel collects charge at its own rate, gamma-distributed, e-/s; a clamp takes the mean away."""

    def alter(rng):
        rate = rng.gamma(1 / variation**2, mean * variation**2, SIZE)

        def change(dn, signal, kind, exposure):
            taken = mean * exposure if clamped else 0.0
            return dn + gain * (rng.poisson(rate * exposure) - taken)

        return change

    return alter


@pytest.mark.parametrize("clamped", [pytest.param(False, marks=pytest.mark.slow), True])
def test_the_own_charge_of_pixels_brings_its_shot_noise(clamped):
    capture = capture_set(60, own_currents(800.0, 0.4, clamped), kinds="df", frames=12)
    first, steps = found(capture)
    names = {s.named.mechanism for s in steps}
    holder = "compensated_dark_current" if clamped else "dark_current"
    assert {"dsnu", holder} <= names
    model = extended_model(capture, first, steps)
    assert holder in [f.mechanism for f in model.mechanisms]
    held = next(f for f in model.mechanisms if f.mechanism == holder)
    assert held.parameters["variation"] == pytest.approx(0.4, rel=0.1)
    assert "dsnu" not in [f.mechanism for f in model.mechanisms]
    settings = Settings(100.0, 0.1, None, 200)
    drawn = np.asarray(model.sample(jax.random.key(0), np.zeros(SIZE, np.float32), settings), float)
    mean, variance = drawn.mean(0), drawn.var(0, ddof=1)
    truth = capture.recordings[1].frames.astype(float).mean(0)
    assert mean.std() == pytest.approx(truth.std(), rel=0.05)
    # Shot noise: the variance of a pixel grows with its mean as the gain says.
    assert np.polyfit(mean.ravel(), variance.ravel(), 1)[0] == pytest.approx(1.5, rel=0.1)
    # At strength zero each is apart, and the other as it was.
    for step in steps:
        silent = extended_model(capture, first, steps, silent=step)
        strength = {f.mechanism: f.parameters for f in silent.mechanisms}
        if step.named.signature.name == "pixel_thermal_static":
            assert strength["dsnu"]["sigma_dn"] == 0 and strength[holder]["variation"] == 0
        if step.named.mechanism == holder:
            assert strength[holder]["e_per_s"] == 0 and strength["dsnu"]["sigma_dn"] > 10


def test_what_differs_by_more_than_all_charge_is_an_offset():
    """A level of every pixel that grows with the exposure and goes below zero is none of a dark current."""

    def alter(rng):
        rate = 200.0 * rng.standard_normal(SIZE)
        return lambda dn, signal, kind, exposure: (
            dn + rate * exposure + 1.5 * rng.poisson(20 * exposure, SIZE)
        )

    capture = capture_set(61, alter, kinds="df", frames=12)
    first, steps = found(capture)
    model = extended_model(capture, first, steps)
    strengths = {f.mechanism: f.parameters for f in model.mechanisms}
    assert strengths["dsnu"]["sigma_dn"] == pytest.approx(20, rel=0.1)
    assert all(p.get("variation", 0) == 0 for p in strengths.values())
