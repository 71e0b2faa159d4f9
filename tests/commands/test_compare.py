"""bin/compare: a table on the screen, JSON and a page in a folder, and one line for bad input."""

from __future__ import annotations

import dataclasses
import json
import re

import pytest

from cannoise_jax.commands.compare import main
from cannoise_jax.discovery.compare.report import value
from cannoise_jax.discovery.compare.words import pair
from cannoise_jax.recordings.native import write_recording
from tests.discovery.capture import capture_set, row_offsets

SIMULATOR = """
import numpy as np, jax

def draw(key, clean, settings):
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())
    signal = np.asarray(clean, float) * (16383.0 - 200.0)
    size = (settings.frames, *signal.shape)
    return 200.0 + 1.5 * (rng.poisson(signal / 1.5, size) + 3.0 * rng.standard_normal(size))
"""


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Recordings with row noise, and frames of a simulator without."""
    root = tmp_path_factory.mktemp("compare")
    for name, alter, seed in (("recorded", row_offsets(1.5), 1), ("simulated", None, 2)):
        (root / name).mkdir()
        for r in capture_set(seed, alter, kinds="d").recordings:
            write_recording(root / name / str(r.path), dataclasses.replace(r, path=None))
    (root / "camera.py").write_text(SIMULATOR)
    return root


def test_two_simulators_side_by_side(folders, capsys):
    out = folders / "out"
    code = main(
        ["--recordings", str(folders / "recorded"), "--simulator", f"{folders / 'camera.py'}:draw"]
        + ["--simulator", str(folders / "simulated"), "--out", str(out)]
    )
    printed = capsys.readouterr().out
    assert code == 0 and "too little  rows (frame to frame)" in printed
    report = json.loads((out / "comparison.json").read_text())
    assert [c["verdict"] for c in report["comparisons"]] == ["differs", "differs"]
    assert report["better"]["nearer"] == "neither"  # one law, drawn by two hands
    html = (out / "comparison.html").read_text()
    assert "too little" in html and "<svg" in html and "http" not in html
    # On narrow screens only numbers keep to one line: units may be as long as a sentence.
    assert re.search(r'data-of="recorded"><b>\S+</b> \w', html)


def test_numbers_are_plain():
    assert [value(v) for v in (0, 1e-5, 0.01234, -993.4, 1104.2, -20512.0)] == [
        *("0", "0", "0.0123", "-993", "1,100", "-20,500"),
    ]


def test_two_values_are_told_apart():
    assert pair(0.01234, 0.5) == ("0.0123", "0.5") and pair(2e-5, 0.5) == ("0", "0.5")
    assert pair(2e-5, 5e-5) == ("2e-05", "5e-05")  # not 0 | 0
    assert pair(1104.2, 1104.9) == ("1,104", "1,105") and pair(1104.2, 1104.3) == ("1,104.2", "1,104.3")
    assert pair(0.123401, 0.123402) == ("0.123401", "0.123402")
    assert pair(1.0, 1.0) == ("1", "1")


def test_bad_input_is_one_line(folders, capsys):
    recorded = str(folders / "recorded")
    assert main(["--recordings", str(folders / "nowhere"), "--simulator", "nlf"]) == 2  # read last
    assert "nlf: no such simulator" in capsys.readouterr().err
    for flags in (
        ["--recordings", str(folders / "nowhere")],
        ["--recordings", recorded, "--simulator", "missing:function"],
        ["--recordings", recorded, "--alpha", "3"],
        ["--recordings", recorded, "--simulator", "a", "--simulator", "b", "--simulator", "c"],
        ["--recordings", recorded, "--out", str(folders / "camera.py")],
    ):
        assert main(flags) == 2
        said = capsys.readouterr().err.strip().splitlines()
        assert said[-1].startswith("bin/compare: ") and "Traceback" not in "".join(said)


def report(area, lines):
    """As much of a report as is read."""
    kept = ("what", "time", "simulator_has", "recorded", "simulated", "unit", "nats")
    return {
        "schema": "cannoise/diagnosis/2",
        "verdict": "partly explained",
        "inputs": [{"file": "d.h5", "kind": "dark", "frames": 8, "sha256": "ab"}],
        "after": {"two_sample_auc": area, "two_sample_auc_ci90": [area - 0.02, area + 0.02]},
        "remains": {"after": [dict(zip(kept, line, strict=True)) for line in lines]},
    }


def test_two_reports_say_which_simulator_is_nearer_and_what_changed(tmp_path, capsys):
    rows = ("rows", "frame to frame", "too little", 1.0, 0.1, "DN rms", 900.0)
    tails = ("heavy tails", "frame to frame", "too much", 0.1, 0.3, "kurtosis", 80.0)
    for name, content in (("a", report(0.9, [rows, tails])), ("b", report(0.6, [tails]))):
        (tmp_path / name).mkdir()
        (tmp_path / name / "report.json").write_text(json.dumps(content))
    for given, said in ((("a", "b"), "the second is nearer"), (("b", "a"), "the first is nearer")):
        assert main([str(tmp_path / n) for n in given]) == 0
        assert capsys.readouterr().out.startswith(said)
    assert main([str(tmp_path / "a"), "--alpha", "0.05", str(tmp_path / "b")]) == 0
    assert capsys.readouterr().out.startswith("the second is nearer")
    assert main([str(tmp_path / n) for n in ("a", "a")]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("nothing says which is nearer") and "too much, 0.1 recorded" in printed
    (tmp_path / "b" / "report.json").write_text(json.dumps({**report(0.6, [tails]), "faults": ["cut off"]}))
    assert main([str(tmp_path / n) for n in ("a", "b")]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "  of the recordings: cut off"
    unknown = (*tails[:3], None, *tails[4:])
    (tmp_path / "b" / "report.json").write_text(json.dumps(report(0.6, [unknown])))
    assert main([str(tmp_path / n) for n in ("a", "b")]) == 0
    assert "not measured recorded, 0.3 simulated" in capsys.readouterr().out
    (tmp_path / "b" / "report.json").write_text("{}")
    assert main([str(tmp_path / "a"), str(tmp_path / "b")]) == 2
    assert "is no report of bin/diagnose: name a report.json" in capsys.readouterr().err
    for version in (1, 3):
        other = {**report(0.6, [tails]), "schema": f"cannoise/diagnosis/{version}"}
        (tmp_path / "b" / "report.json").write_text(json.dumps(other))
        for names in ("ab", "ba"):
            assert main([str(tmp_path / n) for n in names]) == 2
            error = capsys.readouterr().err
            assert "is a report of another version" in error and error.count("\n") == 1
