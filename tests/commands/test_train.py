"""bin/train from its arguments to its files, on the tiny config; and every refusal in one line."""

from __future__ import annotations

import json
import os
import re
import signal
import sys
import time
from pathlib import Path

import pytest

from cannoise_jax.commands import train
from cannoise_jax.commands.train import main
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.training import data, devices

CI = str(Path(__file__).resolve().parents[2] / "configs" / "ci.py")


def test_a_run_ends_with_table_picture_and_results(tmp_path, capsys):
    folder = tmp_path / "run"
    once = "--config.evaluate_every=6"
    assert train.main(["--workdir", str(folder), "--config", CI, once]) == 0
    printed = capsys.readouterr().out
    assert "PG published" in printed and "wrong refs." in printed and "pooled" in printed
    assert (folder / "noise.png").stat().st_size > 10_000
    assert json.loads((folder / "config.json").read_text())["steps"] == 6
    results = json.loads((folder / "results.json").read_text())
    assert results["schema"] == "cannoise/results/1"
    assert set(results["cameras"]) == {"IP", "GP", "S6", "N6", "G4"}
    models = {
        "gaussian", "poisson_gaussian", "poisson_gaussian_estimated", "poisson_gaussian_recalibrated",
        "model", "model_given", "model_wrong_reference",
    }  # fmt: skip
    for row in (*results["cameras"].values(), results["pooled"]):
        assert set(row) == models
        for numbers in row.values():
            assert {"kl", "kl_floor", "kl_smoothed", "patches"} <= set(numbers)
    assert set(results["one_reference"]) == {*results["cameras"], "pooled"}
    # Six steps leave the model at its initial noise: Poisson-Gaussian at the level it has, up to chance.
    pooled = results["pooled"]
    for name, level in (("model", "estimated"), ("model_given", "recalibrated")):
        assert pooled[name]["kl"] == pytest.approx(pooled[f"poisson_gaussian_{level}"]["kl"], rel=0.25)
    assert pooled["gaussian"]["kl"] > 3 * pooled["poisson_gaussian"]["kl"]
    assert results["seconds"] > 0


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "--workdir"),
        (["--workdir", "RUN", "--config", "nowhere.py"], "nowhere.py: no such file"),
        (["--workdir", "RUN", "--config.nothing=1"], "nothing"),
        (["--workdir", "RUN", "--config.steps=many"], "config.steps=many: 'many': give a whole number"),
        (["--workdir", "RUN", "--white-level", "high"], "give a number"),
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


@pytest.mark.parametrize(
    "text",
    [
        "def get_config(:",
        "",
        "get_config = lambda: nothing",
        "get_config = lambda: {'steps': 1}",
        "import nothing_of_this_name",
        "1 / 0",
        "def get_config():\n    raise RuntimeError('two\\nlines')",
    ],
)
def test_a_broken_config_file_is_one_line(text, tmp_path, capsys):
    (tmp_path / "broken.py").write_text(text)
    assert train.main(["--workdir", str(tmp_path / "run"), "--config", str(tmp_path / "broken.py")]) == 2
    message = capsys.readouterr().err
    assert message.startswith("bin/train: ") and message.count("\n") == 1
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "field", ["batch_size=0", "patch=33", "initial_noise=nothing", "log_every=0", "optimiser.schedule=x"]
)
def test_a_config_that_makes_no_sense_is_refused_before_the_data(field, tmp_path, capsys):
    arguments = ["--workdir", str(tmp_path / "run"), "--config", CI, f"--config.{field}"]
    assert train.main(arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.count("\n") == 1
    assert f"config.{field.partition('=')[0]}" in printed.err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("content", [b"\xff\xfe", b"[" * 100_000, b"{}", b'{"data": []}', None])
@pytest.mark.parametrize("flags", [[], ["--config", CI]])
def test_a_damaged_config_in_the_workdir_is_one_line(content, flags, tmp_path, capsys):
    path = tmp_path / "config.json"
    if content is None:
        os.mkfifo(path)
    else:
        path.write_bytes(content)
    if content is None and not flags:
        flags = ["--config", CI]  # without a stored config a run would start
    assert main(["--workdir", str(tmp_path), *flags]) == 2
    said = capsys.readouterr().err.strip()
    assert len(said.splitlines()) == 1 and "workdir" in said
    assert [p.name for p in tmp_path.iterdir()] == ["config.json"]


def test_after_a_start_that_failed_another_config_may_follow(tmp_path, capsys):
    def start(*arguments):
        assert train.main(["--workdir", str(tmp_path), "--config", CI, *arguments]) == 2
        return capsys.readouterr().err

    nowhere = str(tmp_path / "nowhere")
    assert "no such folder" in start("--recordings", nowhere)
    assert "no such folder" in start("--recordings", nowhere, "--config.loss.triplet=0")


@pytest.mark.parametrize("more", [[], ["--coordinator", "localhost:1"]])
def test_a_run_that_took_no_step_leaves_nothing_for_another_config_to_stumble_over(
    more, tmp_path, monkeypatch
):
    def interrupted(config, workdir, tell):
        (workdir / "checkpoints").mkdir()
        (workdir / "config.json").write_text("{}")
        raise KeyboardInterrupt

    monkeypatch.setattr(data, "load_data", interrupted)
    monkeypatch.setattr(devices, "join", lambda *given: None)
    assert train.main(["--workdir", str(tmp_path / "run"), "--config", CI, *more]) == 130
    assert (tmp_path / "run").exists() == bool(more)  # where processes share it, it is others', too


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_outside_training_is_one_line(number, tmp_path, capsys, monkeypatch):
    def interrupted(config, workdir, tell):
        os.kill(os.getpid(), number)
        time.sleep(10)

    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(data, "load_data", interrupted)
    assert train.main(["--workdir", str(tmp_path / "run"), "--config", CI]) == 130
    message = capsys.readouterr().err
    assert message == "bin/train: interrupted: the same command begins again\n"
    assert not (tmp_path / "run").exists()
    (tmp_path / "run" / "checkpoints" / "2").mkdir(parents=True)
    assert train.main(["--workdir", str(tmp_path / "run"), "--config", CI]) == 130
    assert "goes on from the last checkpoint" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGTERM) == before


