"""kill -9 at random times: what was there is whole, the next run cleans up, training ends at the same bits"""

from __future__ import annotations

import hashlib
import json
import random
import shutil
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.core.sensor_json import write_sensor
from cannoise_jax.recordings.native import read_recording, write_recording
from tests.commands.test_sample import write_model
from tests.conftest import ROOT
from tests.discovery.capture import capture_set
from tests.fuzz import killed
from tests.fuzz.case import Case
from tests.fuzz.samples import FIELDS, frames, native
from tests.fuzz.test_fuzz import Worker, prepared
from tests.recordings.folders.night import night

FEW, MANY, SOME = 2, 200, 50
WRITING = tuple(f"cannoise_jax/recordings/{name}.py" for name in ("atomic", "native", "unfinished"))
TRAINING = (*WRITING, "cannoise_jax/training", "cannoise_jax/commands/train.py")
CODE = (
    *(*WRITING, "cannoise_jax/recordings/folders/store.py", "cannoise_jax/training"),
    *("cannoise_jax/physics/core/sensor_json.py", "cannoise_jax/discovery/report/save.py"),
    *(f"cannoise_jax/commands/{name}.py" for name in ("convert", "diagnose", "sample_frames", "simulate")),
)
"""What the tables of docs/reliability.md depend on, that of the command `train` on TRAINING."""


def kill(worker: Worker, target: str, folder: Path, seconds: float) -> bool:
    """Runs a program of `killed`, kills it that long after it was ready; True where it was killed."""
    (folder / "ready").unlink(missing_ok=True)
    answer = worker.run(
        Case("", f"read:tests.fuzz.killed.{target}", [str(folder)]), folder, seconds, folder / "ready"
    )
    assert answer["status"] in ("hung", 0), answer["err"][-600:]
    return answer["status"] == "hung"


def leftovers(folder: Path) -> list[str]:
    ends, starts = (".partial", ".tmp"), ".unfinished."
    return [p.name for p in folder.rglob(".*") if p.name.endswith(ends) or p.name.startswith(starts)]


def told(tables, what: str, killed: int, runs: int, held: str, name: str = "kills", code=CODE) -> None:
    """Notes a series of kills for the table."""
    row = (what, f"{killed} of {runs}", held)
    tables.add(name, ("killed at random times", "before its end", "what held each time"), [row], code)


def counts(request) -> int:
    return MANY if request.config.getoption("--slow") else FEW


def test_a_camera_model_is_one_of_the_two_that_were_written(worker, tmp_path, request, tables):
    rng, seen = random.Random(0), set()
    path = tmp_path / "sensor.json"
    write_sensor(path, killed.versions(1))
    for _ in range(counts(request)):
        assert kill(worker, "write_sensors", tmp_path, rng.uniform(0, 0.2))
        model = SensorModel.load(path)
        fitted = model.mechanisms[0]
        number = round(float(np.ravel(jax.tree.leaves(fitted.parameters)[-1])[0]))
        assert number in (1, 2) and next(iter(fitted.maps.values())).shape[-1] == 6 * number
        seen.add(number)
    write_sensor(path, killed.versions(2))
    assert leftovers(tmp_path) == [] and (len(seen) == 2 or counts(request) == FEW)
    told(tables, "a camera model written over and over", *2 * (counts(request),), "one of the two versions")


def test_a_recording_is_whole(worker, tmp_path, request, tables):
    rng = random.Random(1)
    for _ in range(counts(request)):
        assert kill(worker, "write_recordings", tmp_path, 0.02 + rng.uniform(0, 0.1))
        if (tmp_path / "r.h5").exists():
            values = read_recording(tmp_path / "r.h5").frames[:]
            assert values.shape == (4, 32, 48) and values.min() == values.max() in (1, 2)
    write_recording(tmp_path / "r.h5", read_recording(tmp_path / "r.h5"))
    assert leftovers(tmp_path) == []
    told(tables, "a recording written over and over", *2 * (counts(request),), "one of the two versions")


def test_the_files_of_a_report_are_whole(worker, tmp_path, request, tables):
    rng = random.Random(2)
    for _ in range(counts(request)):
        assert kill(worker, "write_reports", tmp_path, 0.05 + rng.uniform(0, 0.2))
        for name in ("report.json", "report.html"):
            if (tmp_path / name).exists():
                lines = (tmp_path / name).read_text().splitlines()
                assert len(lines) == 1000 and len(set(lines)) == 1
        if (tmp_path / "sensor.json").exists():
            SensorModel.load(tmp_path / "sensor.json")
    told(
        tables, "the files of a report written over and over", *2 * (counts(request),), "every file is whole"
    )


