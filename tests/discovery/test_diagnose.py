"""The whole run on small capture sets: what is there is named, what is not there is not."""

from __future__ import annotations

import dataclasses
import json

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.frames import simulate
from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.report.document import document
from cannoise_jax.discovery.search.limits import mde
from cannoise_jax.mechanisms import VOCABULARY
from cannoise_jax.networks import Generator
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.recordings.recording import BadInput, CaptureSet
from cannoise_jax.sampling import SMALLEST, make_model
from tests.discovery.capture import (
    capture_set,
    column_pattern,
    frame_offsets,
    offset_map,
    response_map,
    row_offsets,
    wave,
)


def run(capture, **more):
    return diagnose(capture, compare=False, **more)


@pytest.mark.parametrize(("sets", "most"), [(2, 0), pytest.param(8, 1, marks=pytest.mark.slow)])
def test_nothing_is_found_where_nothing_is(sets, most):
    alarms = [run(capture_set(seed)).findings for seed in range(sets)]
    assert sum(bool(a) for a in alarms) <= most, alarms


@pytest.mark.parametrize(
    "mechanism, alter, amplitude",
    [
        pytest.param("row_noise", row_offsets(1.2), 1.2, marks=pytest.mark.slow),
        pytest.param("column_fpn", column_pattern(1.0), 1.0, marks=pytest.mark.slow),
        ("prnu", response_map(0.006), 0.006),
        pytest.param("dsnu", offset_map(2.5), 2.5, marks=pytest.mark.slow),
        pytest.param("offset_drift", frame_offsets(0.8), 0.8, marks=pytest.mark.slow),
        pytest.param("banding", wave(1.2), 1.2, marks=pytest.mark.slow),
    ],
)
def test_a_single_effect_is_named_and_measured(mechanism, alter, amplitude):
    found = run(capture_set(11, alter))
    assert found.findings[:1] == [mechanism], found.findings
    proof = found.proofs[0]
    assert proof.gain > 0
    tolerance = 0.5 if mechanism == "offset_drift" else 0.2
    assert proof.score.amplitude == pytest.approx(amplitude, rel=tolerance)


def test_an_effect_without_its_name_is_unknown_with_its_place_in_the_grammar():
    hidden = ("row_noise", "row_pink_noise")
    found = run(capture_set(11, row_offsets(1.5)), without=hidden)
    assert found.findings[0] == "unknown"
    assert not set(hidden) & set(found.testable)
    card = document(found, key=0, version="0")["findings"][0]["card"]
    assert card["axes"]["varies_over"] == "row" and card["axes"]["time"] == "redrawn"
    assert any(m.mechanism.startswith("unknown") for m in found.model.mechanisms)


def test_stated_gain_is_judged_only_when_asked():
    good = capture_set(3)
    wrong = CaptureSet(
        good.camera,
        tuple(dataclasses.replace(r, shot=tuple(1.3 * v for v in r.shot)) for r in good.recordings),
    )
    assert run(wrong).findings == []
    found = run(wrong, simulator="nlf")
    assert found.findings == ["gain_error"]
    assert "gain_error" not in run(wrong).testable


def test_a_stated_noise_of_none_is_judged():
    good = capture_set(3, kinds="df", size=(64, 64))
    wrong = CaptureSet(
        good.camera,
        tuple(dataclasses.replace(r, shot=(0.0,) * 4, read=(-1e-9,) * 4) for r in good.recordings),
    )
    assert set(run(wrong, simulator="nlf").findings) == {"gain_error", "read_noise_error"}


@pytest.mark.parametrize(
    "isos", [(None, 100.0), pytest.param((0.0, 0.0), marks=pytest.mark.slow), (50.0, None)]
)
def test_gain_settings_that_are_not_stated_or_zero_are_modelled(isos):
    capture = capture_set(3, kinds="df", size=(64, 64))
    parts = tuple(dataclasses.replace(r, iso=isos[n % 2]) for n, r in enumerate(capture.recordings))
    model = run(CaptureSet("c", parts)).model
    assert np.size(model.iso) == len(set(isos)) and np.all(np.diff(model.iso) > 0) and np.min(model.iso) > 0