def test_an_interruption_that_python_drops_is_not_lost(tmp_path, capsys, monkeypatch):
    class Dropped:
        def __del__(self):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(10)

    def interrupted(config, workdir, tell):
        Dropped()  # an exception in a destructor goes nowhere

    monkeypatch.setattr(data, "load_data", interrupted)
    monkeypatch.setattr(sys, "unraisablehook", lambda dropped: None)
    assert train.main(["--workdir", str(tmp_path), "--config", CI]) == 130
    assert "interrupted" in capsys.readouterr().err


def test_help(capsys):
    assert train.main(["--help"]) == 0
    assert "--workdir" in capsys.readouterr().out


def test_a_workdir_that_takes_no_files_is_refused_before_any_work(tmp_path, capsys):
    assert train.main(["--workdir", "/proc", "--config", CI]) == 2
    captured = capsys.readouterr()
    remedy = "make it writable, or name another --workdir"
    assert re.fullmatch(rf"bin/train: /proc: cannot be written \(.*\): {remedy}\n", captured.err)
    assert "reading the data" not in captured.out
    (tmp_path / "file").write_text("")
    assert train.main(["--workdir", str(tmp_path / "file"), "--config", CI]) == 2
    assert "file: is a file: name a folder for --workdir" in capsys.readouterr().err


def test_a_workdir_goes_on_with_its_own_config(tmp_path):
    workdir = tmp_path / "run"
    started, *_ = train._read_flags(["--workdir", str(workdir), "--config.steps=7", "--config.data.scenes=5"])
    workdir.mkdir()
    (workdir / "config.json").write_text(started.to_json_best_effort())
    resumed, where, _ = train._read_flags(["--workdir", str(workdir)])
    assert where == workdir and (resumed.steps, resumed.data.scenes) == (7, 5)
    assert resumed.to_json_best_effort(sort_keys=True) == started.to_json_best_effort(sort_keys=True)
    longer, *_ = train._read_flags([f"--workdir={workdir}", "--config.steps=9"])
    assert (longer.steps, longer.data.scenes) == (9, 5)
    for broken in ("{", "[1]"):
        (workdir / "config.json").write_text(broken)
        with pytest.raises(BadInput, match="use another --workdir"):
            train._read_flags(["--workdir", str(workdir)])


@pytest.mark.parametrize(
    ("flag", "said"),
    [
        ("--config.stepz=5", "--config.stepz: no such field: did you mean --config.steps?"),
        ("--config.data.sourc=x", "--config.data.sourc: no such field: did you mean --config.data.source?"),
        ("--config.qqqqqq=5", "--config.qqqqqq: no such field"),
        ("--stepz=5", "unknown flag --stepz: did you mean --config.steps?"),
        ("--recording=x", "unknown flag --recording: did you mean --recordings?"),
        ("--black_level=64", "unknown flag --black_level: did you mean --black-level?"),
        ("--qqqqqq", "unknown flag --qqqqqq: see bin/train --help"),
    ],
)
def test_a_field_that_does_not_exist_is_named_with_its_neighbour(flag, said, tmp_path, capsys):
    assert main(["--workdir", str(tmp_path / "run"), flag]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"bin/train: {said}") and error.count("\n") == 1
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("empty", [["--recordings", ""], ["--recordings="]])
def test_an_empty_name_of_recordings_starts_nothing(empty, tmp_path, capsys):
    assert main(["--workdir", str(tmp_path / "run"), *empty]) == 2
    assert "--recordings: an empty name" in capsys.readouterr().err and not (tmp_path / "run").exists()
