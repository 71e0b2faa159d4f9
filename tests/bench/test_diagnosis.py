"""The costs of a diagnosis: what is timed, and the table that says so."""

from __future__ import annotations

import json

import numpy as np
import pytest

from cannoise_jax.bench import diagnosis
from cannoise_jax.bench.diagnosis import Run, camera, numpy_pass, write_set
from cannoise_jax.commands.bench import main
from cannoise_jax.recordings.load import load_capture_set


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(diagnosis, "SIZE", (64, 96))


def test_the_recordings_are_those_of_the_camera(small, tmp_path):
    write_set(tmp_path, camera(diagnosis.EFFECT))
    capture = load_capture_set(tmp_path)
    dark = next(r for r in capture.recordings if r.kind == "dark")
    frames = np.asarray(dark.frames[:], float)
    assert [r.kind for r in capture.recordings].count("flat") == 2
    noise = np.hypot(diagnosis.GAIN * diagnosis.READ_E, 12**-0.5)
    assert np.std(frames, 0, ddof=1).mean() == pytest.approx(0.965 * noise, rel=0.02)  # of 8, c4 is 0.965
    assert np.std(frames.mean(0)) == pytest.approx(np.hypot(1.0, noise / 8**0.5), rel=0.03)
    assert numpy_pass(capture) > 0


def test_a_run_is_timed_twice_with_a_cache_of_its_own(small, tmp_path, monkeypatch, capsys):
    asked = []

    def run(flags, environment):
        asked.append(environment["XDG_CACHE_HOME"])
        assert not any(name.startswith("JAX_COMPILATION_CACHE") for name in environment)
        return Run(8.0 if asked.count(asked[-1]) == 1 else 4.0, 6.0, 1000.0)

    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "of others"))
    monkeypatch.setattr(diagnosis, "_run", run)
    assert main(["diagnose", "--out", str(tmp_path / "cost.json")]) == 0
    assert [asked.count(place) for place in asked] == [2] * 4 and len(set(asked)) == 2
    table = json.loads((tmp_path / "cost.json").read_text())
    first = dict(zip(table["columns"], table["rows"][0], strict=True))
    assert (first["first time, s"], first["again, s"], first["CPU time, s"]) == ("8", "4", "6")
    assert float(first["CPU-s a megapixel-frame"]) == pytest.approx(6 / 0.147, rel=0.05)


def test_a_folder_that_cannot_be_read_is_refused_first(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(diagnosis, "_run", lambda *_: pytest.fail("timed before all was read"))
    assert main(["diagnose", "--recordings", str(tmp_path / "none")]) == 2
    assert "none" in capsys.readouterr().err
