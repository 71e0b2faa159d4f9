"""bin/calibrate: the tables, the model it writes, and one line for what it cannot use."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from cannoise_jax.commands import calibrate
from cannoise_jax.commands.calibrate import main
from cannoise_jax.mechanisms.outside import entries_at
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.transfer import model as transfer_model
from cannoise_jax.recordings import Recording
from cannoise_jax.recordings.load import load_capture_set
from cannoise_jax.recordings.native import read_recording, write_recording
from cannoise_jax.recordings.recording import BadInput
from tests.recordings.folders.test_store import sets

GAIN, READ, BLACK = 2.0, 3.0, 256.0


def write(path, electrons, kind, rows=0.0, **more):
    rng = np.random.default_rng(sum(map(ord, path.name)))
    size = (16, 64, 96)
    values = BLACK + GAIN * (rng.poisson(electrons, size) + rng.normal(0, READ, size))
    values = values + rows * rng.normal(size=(16, 64, 1))
    frames = np.clip(np.rint(values), 0, 16383).astype(np.uint16)
    fields = {"camera": "made", "exposure_s": 0.01, **more}
    write_recording(path, Recording(frames, "RGGB", (BLACK,) * 4, 16383.0, kind=kind, **fields))


@pytest.fixture
def folder(tmp_path):
    recordings = tmp_path / "recordings"
    recordings.mkdir()
    write(recordings / "dark.h5", 0.0, "dark", rows=2.0)
    write(recordings / "flat.h5", 2000.0, "flat", rows=2.0)
    return recordings


def test_writes_a_model_with_what_it_found_into_a_new_folder(folder, tmp_path, capsys):
    out = tmp_path / "new" / "deeper" / "sensor.json"
    assert main(["--recordings", str(folder), "--out", str(out)]) == 0
    text = capsys.readouterr().out
    for expected in ("system gain", "PRNU1288", "row_noise", "in the model", "saturates"):
        assert expected in text
    model = SensorModel.load(out)
    assert np.allclose(model.gain_dn_per_e, GAIN, rtol=0.03)
    assert np.allclose(model.read_noise_e, READ, rtol=0.05)
    assert np.allclose(model.black_level, BLACK, atol=0.5)
    sheet = (out.parent / "sensor_emva1288.html").read_text()
    assert "Photon transfer" in sheet and "made" in sheet
    assert json.loads((out.parent / "sensor_emva1288.json").read_text())["camera"] == "made"
    assert len((out.parent / "sensor_profile.csv").read_text().splitlines()) == 5
    profiles = json.loads((out.parent / "sensor_profile.json").read_text())["profiles"]
    assert abs(profiles[0]["shot"] * (16383 - BLACK) / GAIN - 1) < 0.03
    assert "noiseprofiles" in json.loads((out.parent / "sensor_darktable.json").read_text())
    strengths = {f.mechanism: f.parameters for f in model.mechanisms}
    assert abs(strengths["row_noise"]["sigma_dn"] - 2.0) < 0.2
    assert set(strengths) <= {"row_noise", "offset_drift"}, "only row noise was put in"


def test_how_far_it_is_is_said_as_estimators_end_and_not_before(folder, monkeypatch, capsys):
    """Frames may be large: every line comes when that much is measured."""
    measured, judged = [], transfer_model._judged

    def slow(entry, *more):
        measured.append(entry.record.id)
        return judged(entry, *more)

    said = []
    monkeypatch.setattr(transfer_model, "_judged", slow)
    monkeypatch.setattr(
        calibrate,
        "counted",
        lambda items, doing, named=None: (said.append((doing, len(measured))) or i for i in items),
    )
    stages: list[str] = []
    monkeypatch.setattr(calibrate, "now_at", stages.append)
    calibrate.calibrate(load_capture_set(folder))
    assert stages == ["photon transfer", "mechanisms: which of them explain the others"]
    channels = [at for doing, at in said if doing.endswith("channels")]
    estimators = [at for doing, at in said if doing.endswith("estimators")]
    assert channels == [0] * 4 and len(estimators) > 20
    assert np.diff(estimators).max() == 1  # one of them is measured before the others


def test_two_isos_become_two_baselines_and_what_one_of_them_lacks_says_which(
    folder, tmp_path, capsys, caplog
):
    for name in ("dark", "flat"):
        (folder / f"{name}.h5").unlink()
    for iso, level in ((100.0, 3000.0), (200.0, 1500.0)):
        write(folder / f"dark{iso:g}.h5", 0.0, "dark", iso=iso, exposure_s=60.0 if iso > 100 else 0.01)
        write(folder / f"flat{iso:g}.h5", level, "flat", iso=iso)
    out = tmp_path / "sensor.json"
    assert main(["--recordings", str(folder), "--out", str(out)]) == 0
    assert [row["iso"] for row in json.loads(out.read_text())["baseline"]] == [100.0, 200.0]
    assert "ISO 100" in capsys.readouterr().out
    said = [line for line in caplog.messages if "darks of 60 s" in line]
    assert said and all(line.startswith("made, ISO 200: ") for line in said)


def test_overrides_reach_the_recordings_and_a_wrong_order_the_sheet(folder, tmp_path, caplog):
    out = tmp_path / "sensor.json"
    (folder / "flat.h5").unlink()
    write(folder / "flat.h5", np.tile([[2000.0, 1200.0], [1800.0, 2000.0]], (32, 48)), "flat")
    flags = ["--cfa", "BGGR", "--white-level", "8000", "--black-level", "250"]
    assert main(["--recordings", str(folder), "--out", str(out), *flags]) == 0
    document = json.loads(out.read_text())
    assert document["cfa"] == "BGGR" and document["white_level"] == 8000
    said = "the two greens of BGGR differ by 40 %"
    assert said in caplog.text and said in (tmp_path / "sensor_emva1288.html").read_text()


def spoilt(frames, trouble):
    """Frames as they must not be."""
    return {
        "tiny": frames[:, :2, :2],
        "zero": frames * 0,
        "copies": frames[[0, 0, 0, 0]],
        "white": frames + 5000,
        "constant": np.full_like(frames, 700),
    }[trouble].astype(np.uint16)


def noisy(seed=0):
    return np.random.default_rng(seed).integers(300, 400, (4, 16, 16)).astype(np.uint16)


@pytest.mark.parametrize("trouble", ["tiny", "zero", "copies", "white", "constant"])
def test_frames_that_all_lack_noise_are_refused_in_one_line(trouble, tmp_path, capsys):
    (tmp_path / "in").mkdir()
    made = Recording(spoilt(noisy(), trouble), "RGGB", (BLACK,) * 4, 4000.0, kind="flat", camera="made")
    write_recording(tmp_path / "in" / "flat.h5", made)
    assert main(["--recordings", str(tmp_path / "in"), "--out", str(tmp_path / "sensor.json")]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    words = {"tiny": "at least 8 x 8", "zero": "raise its offset", "copies": "a copy of frame 1"}
    words |= {"white": "above the white level", "constant": "every pixel is 700"}
    assert words[trouble] in error and not (tmp_path / "sensor.json").exists()


def test_darks_of_zeros_and_repeated_flats_are_left_out_with_a_line(folder, tmp_path, capsys):
    """What remains is measured as if the others had not been there."""
    alone = tmp_path / "alone.json"
    assert main(["--recordings", str(folder), "--out", str(alone)]) == 0
    capsys.readouterr()
    zeros = Recording(np.zeros((4, 64, 96), np.uint16), "RGGB", (BLACK,) * 4, 16383.0, kind="dark")
    write_recording(folder / "dark_off.h5", dataclasses.replace(zeros, camera="made"))
    lit = read_recording(folder / "flat.h5")
    again = np.concatenate([lit.frames[:], lit.frames[:3], np.full((1, 64, 96), 900, np.uint16)])
    write_recording(folder / "flat.h5", dataclasses.replace(lit, frames=again))
    assert main(["--recordings", str(folder), "--out", str(tmp_path / "more.json")]) == 0
    said = capsys.readouterr().err
    assert "dark_off.h5: frames 1 to 4: every pixel is 0 (" in said
    assert "flat.h5: frame 20: every pixel is 900" in said and ": copies of earlier frames (" in said
    assert (tmp_path / "more.json").read_text() == alone.read_text()


def test_files_of_another_gain_are_said_at_the_end(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = sets(tmp_path / "in", a={"GAIN": 0, "size": (64, 96)}, b={"GAIN": 100, "size": (64, 96)})
    assert main(["--recordings", str(folder), "--out", str(tmp_path / "sensor.json")]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("used: 4 of 8 files (gain 0); not used: 4 as gain_100/ (flat_b_1.fits")


OWN = """
import dataclasses
import jax, jax.numpy as jnp, numpy as np
from cannoise_jax.mechanisms.entry import Entry
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import Mechanism, Parameter
from cannoise_jax.physics.transfer.estimate import NotMeasurable, root, variance_difference
from cannoise_jax.physics.transfer.estimator import Estimator
from cannoise_jax.vocabulary import RMS, Term

