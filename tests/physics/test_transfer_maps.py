"""A calibrated unit keeps its own patterns, at the strength that was measured, and none of the noise."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from cannoise_jax.mechanisms import LISTED, MECHANISMS
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.core.sensor_json import write_sensor
from cannoise_jax.physics.transfer.estimators.lines import columns_apart, row_groups, row_noise
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.maps import shrunk
from cannoise_jax.physics.transfer.model import Finding, find_mechanisms, placed, sensor_model
from cannoise_jax.physics.transfer.photon_transfer import transfer_at
from cannoise_jax.recordings import Recording
from cannoise_jax.recordings.recording import per_channel

SIZE = (96, 128)
BASE = SensorModel.poisson_gaussian(2.0, 3.0, 256, 16383, "RGGB", unit_key=jax.random.key(4))


def recorded(camera, kind, level=0.0, exposure_s=0.1, frames=16, seed=0):
    clean = np.full(SIZE, level, np.float32)
    codes = camera.sample(jax.random.key(seed), clean, Settings(exposure_s=exposure_s, frames=frames))
    return Recording(
        np.asarray(codes),
        "RGGB",
        per_channel(256.0),
        16383.0,
        kind=kind,
        exposure_s=exposure_s,
        camera="made",
    )


def calibrated(*recordings):
    transfer = transfer_at([frame_statistics(r) for r in recordings])
    return sensor_model([transfer], find_mechanisms(transfer.statistics, transfer.baseline, LISTED))


def drawn(model, id):
    """The first map of a mechanism."""
    fitted = next(f for f in model.mechanisms if f.mechanism == id)
    return np.asarray(next(iter(fitted.maps.values())))[0]


@pytest.fixture(scope="module")
def truth():
    camera = BASE.with_mechanism("prnu", sigma=0.01).with_mechanism("dsnu", sigma_dn=3.0)
    camera = camera.with_mechanism("row_fpn", sigma_dn=2.0).with_mechanism("green_imbalance", sigma=0.0007)
    return camera.with_mechanism("hot_pixels", e_per_s=150.0, fraction=0.01).with_maps(SIZE)


@pytest.fixture(scope="module")
def transfer_and_findings(truth):
    shots = (
        recorded(truth, "dark", seed=1),
        recorded(truth, "dark", exposure_s=10.0, seed=2),
        recorded(truth, "flat", 0.5, seed=3),
    )
    transfer = transfer_at([frame_statistics(r) for r in shots])
    return transfer, find_mechanisms(transfer.statistics, transfer.baseline, LISTED)


@pytest.fixture(scope="module")
def found(transfer_and_findings):
    transfer, findings = transfer_and_findings
    return sensor_model([transfer], findings)


@pytest.mark.parametrize("id, least", [("prnu", 0.8), ("dsnu", 0.7), ("row_fpn", 0.95), ("hot_pixels", 0.97)])
def test_the_stored_maps_are_those_of_the_unit(truth, found, id, least):
    ours, theirs = np.broadcast_to(drawn(found, id), SIZE), np.broadcast_to(drawn(truth, id), SIZE)
    assert np.corrcoef(ours.ravel(), theirs.ravel())[0, 1] > least
    if id != "hot_pixels":  # maps have unit rms: the strength stands beside them
        assert ours.std() == pytest.approx(1.0, rel=0.1)
    else:
        assert ((ours > 0) & (theirs > 0)).sum() > 0.8 * (theirs > 0).sum()
        assert (ours > 0).sum() < 1.1 * (theirs > 0).sum()


def test_the_file_keeps_the_unit_and_another_unit_is_another(found, tmp_path):
    path = tmp_path / "sensor.json"
    write_sensor(path, found)
    again = SensorModel.load(path)
    assert path.with_suffix(".npz").exists() and '"sha256"' in path.read_text()
    for id in ("prnu", "dsnu", "row_fpn", "hot_pixels"):
        np.testing.assert_array_equal(drawn(again, id), drawn(found, id))
    other = again.with_unit(jax.random.key(9)).with_maps(SIZE)
    assert abs(np.corrcoef(drawn(other, "dsnu").ravel(), drawn(found, "dsnu").ravel())[0, 1]) < 0.05
    dark = np.zeros(SIZE, np.float32)
    first, second = (
        np.asarray(again.sample(jax.random.key(k), dark, Settings(exposure_s=0.1, frames=16))).mean(0)
        for k in (0, 1)
    )
    assert np.corrcoef(first.ravel(), second.ravel())[0, 1] > 0.6


def test_what_noise_hides_is_drawn_at_full_strength():
    rng = np.random.default_rng(0)
    pattern, noise, rest = (s * rng.normal(size=40000) for s in (0.5, 2.0, 1.0))
    map_of = shrunk(pattern + noise, 0.5, 4.0, rest)
    assert map_of.std() == pytest.approx(1.0, rel=0.02)
    # Of the noise no more gets in than of the pattern's own share: 1 part in 17 of the variance is seen.
    assert np.corrcoef(map_of, noise)[0, 1] == pytest.approx(np.sqrt(1 / 17) * np.sqrt(16 / 17), abs=0.02)


def test_rows_that_are_read_together_are_found():
    for count, phase in ((2, 1), (4, 3)):
        place = Point("readout", "signal", "row", "redrawn", group=count, phase=phase)
        camera = BASE.with_mechanism("row_noise", point=place, sigma_dn=3.0)
        dark = frame_statistics(recorded(camera, "dark", frames=8))
        assert row_groups(dark) == (count, phase) and not columns_apart(dark)
    for other in ("row_noise", "row_pink_noise"):
        dark = frame_statistics(recorded(BASE.with_mechanism(other, sigma_dn=3.0), "dark", frames=8))
        assert row_groups(dark) is None and not columns_apart(dark)


def test_even_and_odd_columns_may_have_row_offsets_of_their_own():
    place = Point("readout", "signal", "row", "redrawn", group=2, phase=1, interleave=2)
    camera = BASE.with_mechanism("row_noise", point=place, sigma_dn=4.0)
    dark = frame_statistics(recorded(camera, "dark", frames=8))
    measured = row_noise([dark])
    finding = placed(Finding(MECHANISMS["row_noise"], measured, "in the model"), dark)
    assert (finding.point.group, finding.point.phase, finding.point.interleave) == (2, 1, 2)
    assert finding.estimates["sigma_dn"].value == pytest.approx(4.0, rel=0.1)
    assert "even and odd columns apart" in finding.because


def test_trifles_do_not_enter(transfer_and_findings, found):
    verdicts = {f.mechanism: f.verdict for f in transfer_and_findings[1]}
    assert verdicts["prnu"] == verdicts["dsnu"] == verdicts["hot_pixels"] == "in the model"
    assert verdicts["green_imbalance"] == "too small to matter"
    assert "green_imbalance" not in {f.mechanism for f in found.mechanisms}


@pytest.mark.slow
def test_the_model_gives_back_the_noise_that_was_measured():
    """Crosstalk and telegraph pixels are in the baseline of photon transfer, and must not count twice."""
    camera = BASE.with_mechanism("crosstalk", fraction=0.06)
    camera = camera.with_mechanism("rts", jump_dn=60.0, fraction=0.05, rate=0.4).with_maps(SIZE)
    shots = {"dark": recorded(camera, "dark", seed=1), "flat": recorded(camera, "flat", 0.5, seed=3)}
    model = calibrated(*shots.values())
    assert {"crosstalk", "rts"} <= {f.mechanism for f in model.mechanisms}
    np.testing.assert_allclose(model.gain_dn_per_e, 2.0, rtol=0.04)
    np.testing.assert_allclose(model.read_noise_e, 3.0, rtol=0.05)
    for kind, level in (("dark", 0.0), ("flat", 0.5)):
        again = recorded(model, kind, level, seed=7)
        sigma = [np.asarray(r.frames, float).std(0, ddof=1) for r in (shots[kind], again)]
        assert np.median(sigma[1]) == pytest.approx(np.median(sigma[0]), rel=0.02)
        assert np.mean(sigma[1]) == pytest.approx(np.mean(sigma[0]), rel=0.04)


def test_rows_of_alternate_columns_are_no_wave():
    point = Point("readout", "signal", "row", "redrawn", group=2, interleave=2)
    camera = BASE.with_mechanism("pairs", point=point, sigma_dn=5.0)
    shots = recorded(camera, "dark", seed=1), recorded(camera, "flat", 0.5, seed=2)
    transfer = transfer_at([frame_statistics(r) for r in shots])
    lines = [MECHANISMS[id] for id in ("row_noise", "row_pink_noise", "banding")]
    found = {f.mechanism: f for f in find_mechanisms(transfer.statistics, transfer.baseline, lines)}
    assert found["row_noise"].point is not None and found["row_noise"].point.interleave == 2
    assert found["banding"].verdict != "in the model"


@pytest.mark.parametrize("lines", [pytest.param(0.0, marks=pytest.mark.slow), 0.003])
def test_maps_have_the_means_of_rows_and_columns_that_were_recorded(lines):
    """Of independent pixels too, beside columns that have gains of their own or not."""
    camera = BASE.with_mechanism("prnu", sigma=0.01)
    if lines:
        camera = camera.with_mechanism("column_gain", sigma=lines)
    camera = camera.with_maps(SIZE)
    shots = [recorded(camera, "dark", seed=1), recorded(camera, "flat", 0.4, seed=2)]
    model = calibrated(*shots, recorded(camera, "flat", 0.1, seed=3))

    def response(of):
        out = np.zeros(SIZE)
        for fitted in of.mechanisms:
            out = out + float(np.mean(fitted.parameters["sigma"])) * drawn(of, fitted.mechanism)
        return out - out.mean()

    true, told = response(camera), response(model)
    for axis in (0, 1):
        assert told.mean(axis).std() == pytest.approx(true.mean(axis).std(), rel=0.15)
        assert np.corrcoef(told.mean(axis), true.mean(axis))[0, 1] > 0.7
