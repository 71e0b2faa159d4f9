"""bin/blind end to end, on sets that are only located."""

from __future__ import annotations

import json

import pytest

from cannoise_jax.commands.blind import main


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


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["seal", "--out", "o", "--truth", "t", "--seed", "1", "--kinds", "odd"], "'odd'"),
        (["run", "--sets", "nowhere", "--out", "o"], "no manifest"),
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
