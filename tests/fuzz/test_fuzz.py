"""Damaged files and wrong calls by the hundred: one line, exit status 2, nothing written, nothing lost."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import signal
import stat
import subprocess
import sys
import warnings
from collections import Counter
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax import SensorModel
from cannoise_jax.physics.core.sensor_json import write_sensor
from cannoise_jax.recordings.native import read_recording
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.training.denoise import Denoiser, Recipe, save_denoiser
from tests.commands.test_sample import write_model
from tests.conftest import ROOT, SIMULATION
from tests.fuzz.case import Case, Kit
from tests.fuzz.cases import make_case
from tests.fuzz.samples import write_samples
from tests.recordings.folders.night import night

GIGABYTES = 4.0
"""What one case may take. Loading JAX takes some 3 GB of addresses."""


class Worker:
    """The process that runs the cases."""

    def __init__(self):
        # All that is compiled is kept: each fork starts from nothing.
        cache = {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
        environment = {**os.environ, **cache, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.fuzz.worker"],
            cwd=ROOT,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def run(
        self,
        case: Case,
        folder: Path,
        seconds: float | None = None,
        ready: Path | None = None,
        cpu: float | None = None,
    ) -> dict:
        """seconds: until it is killed, counted from when `ready` is there, if named. cpu: time of a core.
        Those that are not named are the case's."""
        cpu = case.seconds if cpu is None else cpu
        seconds = 8 * case.seconds if seconds is None else seconds
        job = {"target": case.target, "argv": case.argv, "cwd": str(folder), "ready": str(ready or "")}
        job |= {"seconds": seconds, "cpu": cpu, "gigabytes": GIGABYTES}
        self.process.stdin.write(json.dumps(job) + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())

    def close(self):
        self.process.stdin.close()
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:  # a run was interrupted in the middle of a case
            os.killpg(self.process.pid, signal.SIGKILL)


@pytest.fixture(scope="module")
def kit(tmp_path_factory) -> Kit:
    folder = tmp_path_factory.mktemp("kit")
    camera = SensorModel.poisson_gaussian((0.5, 1.0), (3.0, 2.5), 64, 1023, "RGGB", iso=(100.0, 200.0))
    camera = camera.with_mechanism("row_noise", sigma_dn=0.8).with_mechanism("dsnu", sigma_dn=1.0)
    write_sensor(folder / "sensor.json", camera.with_maps((4, 6)))
    assert (folder / "sensor.npz").is_file()
    write_model(folder)
    recipe = Recipe(features=4, depth=2)
    variables = recipe.module.init(jax.random.key(0), jnp.ones((1, 8, 8, 4)), train=False)
    about = {"gain_dn_per_e": 1.0, "full_scale_e": 100.0}
    save_denoiser(folder / "denoiser.npz", Denoiser(recipe, jax.device_get(variables), about))
    result = sorted((ROOT / "docs" / "results").glob("*.json"))[0]
    (folder / "samples").mkdir()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        samples = write_samples(folder / "samples")
    return Kit(
        samples,
        night(folder / "night"),
        folder / "sensor.json",
        folder / "model.npz",
        folder / "denoiser.npz",
        result,
    )


def prepared(folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "in").mkdir(parents=True)
    (folder / "out").mkdir()
    return folder


def tree(folder: Path) -> dict[str, str]:
    """Every name below with what it is and holds."""
    seen = {}
    for path in sorted(folder.rglob("*")):
        mode = path.lstat().st_mode
        if stat.S_ISREG(mode):
            content = hashlib.sha256(path.read_bytes()).hexdigest()
        else:
            content = os.readlink(path) if stat.S_ISLNK(mode) else ""
        seen[str(path.relative_to(folder))] = f"{stat.S_IFMT(mode):o} {content}"
    return seen


def faults(case: Case, answer: dict, before: dict, after: dict, folder: Path) -> list[str]:
    """What is wrong with an answer: empty where it is one line and nothing written, or a sound result."""
    lines = [line for line in answer["err"].splitlines() if line.strip()]
    if answer["status"] not in (0, 2):
        return [f"status {answer['status']}: {' / '.join(lines[-2:])[-300:]}"]
    found = []
    if answer["megabytes"] > 1500:
        found.append(f"{answer['megabytes']:.0f} MB")
    if answer["status"] == 2:
        name = "read: " if case.target.startswith("read:") else f"bin/{case.target}"
        # What was passed over may be said before the line that says why nothing is written.
        lines = [line for line in lines if not re.match(r"\[ *[\d.]+ s\] ", line)]  # how far it had come
        if not 1 <= len(lines) <= 3 or not all(line.startswith(name) for line in lines):
            found.append(f"{len(lines)} lines: {' / '.join(lines)[:300]}")
        elif max(map(len, lines)) > 900:  # some name every mechanism there is
            found.append(f"a line of {max(map(len, lines))} characters")
        tells = case.kind.startswith("folder") or case.target in ("train", "calibrate")
        if answer["out"].strip() and not tells:  # these say what they read and measured
            found.append(f"printed: {answer['out'][:100]}")
        if before != after:
            found.append(f"files changed: {sorted(before.items() ^ after.items())[:3]}")
    else:
        if case.must == "refuse":
            found.append("accepted")
        if any("Traceback" in line or "Warning:" in line for line in lines):
            found.append(f"noise on the screen: {' / '.join(lines)[:300]}")
        changed = {name for name in before if before[name] != after.get(name)}
        if changed:
            found.append(f"inputs changed: {sorted(changed)[:3]}")
        for path in (folder / "out").rglob("*.h5"):
            found += unsound(path)
        for path in (folder / "out").glob("sensor.json"):
            SensorModel.load(path)
        if case.target in ("convert", "calibrate") and "--dry-run" not in case.argv:
            found += [] if any((folder / "out").iterdir()) else ["wrote nothing"]
    return found


