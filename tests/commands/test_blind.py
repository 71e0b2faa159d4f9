"""bin/blind end to end, on sets that are only located."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from cannoise_jax.commands.blind import main
from cannoise_jax.commands.blind_flags import shard_of, size_of
from cannoise_jax.recordings.native import write_recording
from cannoise_jax.recordings.recording import Recording


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    folder = tmp_path_factory.mktemp("trial")
    truth = folder / "truth.json"
    made = ["--out", str(folder / "sets"), "--truth", str(truth), "--seed", "5", "--sets", "0"]
    assert main(["seal", *made, "--nulls", "2"]) == 0
    return folder


def test_seal_run_and_score_make_the_table(trial, capsys):
    truth, hidden = trial / "truth.json", trial / "elsewhere.json"
    truth.rename(hidden)
    for shard in ("1/2", "2/2"):
        assert (
            main(["run", "--sets", str(trial / "sets"), "--out", str(trial / "claims"), "--shard", shard])
            == 0
        )
    hidden.rename(truth)
    common = ["--sets", str(trial / "sets"), "--claims", str(trial / "claims"), "--truth", str(truth)]
    assert main(["score", *common, "--out", str(trial / "score")]) == 0
    result = json.loads((trial / "score" / "blind.json").read_text())
    assert result["false_alarms"]["sets"] == 2 and result["errors"] == 0
    assert "min left" in capsys.readouterr().err


def test_permuting_real_frames_takes_the_rows_away(tmp_path, capsys):
    rng = np.random.default_rng(0)
    (tmp_path / "camera").mkdir()
    for n, seconds in enumerate((0.01, 1.0)):
        values = 500 + rng.normal(0, 3, (8, 96, 128)) + rng.normal(0, 1, (8, 96, 1))
        frames = np.rint(values).astype(np.uint16)
        dark = Recording(frames, "RGGB", (500.0,) * 4, 4095.0, kind="dark", exposure_s=seconds, code_step=1.0)
        write_recording(tmp_path / "camera" / f"dark_{n}.h5", dark)
    asked = ["--recordings", str(tmp_path / "camera"), "--out", str(tmp_path), "--size", "96x128"]
    assert main(["real", *asked, "--parts", "permute", "--permutations", "3"]) == 0
    found = json.loads((tmp_path / "real.json").read_text())["permute"]
    assert "row_noise" in found["reported_before"]
    assert found["permutations"] == 3 and found["by_mechanism"]["row_noise"]["hits"] == 0
    kept = (tmp_path / "permutations.json").read_text()
    assert main(["real", *asked, "--parts", "permute", "--permutations", "3"]) == 0
    assert (tmp_path / "permutations.json").read_text() == kept
    assert "permuted: " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["seal", "--out", "o", "--truth", "t", "--seed", "1", "--kinds", "odd"], "'odd'"),
        (["run", "--sets", "nowhere", "--out", "o"], "no manifest of sealed sets (no such file or "),
        (["seal", "--out", "o", "--truth", "t", "--seed", "1", "--sets", "0"], "no set to seal"),
        (["run", "--sets", "s", "--out", "o", "--shard", "3/2"], "give i/n"),
        (["develop"], "--figures"),
        (["real", "--recordings", "nowhere", "--out", "o", "--size", "63x64"], "give HxW"),
        (["real", "--recordings", "nowhere", "--out", "o", "--parts", "odd"], "give some of"),
        (["score", "--sets", "nowhere", "--claims", "c", "--truth", "t"], "no manifest"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(arguments, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    try:
        status = main(arguments)
    except SystemExit as left:
        status = left.code
    error = capsys.readouterr().err.strip().splitlines()
    assert status == 2 and len(error) == 1 and said in error[0] and error[0].startswith("bin/blind")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("step", "flag"), [("run", "--shard"), ("size", "--shard"), ("real", "--size")])
def test_the_default_that_help_prints_is_one_that_is_taken(step, flag, capsys):
    with pytest.raises(SystemExit):
        main([step, "--help"])
    shown = re.search(
        rf"{flag} .*?\(default (\S+)\)", " ".join(capsys.readouterr().out.split()).split("options:")[1]
    )
    assert shown
    read = {"--shard": shard_of, "--size": size_of}[flag]
    assert read(shown[1]) == {"--shard": (1, 1), "--size": (192, 256)}[flag]
