"""bin/diagnose end to end."""

from __future__ import annotations

import dataclasses
import errno
import importlib
import json
import re
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from cannoise_jax.commands import outputs
from cannoise_jax.commands.diagnose import main
from cannoise_jax.discovery.report import save as saving
from cannoise_jax.mechanisms.outside import entries_at
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.recordings.folders.plan import plan_folder
from cannoise_jax.recordings.folders.store import write_plan
from cannoise_jax.recordings.load import load_capture_set
from cannoise_jax.recordings.native import write_recording
from cannoise_jax.recordings.recording import BadInput
from tests.discovery.capture import capture_set
from tests.recordings.folders.night import night


def write(folder, capture):
    folder.mkdir()
    for recording in capture.recordings:
        write_recording(folder / recording.path, recording)
    return folder


def test_a_folder_of_single_files_is_cut_as_its_conversion_is(tmp_path, monkeypatch, capsys):
    def say(capture, most):
        raise BadInput(f"most {most} of {len(capture.recordings)}")

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("cannoise_jax.recordings.crop.central", say)
    folder, out = night(tmp_path / "night"), tmp_path / "out"
    for _ in write_plan(plan_folder(folder), out):
        pass
    said = []
    for recordings in (folder, out):
        assert main(["--recordings", str(recordings), "--out", str(tmp_path / "report")]) == 2
        said.append(capsys.readouterr().err.splitlines()[-1])
    assert said[0] == said[1] == "bin/diagnose: most 160000 of 3"


def test_bad_input_is_one_line_and_status_two(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    for arguments in (["--recordings", str(tmp_path / "nowhere")], ["--recordings", str(tmp_path / "empty")]):
        assert main([*arguments, "--out", str(tmp_path / "out")]) == 2
        error = capsys.readouterr().err.strip().splitlines()
        assert error[-1].startswith("bin/diagnose: ")
    assert not (tmp_path / "out").exists()


def test_unknown_simulator_and_mechanism_are_refused(tmp_path, capsys):
    folder = write(tmp_path / "in", capture_set(1, kinds="d"))
    (tmp_path / "other.json").write_text('{"a": 1}')
    wrong = ("x", str(folder), str(tmp_path / "other.json"))
    for more in (*(["--simulator", name] for name in wrong), ["--without", "nonsense"]):
        assert main(["--recordings", str(folder), "--out", str(tmp_path / "out"), *more]) == 2
        # Said before the recordings are read.
        error = capsys.readouterr().err
        assert error.startswith("bin/diagnose: ") and error.count("\n") == 1


def test_a_mechanism_of_ones_own_is_looked_for_by_its_sampler(tmp_path, monkeypatch, capsys):
    """That of docs/adding_a_mechanism.md, in recordings to which NumPy added what it says."""
    page = (Path(__file__).resolve().parents[2] / "docs" / "adding_a_mechanism.md").read_text()
    (tmp_path / "droop.py").write_text(
        re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)[0]
    )
    monkeypatch.syspath_prepend(tmp_path)

    def sagging(rng):
        ramp = np.linspace(-(3**0.5), 3**0.5, 48)[:, None]
        return lambda dn, signal, kind, exposure: dn + 2.0 * rng.standard_normal() * ramp

    folder = write(tmp_path / "in", capture_set(5, sagging, kinds="d", size=(48, 64)))
    arguments = ["--recordings", str(folder), "--out", str(tmp_path / "out"), "--mechanisms", "droop:DROOP"]
    assert main(arguments) == 0
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    first = report["findings"][0]
    assert first["mechanism"] == "droop"
    assert first["amplitude"]["ci90"][0] < 2.0 < first["amplitude"]["ci90"][1]
    assert "droop" in (tmp_path / "out" / "report.html").read_text()
    with pytest.raises(BadInput, match="needs the mechanism droop"):
        SensorModel.load(tmp_path / "out" / "sensor.json")
    entries = entries_at("droop:DROOP")
    assert "droop" in [
        m.mechanism for m in SensorModel.load(tmp_path / "out" / "sensor.json", entries).mechanisms
    ]
    model = tmp_path / "out" / "sensor.json"
    second = ["--recordings", str(folder), "--out", str(tmp_path / "second"), "--simulator", str(model)]
    assert main(second) == 2
    assert "needs the mechanism droop" in capsys.readouterr().err
    assert main([*second, "--mechanisms", "droop:DROOP"]) == 0
    again = json.loads((tmp_path / "second" / "report.json").read_text())
    assert "droop" not in [f["mechanism"] for f in again["findings"] if f["confirmed"]]
    sys.modules.pop("droop", None)
    assert main([*arguments[:-1], "droop", "--force"]) == 2
    assert "names nothing" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('values["sigma_dn"] *', 'values["none"] *', "`sample` fails (KeyError: 'none'): mend it"),
        ('id="droop"', 'id="the droop"', "its record is that of the droop"),
        ('home="droop:DROOP"', 'home=""', "droop: its record has no `home`"),
    ],
)
def test_a_mechanism_that_cannot_work_is_one_line_and_nothing_is_written(
    old, new, said, tmp_path, monkeypatch, capsys
):
    page = Path(__file__).resolve().parents[2] / "docs" / "adding_a_mechanism.md"
    code = re.findall(r"^```python\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)[0]
    assert old in code
    (tmp_path / "wrong.py").write_text(code.replace(old, new))
    folder = write(tmp_path / "in", capture_set(5, kinds="d", size=(48, 64)))
    arguments = ["--recordings", str(folder), "--out", str(tmp_path / "out")]
    assert main([*arguments, "--mechanisms", f"{tmp_path}/wrong.py:DROOP"]) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("[")]
    assert len(errors) == 1 and said in errors[0] and not (tmp_path / "out").exists()