@pytest.mark.parametrize("stated", [True, False])
def test_flats_at_one_level_are_judged(stated):
    capture = capture_set(8, row_offsets(8.0), kinds="f", size=(64, 64))
    flat = capture.recordings[2]
    flat = flat if stated else dataclasses.replace(flat, shot=None, read=None, iso=None, exposure_s=None)
    found = run(CaptureSet("c", (flat,)))
    field = found.first.fields[0]
    assert field.usable.all() and found.testable
    true = np.sqrt(1.5 * 0.3 * 16183 + 4.5**2 + 8.0**2)
    assert np.median(field.sigma) == pytest.approx(true, rel=0.05)


def test_a_run_that_may_name_nothing_still_looks():
    capture = capture_set(4, kinds="d", size=(64, 64))
    found = run(capture, mechanisms=())
    assert document(found, key=0, version="0")["verdict"] == "match"


def test_a_wrong_black_level_is_bookkeeping():
    good = capture_set(4)
    wrong = CaptureSet(
        good.camera, tuple(dataclasses.replace(r, black_level=(190.0,) * 4) for r in good.recordings)
    )
    assert run(wrong).findings == ["bookkeeping"]


@pytest.mark.parametrize(
    "kinds, frames",
    [
        ("d", 8),
        ("f", 4),
        ("s", 4),
        ("s", 1),
        ("d", 1),
        ("f", 2),
        pytest.param("d", 3, marks=pytest.mark.slow),
    ],
)
def test_any_part_of_a_capture_set_gives_a_report(kinds, frames):
    capture = capture_set(5, kinds=kinds, frames=frames)
    found = run(capture)
    report = document(found, key=0, version="0")
    json.dumps(report, allow_nan=False)
    listed = set(report["testable"]) | {n["mechanism"] for n in report["not_testable"]}
    assert listed == set(VOCABULARY) - {"unknown"}
    assert not set(report["testable"]) & {n["mechanism"] for n in report["not_testable"]}
    assert all(f["class"] != "sensor" for f in report["findings"]), report["findings"]


def test_scene_without_reference_and_settings_gives_a_report():
    capture = capture_set(6, kinds="s")
    bare = CaptureSet(
        "x",
        tuple(
            dataclasses.replace(
                r, clean=None, reference=None, iso=None, exposure_s=None, shot=None, read=None, cfa="MONO"
            )
            for r in capture.recordings
        ),
    )
    found = run(bare)
    assert "prnu" not in found.testable
    assert found.findings == []


@pytest.mark.slow
def test_the_minimum_detectable_row_noise_is_that_of_its_signature():
    limit = mde("row_noise", capture_set(0))
    assert limit is not None
    shifts = []
    for seed in range(6):
        capture = capture_set(seed, row_offsets(limit * 2))
        prepared = prepare(capture, [list(range(r.count)) for r in capture.recordings], False)
        signature = next(p for p in prepared.signatures if p.name == "row_additive_temporal")
        score = signature.score(prepared.fields)
        assert score is not None
        shifts.append(score.amplitude**2 / score.shift**2)
    # Four times the variance of the limit; what is frozen in the frames costs the signature a frame of each.
    assert np.mean(shifts) == pytest.approx(4 * 5 * np.sqrt(7 / 8), rel=0.15)


def test_what_a_sensor_model_has_already_is_no_mismatch():
    capture = capture_set(14, row_offsets(2.0), kinds="d")
    plain = SensorModel.poisson_gaussian(1.5, 3.0, 200.0, 16383.0)
    full = plain.with_mechanism("row_noise", sigma_dn=2.0)
    assert run(capture, simulator=plain).findings == ["row_noise"]
    assert run(capture, simulator=full).findings == []


def test_a_function_is_a_simulator_and_its_gain_is_judged():
    def camera(key, clean, settings):
        signal = clean * 16183.0
        noise = jax.random.normal(key, clean.shape) * jnp.sqrt(1.5 * 1.4 * signal + 4.5**2)
        return 200.0 + signal + noise

    assert "gain_error" in run(capture_set(15), simulator=camera).findings
    for wrong in (lambda key, clean, settings: clean[1:], lambda key, clean, settings: [clean, clean]):
        with pytest.raises(BadInput, match="must return"):
            run(capture_set(15, kinds="d"), simulator=wrong)
    with pytest.raises(BadInput, match="simulator: draws one and the same frame"):
        run(capture_set(15, kinds="d"), simulator=lambda key, clean, settings: 200 + clean)


