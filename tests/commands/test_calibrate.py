"""bin/calibrate: the tables, the model it writes, and one line for what it cannot use."""

from __future__ import annotations

import json

import numpy as np
import pytest

from cannoise_jax.commands.calibrate import main
from cannoise_jax.physics.core.sensor_json import read_sensor
from cannoise_jax.recordings import Recording
from cannoise_jax.recordings.native import write_recording

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


def test_writes_a_model_with_what_it_found(folder, tmp_path, capsys):
    out = tmp_path / "sensor.json"
    assert main(["--recordings", str(folder), "--out", str(out)]) == 0
    text = capsys.readouterr().out
    for expected in ("system gain", "PRNU1288", "row_noise", "in the model", "saturates"):
        assert expected in text
    model = read_sensor(out)
    assert np.allclose(model.gain_dn_per_e, GAIN, rtol=0.03)
    assert np.allclose(model.read_noise_e, READ, rtol=0.05)
    assert np.allclose(model.black_level, BLACK, atol=0.5)
    sheet = (tmp_path / "sensor_emva1288.html").read_text()
    assert "Photon transfer" in sheet and "made" in sheet
    assert json.loads((tmp_path / "sensor_emva1288.json").read_text())["camera"] == "made"
    assert len((tmp_path / "sensor_profile.csv").read_text().splitlines()) == 5
    profiles = json.loads((tmp_path / "sensor_profile.json").read_text())["profiles"]
    assert abs(profiles[0]["shot"] * (16383 - BLACK) / GAIN - 1) < 0.03
    assert "noiseprofiles" in json.loads((tmp_path / "sensor_darktable.json").read_text())
    strengths = {f.mechanism: f.parameters for f in model.mechanisms}
    assert abs(strengths["row_noise"]["sigma_dn"] - 2.0) < 0.2
    assert set(strengths) <= {"row_noise", "offset_drift"}, "only row noise was put in"


def test_two_isos_become_two_baselines(folder, tmp_path, capsys):
    for name in ("dark", "flat"):
        (folder / f"{name}.h5").unlink()
    for iso, level in ((100.0, 3000.0), (200.0, 1500.0)):
        write(folder / f"dark{iso:g}.h5", 0.0, "dark", iso=iso)
        write(folder / f"flat{iso:g}.h5", level, "flat", iso=iso)
    out = tmp_path / "sensor.json"
    assert main(["--recordings", str(folder), "--out", str(out)]) == 0
    assert [row["iso"] for row in json.loads(out.read_text())["baseline"]] == [100.0, 200.0]
    assert "ISO 100" in capsys.readouterr().out


def test_overrides_reach_the_recordings(folder, tmp_path, capsys):
    out = tmp_path / "sensor.json"
    flags = ["--cfa", "BGGR", "--white-level", "8000", "--black-level", "250"]
    assert main(["--recordings", str(folder), "--out", str(out), *flags]) == 0
    document = json.loads(out.read_text())
    assert document["cfa"] == "BGGR" and document["white_level"] == 8000
    capsys.readouterr()


@pytest.mark.parametrize("trouble", ["no folder", "empty folder", "only darks", "not json", "broken file"])
def test_trouble_is_one_line_and_keeps_the_old_result(trouble, folder, tmp_path, capsys):
    out = tmp_path / ("sensor.txt" if trouble == "not json" else "sensor.json")
    out.write_text("precious")
    recordings = folder
    if trouble == "no folder":
        recordings = tmp_path / "nowhere"
    elif trouble == "empty folder":
        recordings = tmp_path / "empty"
        recordings.mkdir()
    elif trouble == "only darks":
        (folder / "flat.h5").unlink()
    elif trouble == "broken file":
        (folder / "flat.h5").write_bytes(b"not a recording")
    assert main(["--recordings", str(recordings), "--out", str(out), "--force"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("bin/calibrate: ") and error.count("\n") == 1
    assert out.read_text() == "precious"
    assert sorted(p.name for p in tmp_path.iterdir() if p.is_file()) == [out.name]


def test_four_black_levels_or_one(capsys):
    with pytest.raises(SystemExit):
        main(["--recordings", ".", "--out", "x.json", "--black-level", "1,2"])
    assert "1,2" in capsys.readouterr().err


def test_flats_and_darks_that_state_their_light_are_taken(folder, tmp_path, capsys):
    light = np.full((64, 96), 0.25, np.float32)
    write(folder / "flat.h5", 2000.0, "flat", rows=2.0, clean=light, reference="independent")
    write(folder / "dark.h5", 0.0, "dark", rows=2.0, clean=np.zeros((64, 96), np.float32))
    assert main(["--recordings", str(folder), "--out", str(tmp_path / "sensor.json")]) == 0
    assert "row_noise" in [f.mechanism for f in read_sensor(tmp_path / "sensor.json").mechanisms]


def test_results_are_replaced_only_when_asked(folder, tmp_path, capsys):
    out = tmp_path / "sensor.json"
    (tmp_path / "sensor_profile.csv").write_text("precious")
    assert main(["--recordings", str(folder), "--out", str(out)]) == 2
    assert (
        "sensor_profile.csv: exists: name another file, or replace it with --force" in capsys.readouterr().err
    )
    assert not out.exists()


@pytest.mark.parametrize("trouble", ["tiny", "zero", "copies", "white", "constant"])
def test_frames_without_noise_are_refused_in_one_line(trouble, folder, tmp_path, capsys):
    rng = np.random.default_rng(0)
    frames = rng.integers(300, 400, (4, 16, 16)).astype(np.uint16)
    frames = {
        "tiny": frames[:, :2, :2],
        "zero": frames * 0,
        "copies": frames[[0, 1, 0, 2]],
        "white": frames + 5000,
        "constant": np.where(np.arange(4)[:, None, None] == 2, 700, frames),
    }[trouble].astype(np.uint16)
    levels = (BLACK,) * 4, 4000.0
    write_recording(folder / "flat.h5", Recording(frames, "RGGB", *levels, kind="flat", camera="made"))
    assert main(["--recordings", str(folder), "--out", str(tmp_path / "sensor.json")]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    words = {"tiny": "at least 8 x 8", "zero": "raise its offset", "copies": "is a copy of frame 1"}
    assert (
        words.get(trouble, {"white": "above the white level", "constant": "frame 3 is 700"}.get(trouble))
        in error
    )
    assert not (tmp_path / "sensor.json").exists()