def test_a_function_of_ones_own_is_judged_by_its_name(tmp_path, monkeypatch, capsys):
    (tmp_path / "mine.py").write_text(
        "import jax, numpy as np\n"
        "def draw(key, clean, settings):\n"
        "    noise = jax.random.normal(key, (settings.frames, *clean.shape))\n"
        "    return np.clip(np.rint(64 + 2 * noise), 0, 1023)\n"
        "LEVEL = 64\n"
    )
    folder = write(tmp_path / "in", capture_set(1, kinds="d"))
    start = ["--recordings", str(folder), "--out", str(tmp_path / "out"), "--simulator"]
    for name, said in (("mine:nothing", "cannot be imported"), (f"{tmp_path}/mine.py:LEVEL", "no function")):
        assert main([*start, name]) == 2
        error = capsys.readouterr().err.splitlines()
        assert said in error[-1] and error[-1].startswith("bin/diagnose: ")
    seen = []

    def found(capture, simulator, *given, **more):
        seen.append(simulator)
        raise BadInput("enough")

    monkeypatch.setattr(import_module("cannoise_jax.discovery.diagnose"), "diagnose", found)
    assert main([*start, f"{tmp_path}/mine.py:draw"]) == 2
    assert seen[0].__name__ == "draw"
    with pytest.raises(BadInput, match="mine.py:draw: fails .*TypeError.* called with key, clean, settings"):
        seen[0](1)


def never(*given, **more):
    raise AssertionError("diagnosed although the results could not be written")


def test_a_place_that_cannot_be_written_is_refused_before_the_work(tmp_path, capsys, monkeypatch):
    folder = write(tmp_path / "in", capture_set(1, kinds="d", size=(64, 64)))
    out = tmp_path / "out"
    out.mkdir()
    importlib.import_module("cannoise_jax.discovery.diagnose")
    monkeypatch.setattr(sys.modules["cannoise_jax.discovery.diagnose"], "diagnose", never)
    arguments = ["--recordings", str(folder), "--out", str(out)]
    (out / "sensor.npz").write_bytes(b"of something else")
    assert main(arguments) == 2
    assert "holds no maps of sensor.json" in capsys.readouterr().err
    (out / "sensor.npz").unlink()

    (out / "report.html").write_text("precious")
    assert main(arguments) == 2
    assert capsys.readouterr().err == (
        f"bin/diagnose: {out / 'report.html'}: exists: name another folder, or replace it with --force\n"
    )
    (out / "report.html").unlink()

    def denied(*given, **more):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(outputs.tempfile, "TemporaryFile", denied)
    assert main(arguments) == 2
    assert capsys.readouterr().err == (
        f"bin/diagnose: {out}: cannot be written (no permission): name another folder\n"
    )


@pytest.mark.parametrize("full", [Path.write_text, saving.write_sensor])
def test_a_full_disk_keeps_all_that_was_there(full, tmp_path, monkeypatch):
    model = SensorModel.poisson_gaussian(1.5, 3.0, 200.0, 4095.0)
    saving.write(tmp_path, {"report.json": "old", "report.html": "old"}, model)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    assert set(before) == {"report.json", "report.html", "sensor.json"}

    def fails(*given, **more):
        raise OSError(errno.ENOSPC, "No space left on device")

    if full is saving.write_sensor:
        monkeypatch.setattr(saving, "write_sensor", fails)
    else:
        kept = Path.write_text
        monkeypatch.setattr(
            Path, "write_text", lambda p, *a, **k: fails() if "html" in p.name else kept(p, *a, **k)
        )
    with pytest.raises((OSError, ValueError), match="No space left"):
        saving.write(tmp_path, {"report.json": "new", "report.html": "new"}, model)
    monkeypatch.undo()
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


def test_recordings_without_a_camera_are_named_after_their_folder(tmp_path):
    capture = capture_set(1, kinds="d", size=(64, 64))
    nameless = (dataclasses.replace(r, camera="unknown") for r in capture.recordings)
    folder = write(tmp_path / "workbench", dataclasses.replace(capture, recordings=tuple(nameless)))
    assert load_capture_set(folder).camera == "workbench"
