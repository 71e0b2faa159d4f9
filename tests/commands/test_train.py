"""bin/train from its arguments to its files, on the tiny config; and every refusal in one line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cannoise_jax.commands import train

CI = str(Path(__file__).resolve().parents[2] / "configs" / "ci.py")


def test_a_run_ends_with_table_picture_and_results(tmp_path, capsys):
    folder = tmp_path / "run"
    arguments = ["--workdir", str(folder), "--config", CI, "--config.steps=2", "--config.evaluate_every=2"]
    assert train.main(arguments) == 0
    printed = capsys.readouterr().out
    assert "PG published" in printed and "wrong ref." in printed and "pooled" in printed
    assert (folder / "noise.png").stat().st_size > 10_000
    assert json.loads((folder / "config.json").read_text())["steps"] == 2
    results = json.loads((folder / "results.json").read_text())
    assert results["schema"] == "cannoise/results/1"
    assert set(results["cameras"]) == {"IP", "GP", "S6", "N6", "G4"}
    models = {
        "gaussian", "poisson_gaussian", "poisson_gaussian_recalibrated", "model", "model_wrong_reference",
    }  # fmt: skip
    for row in (*results["cameras"].values(), results["pooled"]):
        assert set(row) == models
        for numbers in row.values():
            assert {"kl", "kl_floor", "kl_smoothed", "patches"} <= set(numbers)
    # Two steps leave the model at its initial noise: published Poisson-Gaussian, up to chance.
    pooled = results["pooled"]
    assert pooled["model"]["kl"] == pytest.approx(pooled["poisson_gaussian"]["kl"], rel=0.2)
    assert pooled["gaussian"]["kl"] > 3 * pooled["poisson_gaussian"]["kl"]
    assert results["seconds"] > 0


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "--workdir"),
        (["--workdir", "RUN", "--config", "nowhere.py"], "nowhere.py"),
        (["--workdir", "RUN", "--config.nothing=1"], "nothing"),
        (["--workdir", "RUN", "--config.steps=many"], "config.steps"),
        (["--workdir", "RUN", "--nothing"], "nothing"),
        (["--workdir", "RUN", "left over"], "left over"),
        (["--workdir", "RUN", "--recordings", "RUN/none,RUN/nothing"], "none: no such folder"),
        (["--workdir", "RUN", "--black-level", "x"], "--black-level"),
    ],
)
def test_refusals_are_one_line(arguments, expected, tmp_path, capsys):
    arguments = [a.replace("RUN", str(tmp_path / "run")) for a in arguments]
    assert train.main(arguments) == 2
    message = capsys.readouterr().err
    assert message.startswith("bin/train: ") and message.count("\n") == 1
    assert expected in message


def test_a_workdir_of_another_config_is_left_alone(tmp_path, capsys):
    (tmp_path / "config.json").write_text(json.dumps({"steps": -1}))
    before = (tmp_path / "config.json").read_text()
    assert train.main(["--workdir", str(tmp_path), "--config", CI]) == 2
    assert "another config" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]
    assert (tmp_path / "config.json").read_text() == before


def test_help(capsys):
    assert train.main(["--help"]) == 0
    assert "--workdir" in capsys.readouterr().out
