"""Dead, stuck and masked pixels, made in plain NumPy: they are named, and move nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.commands.calibrate import calibrate
from cannoise_jax.mechanisms import MECHANISMS
from cannoise_jax.physics.core.sensor import Settings
from cannoise_jax.physics.transfer.estimate import NotMeasurable
from cannoise_jax.physics.transfer.model import sensor_model
from cannoise_jax.physics.transfer.photon_transfer import of_all_pixels
from cannoise_jax.recordings.recording import BadInput, CaptureSet, Recording

SIZE, GAIN, READ_E, BLACK, WHITE, PRNU = (96, 128), 0.8, 3.0, 120.0, 4095, 0.01


def recordings(defect, seed=1):
    """Flats of two levels and darks of one exposure. defect(codes, light) changes frames before they are
    stored."""
    rng = np.random.default_rng(seed)
    response = 1 + PRNU * rng.standard_normal(SIZE)
    out = []
    for kind, light, frames in (("flat", 800.0, 6), ("flat", 2500.0, 6), ("dark", 0.0, 10)):
        charge = rng.poisson(light * response, (frames, *SIZE))
        read = READ_E * rng.standard_normal((frames, *SIZE))
        codes = defect(BLACK + GAIN * (charge + read), BLACK + GAIN * read)
        codes = np.clip(np.rint(codes), 0, WHITE).astype(np.uint16)
        out.append(Recording(codes, "MONO", (BLACK,) * 4, float(WHITE), "made", kind, exposure_s=1.0))
    return CaptureSet("made", tuple(out))


def one(transfer, name):
    (found,) = of_all_pixels(transfer).outcomes(name, None if name != "DSNU1288" else "DN")
    return found


def test_whole_dead_columns_are_no_gain_of_columns():
    columns = np.isin(np.arange(SIZE[1]), (20, 21, 67, 110))
    transfers, findings = calibrate(recordings(lambda codes, dark: np.where(columns, dark, codes)))
    for name, true in (("PRNU1288, pixels", 100 * PRNU), ("PRNU1288", 100 * PRNU)):
        assert one(transfers[0], name).value == pytest.approx(true, rel=0.04), name
    for name in ("PRNU1288, rows", "PRNU1288, columns"):
        assert one(transfers[0], name).value < 0.15, name
    note = next(q.note for q in of_all_pixels(transfers[0]).quantities if q.name == "PRNU1288")
    share = columns.mean()
    with_them = float(note.split(" % with them")[0].split()[-1])
    assert with_them == pytest.approx(100 * np.sqrt(share / (1 - share)), rel=0.15)
    found = {f.mechanism: f for f in findings}
    assert found["column_gain"].measured is None
    assert found["dead_pixels"].measured["fraction"].value == pytest.approx(share)
    model = sensor_model(transfers, findings)
    light = np.asarray(model.expected(np.full(SIZE, 0.5), Settings(exposure_s=1.0))) - BLACK
    lit = light[:, ~columns] / np.median(light)
    assert np.std(lit.mean(0)) < 2 * PRNU / np.sqrt(SIZE[0])


def test_dead_and_stuck_pixels_are_named_and_left_out(caplog):
    rng = np.random.default_rng(7)
    dead, stuck = (rng.random(SIZE) < share for share in (0.004, 0.002))
    stuck &= ~dead
    transfers, findings = calibrate(
        recordings(lambda codes, dark: np.where(stuck, 9999, np.where(dead, dark, codes)))
    )
    said = caplog.text
    assert f"{stuck.sum()} (" in said and "are full in every dark (stuck)" in said
    assert f"{dead.sum()} (" in said and "do not answer light (dead)" in said
    assert one(transfers[0], "black level").value == pytest.approx(BLACK, abs=0.05)
    assert one(transfers[0], "PRNU1288").value == pytest.approx(100 * PRNU, rel=0.03)
    found = {f.mechanism: f for f in findings}
    assert found["prnu"].measured["sigma"].value == pytest.approx(PRNU, rel=0.05)
    assert found["dead_pixels"].measured["fraction"].value == pytest.approx(dead.mean())
    assert isinstance(found["hot_pixels"].estimates, NotMeasurable)
    notes = {q.name: q.note for q in of_all_pixels(transfers[0]).quantities if q.note}
    with_them = float(notes["DSNU1288"].split(" DN with them")[0].split()[-1])
    assert with_them == pytest.approx(np.where(stuck, WHITE, BLACK).std(), rel=0.01)
    assert "answer light oddly" in notes["PRNU1288"]
    model = sensor_model(transfers, findings)
    field = next(m for m in model.mechanisms if m.mechanism == "dead_pixels").maps["dead"]
    assert np.array_equal(np.asarray(field)[0] > 0, dead)
    bright = np.asarray(model.expected(np.full(SIZE, 0.5, np.float32), Settings(exposure_s=1.0)))
    assert np.abs(bright[dead] - BLACK).max() < 5 < bright[~dead].min() - BLACK


@pytest.mark.parametrize(
    "lines", [np.s_[:, :6], pytest.param(np.s_[5:12, :], marks=pytest.mark.slow)], ids=["columns", "rows"]
)
def test_masked_lines_at_code_0_are_no_level_and_no_cut(lines, caplog):
    def masked(codes, dark):
        codes = codes.copy()
        codes[(slice(None), *lines)] = 0
        return codes

    transfers, findings = calibrate(recordings(masked))
    assert "are at the lowest code in every frame" in caplog.text
    assert one(transfers[0], "black level").value == pytest.approx(BLACK, abs=0.05)
    assert one(transfers[0], "system gain").value == pytest.approx(GAIN, rel=0.02)
    assert one(transfers[0], "PRNU1288").value == pytest.approx(100 * PRNU, rel=0.03)
    assert {f.mechanism for f in findings if f.verdict == "in the model"} == {"prnu"}


def test_no_defects_are_no_line(caplog):
    _, findings = calibrate(recordings(lambda codes, dark: codes))
    assert "of the pixels" not in caplog.text
    dead = next(f for f in findings if f.mechanism == "dead_pixels")
    assert dead.verdict == "not there" and MECHANISMS["dead_pixels"].estimator is not None


def test_text_in_the_picture_is_told_from_darks_that_are_cut_off():
    """The first is a part of the frame, the second is all over it."""
    rng = np.random.default_rng(3)
    text = rng.integers(0, 2, (6, 10, 60)) * 900.0

    def written(codes, dark):
        codes = codes.copy()
        codes[:, 80:90, 20:80] = (
            text[: len(codes)] if len(codes) <= 6 else np.tile(text, (2, 1, 1))[: len(codes)]
        )
        return codes

    with pytest.raises(BadInput, match="all within rows 81 to 90, columns 21 to 80: text"):
        calibrate(recordings(written))
    with pytest.raises(BadInput, match="darks are cut off at 0"):
        calibrate(recordings(lambda codes, dark: codes - BLACK))
