"""bin/diagnose end to end."""

from __future__ import annotations

import json

from cannoise_jax.commands.diagnose import main
from cannoise_jax.physics.sensor_json import read_sensor
from cannoise_jax.recordings.native import write_recording
from tests.discovery.capture import capture_set, row_offsets


def write(folder, capture):
    folder.mkdir()
    for recording in capture.recordings:
        write_recording(folder / recording.path, recording)
    return folder


def test_writes_report_page_and_sensor(tmp_path, capsys):
    folder = write(tmp_path / "in", capture_set(1, row_offsets(2.0)))
    assert main(["--recordings", str(folder), "--out", str(tmp_path / "out"), "--key", "3"]) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["findings"][0]["mechanism"] == "row_noise"
    assert report["key"] == 3 and report["seconds"] > 0 and len(report["inputs"][0]["sha256"]) == 64
    assert (tmp_path / "out" / "report.html").stat().st_size > 10000
    assert [m.mechanism for m in read_sensor(tmp_path / "out" / "sensor.json").mechanisms][0] == "row_noise"
    assert "row_noise" in capsys.readouterr().out


def test_bad_input_is_one_line_and_status_two(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    for arguments in (["--recordings", str(tmp_path / "nowhere")], ["--recordings", str(tmp_path / "empty")]):
        assert main([*arguments, "--out", str(tmp_path / "out")]) == 2
        error = capsys.readouterr().err.strip().splitlines()
        assert error[-1].startswith("bin/diagnose: ")
    assert not (tmp_path / "out").exists()


def test_unknown_simulator_and_mechanism_are_refused(tmp_path, capsys):
    folder = write(tmp_path / "in", capture_set(1, kinds="d"))
    for more in (["--simulator", "x"], ["--without", "nonsense"]):
        assert main(["--recordings", str(folder), "--out", str(tmp_path / "out"), *more]) == 2
        assert "bin/diagnose: " in capsys.readouterr().err