def unsound(path: Path) -> list[str]:
    """What a written recording must not be."""
    try:
        recording = read_recording(path)
        values = np.asarray(recording.frames[:])
    except (BadInput, OSError) as error:
        return [f"wrote what cannot be read: {error}"]
    stated = [recording.iso, recording.exposure_s, recording.temperature_c]
    numbers = [*recording.black_level, recording.white_level, *(v for v in stated if v is not None)]
    # A white level beyond 16 bits is a mistake that can be found, and is kept as the file states it.
    if not (np.isfinite(numbers).all() and max(recording.black_level) < recording.white_level <= 2**20):
        return [f"wrote levels {recording.black_level}, {recording.white_level}, {stated}"]
    return [] if values.ndim == 3 and values.size else [f"wrote frames {values.shape}"]


def run_cases(kit: Kit, worker: Worker, seeds, folder: Path) -> tuple[Counter, list[str]]:
    """Counts by kind and outcome, and the faults."""
    counts: Counter = Counter()
    failures: list[str] = []
    for seed in seeds:
        place = prepared(folder / "case")
        case = make_case(kit, seed, place)
        before = tree(place)
        answer = worker.run(case, place)
        wrong = faults(case, answer, before, tree(place), place)
        counts[case.kind, "fault" if wrong else "refused" if answer["status"] else "accepted"] += 1
        failures += [f"case {seed}, {case.kind}, {' '.join(case.argv)[:120]}: {reason}" for reason in wrong]
    return counts, failures


OUTCOMES = ("refused", "accepted", "fault")
WHAT = {
    "file": "bytes of a recording, any format",
    "attribute": "fields of a recording",
    "frames": "type and shape of frames",
    "header": "keywords of FITS files",
    "side-car": "JSON beside a stack",
    "thing": "pipes, broken links, claims of terabytes",
    "folder": "one file of a night",
    "calibrate": "flats and darks",
    "sensor": "a camera model and its maps",
    "model": "a trained model",
    "rewritten": "a model or a denoiser written anew",
    "report": "a report of a diagnosis",
    "result": "a published result",
    "judged": "what diagnose and compare read",
    "made": "what simulate, sample and denoise read",
    "call": "command lines of all commands",
}
"""The kinds of cases, by their first word, as docs/reliability.md has them."""
CODE = (
    "cannoise_jax/commands",
    *SIMULATION,
    "cannoise_jax/discovery",
    "cannoise_jax/sampling.py",
    "cannoise_jax/model_file.py",
    "cannoise_jax/training/denoise.py",
)


def report(counts: Counter) -> str:
    totals = Counter()
    for (_, outcome), n in counts.items():
        totals[outcome] += n
    kinds = sorted({kind for kind, _ in counts})
    rows = [f"{k}: " + ", ".join(f"{o} {counts[k, o]}" for o in totals if counts[k, o]) for k in kinds]
    return "\n".join([f"{sum(totals.values())} cases: {dict(totals)}", *rows])


def test_cases_of_every_kind(kit, worker, tmp_path):
    counts, failures = run_cases(kit, worker, range(120), tmp_path)
    print(report(counts))
    assert {kind.partition(" ")[0] for kind, _ in counts} == set(WHAT)
    assert not failures, "\n".join(failures)


@pytest.mark.slow
def test_ten_thousand_cases(kit, worker, tmp_path, request, tables):
    first, number = (request.config.getoption(name) for name in ("--first-seed", "--cases"))
    counts, failures = run_cases(kit, worker, range(first, first + number), tmp_path)
    print(report(counts))
    columns = ("what is damaged or odd", "cases", *OUTCOMES)
    whole: Counter = Counter()
    for (kind, outcome), n in counts.items():
        whole[WHAT[kind.partition(" ")[0]], outcome] += n
        whole["all", outcome] += n
    rows = [
        (what, str(sum(whole[what, o] for o in OUTCOMES)), *(str(whole[what, o]) for o in OUTCOMES))
        for what in (*WHAT.values(), "all")
    ]
    values = {"seeds": f"{first:,} to {first + number - 1:,}", "cases": f"{number:,}"}
    tables.add("fuzz", columns, rows, CODE, **values, faults=str(whole["all", "fault"]))
    assert not failures, "\n".join(failures)


def test_the_worker_sees_what_goes_wrong(worker, tmp_path):
    """A hang, a crash, a grab for memory and a traceback are told apart from a refusal."""
    home = "read:tests.fuzz.test_fuzz."
    place = prepared(tmp_path / "case")
    outcomes = {
        name: worker.run(Case("", home + name, ["1"]), place)["status"]
        for name in ("crash", "grab", "raises")
    }
    assert outcomes["crash"] < 0 and outcomes["grab"] == 70 and outcomes["raises"] == 70


def crash(_):
    os.abort()


def grab(_):
    np.ones(int(GIGABYTES * 2**30 / 8) + 1)


def raises(_):
    raise ValueError("not one line")