def test_training_that_is_killed_ends_at_the_same_bits(worker, tmp_path, request, tables):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    whole.mkdir()
    parts.mkdir()
    assert not kill(worker, "train", whole, 120)
    expected = (whole / "digest").read_text()
    rng, kills, rounds = random.Random(3), 0, 0
    while kills < counts(request):
        rounds += 1
        for path in parts.rglob("*"):  # a finished run begins anew
            if path.name == "digest":
                assert path.read_text() == expected
                path.unlink()
                shutil.rmtree(parts / "w")
                break
        kills += kill(worker, "train", parts, rng.uniform(0.05, 2.5))
        assert rounds < 4 * counts(request) + 20
    for _ in range(20):
        if not kill(worker, "train", parts, 120):
            break
    assert (parts / "digest").read_text() == expected
    stored = sorted(p.name for p in (parts / "w" / "checkpoints").iterdir())
    assert all(name.isdigit() for name in stored), "what a kill left is cleaned up"
    told(tables, "the loop of training, a step of milliseconds", kills, rounds, "it ends at the same bits")


@pytest.mark.slow
def test_the_command_train_that_is_killed_ends_at_the_same_bits(worker, tmp_path, request, tables):
    """Networks, data and checkpoints of the tiny config; as often as --minutes allows."""
    folder, rng, killed_, rounds = prepared(tmp_path / "case"), random.Random(7), 0, 0
    steps = ["--config.steps=12", "--config.checkpoint_every=2", "--config.evaluate_every=6"]
    config = str(ROOT / "configs" / "ci.py")
    case = Case("", "train", ["--workdir", "out/w", "--config", config, *steps])
    model = folder / "out" / "w" / "model.npz"

    def bits() -> str:
        with np.load(model) as stored:
            return hashlib.sha256(b"".join(stored[name].tobytes() for name in sorted(stored))).hexdigest()

    worker.run(case, folder, 1000, cpu=1000)  # what it compiles the others load
    expected = bits()
    shutil.rmtree(folder / "out" / "w")
    whole = worker.run(case, folder, 1000, cpu=1000)
    assert whole["status"] == 0 and bits() == expected, whole["err"][-600:]
    end = time.monotonic() + 60 * request.config.getoption("--minutes")
    while killed_ < MANY and (time.monotonic() < end or not killed_):
        rounds += 1
        if model.exists():
            assert bits() == expected
            shutil.rmtree(folder / "out" / "w")
        answer = worker.run(case, folder, rng.uniform(0, 1.05) * whole["seconds"], cpu=1000)
        assert answer["status"] in ("hung", 0), answer["err"][-600:]
        killed_ += answer["status"] == "hung"
    assert worker.run(case, folder, 1000, cpu=1000)["status"] == 0 and bits() == expected
    held = "it ends at the same bits"
    told(tables, "`train`, the tiny config", killed_, rounds, held, "kills_train", TRAINING)


def test_convert_that_is_killed_leaves_nothing_or_all(worker, tmp_path, request, tables):
    rng = random.Random(4)
    folder = prepared(tmp_path / "case")
    native(folder / "in" / "a.h5", frames(), FIELDS)
    case = Case("", "convert", ["in/a.h5", "out/made.h5", "--force"])
    ended = []
    for _ in range(counts(request)):
        answer = worker.run(case, folder, rng.uniform(0, 0.15))
        ended.append(answer["status"])
        if (folder / "out" / "made.h5").exists():
            assert read_recording(folder / "out" / "made.h5").frames[:].shape == (4, 24, 32)
    assert worker.run(case, folder)["status"] == 0
    assert [p.name for p in (folder / "out").iterdir()] == ["made.h5"]
    assert set(ended) <= {0, "hung"}
    told(tables, "`convert`", ended.count("hung"), len(ended), "nothing, or the whole recording")


def sound(path: Path) -> bool:
    """Whether a result is whole by its own reader."""
    if path.suffix == ".h5":
        return np.asarray(read_recording(path).frames[:]).ndim == 3
    if path.name == "sensor.json":
        return bool(SensorModel.load(path).camera)
    text = path.read_text()
    return bool(json.loads(text)) if path.suffix == ".json" else text.rstrip().endswith("</html>")


