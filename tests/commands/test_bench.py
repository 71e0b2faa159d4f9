"""bin/bench: one-line errors, the same camera on both sides, and a table that adds up."""

from __future__ import annotations

import hashlib
import json

import jax
import numpy as np
import pytest

from cannoise_jax.commands import bench, bench_runs
from cannoise_jax.commands.bench_take import figure, take
from cannoise_jax.mechanisms.peers import GETFRAMES
from cannoise_jax.physics.core.sensor import Settings
from cannoise_jax.recordings.recording import BadInput
from tests.conftest import ROOT


def test_bad_options_end_with_one_line(capsys):
    assert bench.main(["simulate", "--sizes", "0"]) == 2
    assert bench.main(["simulate", "--electrons", "1e9"]) == 2
    assert bench.main(["coverage", "--mechanisms", "moonlight"]) == 2
    assert bench.main(["train", "--patch", "7"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 4 and all(line.startswith("bin/bench: ") for line in lines)


def test_both_simulators_are_given_the_same_camera():
    getframes = pytest.importorskip("getframes")
    side, electrons = 256, 40.0
    clean = np.full(
        (side, side), electrons * bench_runs.GAIN / (bench_runs.WHITE - bench_runs.BLACK), np.float32
    )
    ours = np.asarray(
        bench_runs.our_model(side).sample(jax.random.key(0), clean, Settings(exposure_s=1.0, frames=2))
    ).astype(float)
    camera = getframes.Camera(bench_runs.peer_config(side), seed=1)
    theirs = np.stack([camera.expose(np.full((side, side), electrons), 1.0).data for _ in range(2)]).astype(
        float
    )
    error = theirs.std() / np.sqrt(theirs.size)
    assert abs(ours.mean() - theirs.mean()) < 5 * np.sqrt(2) * error
    assert abs(ours.var() / theirs.var() - 1) < 5 * np.sqrt(4 / theirs.size)


def test_every_effect_of_the_comparison_is_one_of_both_simulators():
    for mechanisms, fields in GETFRAMES.values():
        model = bench_runs.our_model(16)
        for id, parameters in mechanisms.items():
            model = model.with_mechanism(id, **parameters)
        assert fields and len(model.mechanisms) == len(mechanisms)
        pytest.importorskip("getframes")
    assert all(bench_runs.peer_config(16, (effect,)) for effect in GETFRAMES)


def test_the_table_reports_both_and_their_ratio(capsys, monkeypatch):
    monkeypatch.setattr(
        bench_runs, "GETFRAMES", {"PRNU": GETFRAMES["PRNU"]}
    )  # each effect is a program to compile
    monkeypatch.setattr(bench_runs, "TOGETHER", ("PRNU",))
    assert (
        bench.main(["simulate", "--sizes", "256", "--electrons", "20", "--frames", "1", "--repeats", "1"])
        == 0
    )
    out = capsys.readouterr().out
    assert "warm-up" in out and "load" in out
    rows = [line.split() for line in out.splitlines() if line.startswith(("shot", "+"))]
    assert len(rows) == 3
    if "not installed" not in out:
        for row in rows:
            ours, peer, fast, ratio = map(float, row[-4:])
            least, most = (v + 0.05 for v in (ours - 0.1, ours))  # of what is printed with one decimal
            best = max(peer, fast)
            assert ours > 0 and least / (best + 0.05) - 0.01 < ratio < most / (best - 0.05) + 0.01


def test_coverage_of_a_named_mechanism_is_tabulated(capsys, tmp_path):
    call = [
        "coverage",
        "--mechanisms",
        "quantization",
        "--simulations",
        "3",
        "--out",
        str(tmp_path / "t.json"),
    ]
    assert bench.main(call) == 0
    taken = take(ROOT, tmp_path / "t.json", "covered", None, ["bin/bench coverage"])
    assert taken.columns[-1] == "covered, %" and taken.rows[0] == ("quantization", "step dn", "4", "100.0")
    assert bench.main(call) == 2 and "exists" in capsys.readouterr().err
    (tmp_path / "t.json").unlink()
    assert bench.main(call) == 0
    table = capsys.readouterr().out.splitlines()
    assert table[0].split()[0] == "mechanism" and len(table) == 2
    assert table[1].split()[:2] == ["quantization", "step_dn"] and "100.0 %" in table[1]


def test_a_test_of_denoisers_is_taken_with_its_gains_and_intervals(tmp_path):
    interval = {"value": 30.126, "low": 30.0, "high": 30.25}
    gain = {"value": 0.5, "low": -0.125, "high": 1.0}

    def of(value):
        return {"mean": {**interval, "value": value}}

    result = {
        "seeds": 2, "steps": 30, "scenes": 4, "test_frames": 3, "noisy": {"psnr_db": 20.0},
        "psnr_db": {"real_darks": {**of(31.0), "over_pg": gain, "gap_closed": 0.914},
                    "pg": {"mean": interval}},
        "psnr_db_order": [{"lower": "pg", "upper": "real_darks", "difference": gain, "outcome": "above"}],
        "ssim": {"real_darks": of(0.9), "pg": of(0.8)},
    }  # fmt: skip
    content = {
        "schema": "cannoise/denoising/1",
        "camera": "one",
        "interval": "90 %",
        "exposures_s": {"10": result},
    }
    file = tmp_path / "denoising.json"
    file.write_text(json.dumps(content))
    taken = take(ROOT, file, "denoisers", None, ["bin/denoise test"])
    assert [row[:2] for row in taken.rows] == [("10 s", "pg"), ("10 s", "real darks")]
    assert taken.rows[0][3] == "–" and taken.rows[1][3] == "+0.50 (-0.12 to +1.00)"
    assert taken.values["10_s_pg_psnr"] == "30.13 (30.00 to 30.25)"
    assert taken.values["10_s_real_darks_over_pg"] == "+0.50 (-0.12 to +1.00)"
    assert taken.values["10_s_real_darks_gap"] == "91%"
    assert "cannoise_jax/training" in taken.code["paths"] and len(taken.notes) == 2


def test_a_figure_is_taken_into_the_docs_with_its_hash(tmp_path):
    (tmp_path / "docs" / "images").mkdir(parents=True)
    picture = tmp_path / "noise.png"
    picture.write_bytes(b"\x89PNG rest")
    taken = figure(tmp_path, picture, "Noise.")
    data = (tmp_path / "docs" / taken["file"]).read_bytes()
    assert taken["sha256"] == hashlib.sha256(data).hexdigest() and taken["caption"] == "Noise."
    picture.write_bytes(b"GIF")
    with pytest.raises(BadInput, match="no PNG"):
        figure(tmp_path, picture, "Noise.")