@flax.struct.dataclass
class Untrained:
    """As much of a model as is asked of one that draws nothing."""

    level: str = flax.struct.field(pytree_node=False, default="both")


@pytest.mark.parametrize("size, cfa", [((66, 98), "GRBG"), ((67, 97), "MONO"), ((32, 44), "RGGB")])
def test_a_generator_is_given_sizes_that_it_takes(size, cfa, monkeypatch, tmp_path):
    def no_noise(model, key, clean, references):
        height, width = clean.shape[-3:-1]
        assert min(height, width) >= SMALLEST and not height % 2 and not width % 2 and references.size
        return jnp.zeros_like(clean)

    monkeypatch.setattr(simulate, "load_model", lambda path: Untrained())
    monkeypatch.setattr(simulate, "sample_noise", no_noise)
    flat = dataclasses.replace(capture_set(3, kinds="f", size=size).recordings[0], cfa=cfa)
    draw = simulate.open_simulator(tmp_path, CaptureSet("c", (flat,))).draw
    clean = np.random.default_rng(0).uniform(0, 1, size).astype(np.float32)
    drawn = draw(jax.random.key(0), clean, Settings(iso=100.0, exposure_s=0.01))
    np.testing.assert_allclose(drawn, 200 + clean * 16183, atol=0.01)


def test_a_generator_of_one_exposure_draws_its_darks_and_leaves_others_to_its_sensor(monkeypatch, tmp_path):
    sensor = SensorModel.poisson_gaussian(2.0, 3.0, 200.0, 4095.0, "RGGB", camera="c")
    sensor = sensor.with_mechanism("dsnu", sigma_dn=40.0).with_maps((32, 32))
    model = make_model(Generator(), {"params": {}}, None, {}, level="given", exposure_s=10.0)

    def told(model, key, clean, references, nlf):
        return jnp.full_like(clean, nlf[0])  # traced: shows that the sensor's own gain is told

    monkeypatch.setattr(simulate, "load_model", lambda path: dataclasses.replace(model, sensors=(sensor,)))
    monkeypatch.setattr(simulate, "sample_noise", told)
    flat = dataclasses.replace(capture_set(3, kinds="f", size=(64, 64)).recordings[0], camera="c")
    found = simulate.open_simulator(tmp_path, CaptureSet("c", (flat,)))
    assert found.dark
    dark = np.zeros((64, 48), np.float32)
    drawn = found.draw(jax.random.key(0), dark, Settings(exposure_s=10.0))
    np.testing.assert_allclose(drawn, 202, atol=0.01)
    frames = np.asarray(found.draw(jax.random.key(0), dark, Settings(exposure_s=0.01, frames=8)), float)
    pattern = frames.mean(0)
    # The map of 32 x 32 goes round.
    assert frames.shape == (8, 64, 48)
    assert np.corrcoef(pattern[:32].ravel(), pattern[32:].ravel())[0, 1] > 0.95


def test_bad_requests_say_what_is_wrong():
    capture = capture_set(0, kinds="d")
    with pytest.raises(BadInput, match="no such simulator"):
        run(capture, simulator="nonsense")
    with pytest.raises(ValueError, match="no such mechanism: known: "):
        run(capture, without=("zzzzz",))
    with pytest.raises(ValueError, match=r"prn: no such mechanism: did you mean prnu\?$"):
        run(capture, without=("prn",))
    with pytest.raises(ValueError, match="alpha"):
        run(capture, alpha=2.0)
    with pytest.raises(BadInput, match="30x64 pixels: give 32x32 or more"):
        run(capture_set(0, kinds="d", size=(30, 64)))


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_recordings_no_larger_than_a_tile_give_a_report():
    found = run(capture_set(3, kinds="df", size=(64, 64)))
    assert not found.findings