def survives(worker: Worker, case: Case, folder: Path, kills: int, seed: int, cpu: float = 20) -> int:
    """Kills a command at random times from its start to its end; what it leaves is whole each time, and the
    next run ends as one that was never killed. Returns how many were killed."""
    worker.run(case, folder, 1000, cpu=cpu)  # what it compiles the others load
    whole = worker.run(case, folder, 1000, cpu=cpu)
    assert whole["status"] == 0, whole["err"][-600:]
    names = {p.name for p in (folder / "out").iterdir()}
    rng, killed_, number, quickest = random.Random(seed), 0, 0, whole["seconds"]
    plain = Case("", case.target, [word for word in case.argv if word != "--force"])
    while number < kills or (
        not killed_ and number < 10 * kills
    ):  # a busy machine may end before it is killed
        early = 1.05 if number < kills else 0.5
        number += 1
        empty = not number % 2  # as often into an empty folder as over what is there
        if empty:
            shutil.rmtree(folder / "out")
            (folder / "out").mkdir()
        answer = worker.run(plain if empty else case, folder, rng.uniform(0, early) * quickest, cpu=cpu)
        assert answer["status"] in ("hung", 0), answer["err"][-600:]
        killed_ += answer["status"] == "hung"
        if answer["status"] == 0:  # what else runs on the machine changes how long it takes
            quickest = min(quickest, answer["seconds"])
        left = [p for p in (folder / "out").iterdir() if not p.name.startswith(".")]
        assert {p.name for p in left} <= names and all(sound(p) for p in left)
        if empty and answer["status"] == "hung":  # what is not finished is made again, what is stays
            again = worker.run(plain, folder, 1000, cpu=cpu)
            quickest = min(quickest, again["seconds"] if again["status"] == 0 else quickest)
            assert again["status"] == 0 or ("exists:" in again["err"] and {p.name for p in left} == names)
            assert {p.name for p in (folder / "out").iterdir()} == names
    assert worker.run(case, folder, 1000, cpu=cpu)["status"] == 0
    assert {p.name for p in (folder / "out").iterdir()} == names
    assert all(sound(p) for p in (folder / "out").iterdir())
    return killed_


def drawing(folder: Path, command: str) -> Case:
    """A call that makes three recordings: simulate or sample draws them, convert sorts a night into them."""
    if command == "convert":
        night(folder / "in", size=(400, 600))
        return Case("", "convert", ["in", "out", "--force"])
    rng = np.random.default_rng(0)
    (folder / "in" / "clean").mkdir()
    for name in "abc":
        np.save(folder / "in" / "clean" / f"{name}.npy", rng.uniform(0, 0.9, (64, 64)).astype(np.float32))
    more = ["--clean", "in/clean", "--frames", "8", "--out", "out", "--force"]
    if command == "simulate":
        return Case("", "simulate", ["--sensor", "preset:sony_a7s2", *more])
    write_model(folder / "in")
    levels = ["--black-level", "64", "--white-level", "1023"]
    return Case("", "sample", ["--model", "in", "--reference", "A", "--iso", "100", *levels, *more])


@pytest.mark.parametrize(
    "command",
    [
        "convert",
        pytest.param("simulate", marks=pytest.mark.slow),
        pytest.param("sample", marks=pytest.mark.slow),
    ],
)
def test_recordings_in_the_making_are_whole_after_a_kill_and_made_again(
    command, worker, tmp_path, request, tables
):
    folder = prepared(tmp_path / "case")
    kills = SOME if request.config.getoption("--slow") else FEW
    count = survives(worker, drawing(folder, command), folder, kills, 5)
    what = "`convert`, a folder" if command == "convert" else f"`{command}`"
    told(tables, what, count, kills, "every recording is whole, and the next run completes them")
    assert count


@pytest.mark.slow
def test_a_diagnosis_that_is_killed_leaves_whole_reports(worker, tmp_path, tables):
    folder = prepared(tmp_path / "case")
    for recording in capture_set(5, kinds="d", size=(32, 48)).recordings:
        write_recording(folder / "in" / recording.path, recording)
    case = Case("", "diagnose", ["--recordings", "in", "--out", "out", "--force"])
    count = survives(worker, case, folder, SOME, 6, cpu=1000)
    held = "every file is whole, and the next run replaces them"
    told(tables, "`diagnose`", count, SOME, held, "kills_diagnose")
    assert count > SOME // 2


@pytest.mark.parametrize("size", [100, pytest.param(3_000, marks=pytest.mark.slow)])
def test_training_on_a_full_disk_is_one_line_and_resumes(worker, tmp_path, size):
    full = Case("", "read:tests.fuzz.killed.train_on_a_full_disk", [str(tmp_path), str(size)])
    answer = worker.run(full, tmp_path, 120)
    lines = answer["err"].strip().splitlines()
    assert answer["status"] == 2 and len(lines) == 1 and "cannot be written" in lines[0], answer["err"][-800:]
    again = worker.run(Case("", "read:tests.fuzz.killed.train", [str(tmp_path)]), tmp_path, 120)
    assert again["status"] == 0 and (tmp_path / "digest").exists(), again["err"][-800:]
