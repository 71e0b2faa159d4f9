"""Replicates of the search without an effect: reproducible, resumed, counted by hand."""

from __future__ import annotations

import json

import pytest

from cannoise_jax.commands.blind import main
from cannoise_jax.trials.size import summary


def test_replicates_resume_and_shards_add_up(tmp_path, capsys):
    settings = ["size", "--seed", "3", "--replicates", "2", "--size", "64x64"]
    assert main([*settings, "--out", str(tmp_path / "whole")]) == 0
    whole = json.loads(capsys.readouterr().out)
    assert whole["size"]["sets"] == 2
    for shard in ("1/2", "2/2"):
        assert main([*settings, "--out", str(tmp_path / "parts"), "--shard", shard]) == 0
        said = json.loads(capsys.readouterr().out)
    assert said == whole
    part = tmp_path / "parts" / "size_1_of_2.jsonl"  # of two
    kept = part.read_text()
    part.write_text(kept[:-30])  # a run that was cut off inside its last line
    assert main([*settings, "--out", str(tmp_path / "parts"), "--shard", "1/2"]) == 0
    assert json.loads(capsys.readouterr().out) == whole
    assert main([*settings[:2], "4", *settings[3:], "--out", str(tmp_path / "whole")]) == 2
    assert "choose a new folder" in capsys.readouterr().err


def test_alarms_are_counted_with_their_interval():
    lines = [
        {"number": n, "p_value": (n + 0.5) / 200, "rejected": ["greens"] if n < 3 else []} for n in range(200)
    ]
    said = summary(lines)
    assert said["signatures"] == {"greens": 3}
    assert said["uniform_ks_p"] > 0.99
    assert said["size"]["value"] == pytest.approx(0.015)
    low, high = said["size"]["ci95"]
    assert low == pytest.approx(0.0031, abs=2e-4) and high == pytest.approx(0.0432, abs=2e-4)