def pulse(key, x, values, maps, context):
    row = jnp.arange(context.size[0])[:, None] == 7
    return x + values["sigma_dn"] * row * jax.random.normal(key, (x.shape[0], 1, 1))

def measure(statistics, baseline):
    darks = [s.row_means.mean(2) for s in statistics if s.recording.kind == "dark"]
    if not darks:
        return NotMeasurable("record darks")
    of_rows, n = darks[0].var(0, ddof=1), len(darks[0]) - 1
    others = np.delete(of_rows, 7)
    return {"sigma_dn": root(variance_difference(of_rows[7], n, others.mean(), n * others.size))}

PULSE = Entry(
    Term("pulse", "The eighth row jumps.", None, "sensor", "DN", RMS),
    Mechanism(
        id="pulse", point=Point("readout", "signal", "row", "redrawn"), sample=pulse, home="own:PULSE",
        parameters=(Parameter("sigma_dn", "DN", 1.0, 0.0, 1e4, "of that row"),),
    ),
    needs="darks",
    estimator=Estimator(measure),
)
BARE = dataclasses.replace(PULSE, estimator=None)
BROKEN = dataclasses.replace(PULSE, estimator=Estimator(lambda statistics, baseline: {}["no"]))
TAKEN = dataclasses.replace(
    PULSE,
    term=dataclasses.replace(PULSE.term, id="row_noise"),
    record=dataclasses.replace(PULSE.record, id="row_noise"),
)
"""


def test_a_mechanism_of_ones_own_is_measured_and_modelled(folder, tmp_path, capsys):
    dark = read_recording(folder / "dark.h5")
    frames = np.asarray(dark.frames, float)
    frames[:, 7] += 40 * np.random.default_rng(9).normal(size=(16, 1))
    frames = np.clip(np.rint(frames), 0, 16383).astype(np.uint16)
    write_recording(folder / "dark.h5", dataclasses.replace(dark, frames=frames))
    (tmp_path / "own.py").write_text(OWN)
    place = f"{tmp_path / 'own.py'}"
    out = tmp_path / "sensor.json"
    assert main(["--recordings", str(folder), "--out", str(out), "--mechanisms", f"{place}:PULSE"]) == 0
    assert "pulse" in capsys.readouterr().out
    with pytest.raises(BadInput, match="needs the mechanism pulse"):
        SensorModel.load(out)
    (own,) = entries_at(f"{place}:PULSE")
    fitted = {f.mechanism: f for f in SensorModel.load(out, [own]).mechanisms}
    assert float(np.ravel(fitted["pulse"].parameters["sigma_dn"])[0]) == pytest.approx(40, rel=0.5)


def test_an_estimator_that_fails_is_one_line(folder, tmp_path, capsys):
    (tmp_path / "own.py").write_text(OWN)
    out = tmp_path / "made" / "sensor.json"
    place = f"{tmp_path / 'own.py'}:BROKEN"
    assert main(["--recordings", str(folder), "--out", str(out), "--mechanisms", place]) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last == "bin/calibrate: pulse: its estimator fails (KeyError: 'no'): mend it"
    assert not out.parent.exists()


@pytest.mark.parametrize(("name", "said"), [("BARE", "has no estimator"), ("TAKEN", "choose another")])
def test_entries_that_cannot_be_measured_are_one_line(name, said, folder, tmp_path, capsys):
    (tmp_path / "own.py").write_text(OWN)
    out = tmp_path / "sensor.json"
    place = f"{tmp_path / 'own.py'}:{name}"
    assert main(["--recordings", str(folder), "--out", str(out), "--mechanisms", place]) == 2
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1 and not out.exists()


def test_a_folder_without_its_flag_is_named(folder, tmp_path, capsys):
    with pytest.raises(SystemExit):
        main([str(folder), "--out", str(tmp_path / "s.json")])
    assert f"required: --recordings; {folder} stands alone: --recordings {folder}" in capsys.readouterr().err
