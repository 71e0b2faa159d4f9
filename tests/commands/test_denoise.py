"""bin/denoise: a small run from recordings to a table and an image, and what it refuses."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from runpy import run_path

import jax
import numpy as np
import pytest

from cannoise_jax.commands.denoise import main
from cannoise_jax.evaluation.denoising import Interval
from cannoise_jax.recordings.native import read_recording, write_recording
from cannoise_jax.recordings.recording import Recording
from cannoise_jax.sampling import load_model
from cannoise_jax.training.denoise import load_denoiser


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recordings")
    rng = np.random.default_rng(0)
    for name, kind, electrons, exposure in (
        ("a", "bias", 0, 1e-4), ("b", "dark", 0, 10.0), ("c", "flat", 100, 0.01), ("d", "flat", 600, 0.01),
    ):  # fmt: skip
        values = rng.poisson(electrons, (5, 64, 144)) + 3 * rng.normal(size=(5, 64, 144))
        frames = np.rint(200 + 2 * values).astype(np.uint16)
        write_recording(
            folder / f"{name}.h5",
            Recording(frames, "RGGB", (200.0,) * 4, 4095.0, "toy", kind, exposure_s=exposure, iso=100.0),
        )
    return folder


def test_train_test_and_apply(recordings, tmp_path, capsys):
    run = ["--recordings", str(recordings), "--workdir", str(tmp_path)]
    small = ["--steps", "8", "--features", "4", "--batch", "2", "--scenes", "2", "--seeds", "1"]
    assert main(["train", *run, "--noise", "pg,real_darks", "--exposure", "10", *small]) == 0
    files = sorted((tmp_path / "denoisers" / "toy_10s").iterdir())
    assert [f.name for f in files] == ["pg_0.npz", "real_darks_0.npz"]
    written = files[0].stat().st_mtime_ns
    assert main(["train", *run, "--noise", "pg", "--exposure", "10", *small]) == 0
    assert files[0].stat().st_mtime_ns == written  # what is there is kept
    assert main(["test", *run, "--scenes", "2"]) == 0
    record = json.loads((tmp_path / "denoising_toy.json").read_text())["exposures_s"]["10"]
    assert set(record["psnr_db"]) == {"pg", "real_darks"} and record["seeds"] == 1
    assert "over pg [90 %]" in capsys.readouterr().out
    assert main(["test", *run, "--scenes", "2"]) == 2 and "exists" in capsys.readouterr().err
    out = tmp_path / "clean.npy"
    apply = ["apply", "--denoiser", str(files[0]), "--recording", str(recordings / "b.h5"), "--out", str(out)]
    assert main(apply) == 0 and np.load(out).shape == (5, 64, 144)
    assert main(apply) == 2 and "--force" in capsys.readouterr().err


def test_generators_start_from_a_sensor_model_and_are_kept(recordings, tmp_path, monkeypatch, capsys):
    small_networks = run_path(str(Path(__file__).resolve().parents[2] / "configs" / "ci.py"))["get_config"]
    monkeypatch.setattr("cannoise_jax.commands.train.default_config", small_networks)
    run = ["--recordings", str(recordings), "--workdir", str(tmp_path), "--exposure", "10"]
    small = ["--steps", "4", "--features", "4", "--batch", "2", "--scenes", "2", "--seeds", "1"]
    names = ["--noise", "calibrated,ours_on_calibrated", "--generator-steps", "2"]
    assert main(["train", *run, *small, *names]) == 0
    folder = tmp_path / "generators" / "toy_10s_ours_on_calibrated"
    model = load_model(folder)
    assert model.exposure_s == 10 and model.sensors[0].camera == "toy" and model.encoder_module is None
    written = (folder / "model.npz").stat().st_mtime_ns
    (tmp_path / "denoisers" / "toy_10s" / "ours_on_calibrated_0.npz").unlink()
    assert main(["train", *run, *small, *names]) == 0
    assert (folder / "model.npz").stat().st_mtime_ns == written
    assert main(["test", *run[:4], "--scenes", "2"]) == 0
    record = json.loads((tmp_path / "denoising_toy.json").read_text())["exposures_s"]["10"]
    assert set(record["psnr_db"]) == {"calibrated", "ours_on_calibrated"}
    verdict = json.loads((folder / "gain.json").read_text())
    assert record["learned_part"] == {"ours_on_calibrated": verdict}
    assert verdict["adopted"] == (verdict["gain_db"]["low"] > 0)
    own = tmp_path / "denoisers" / "toy_10s" / "ours_on_calibrated_0.npz"
    plain = load_denoiser(own.with_name("calibrated_0.npz")).variables["params"]
    for gain, used in ((Interval(1.0, 0.5, 1.5), True), (Interval(-1.0, -1.5, -0.5), False)):
        monkeypatch.setattr("cannoise_jax.training.worth.gain_of", lambda *_, gain=gain: gain)
        own.unlink()
        (folder / "gain.json").unlink()
        assert main(["train", *run, *small, *names]) == 0
        assert json.loads((folder / "gain.json").read_text())["adopted"] == used
        same = jax.tree.map(np.array_equal, plain, load_denoiser(own).variables["params"])
        assert all(jax.tree.leaves(same)) != used  # what is left out leaves the camera model as it is
    own.unlink()
    (folder / "gain.json").write_text("{}")
    assert main(["train", *run, *small, *names]) == 2 and "gain.json" in capsys.readouterr().err


def test_what_cannot_be_used_is_refused_in_one_line(recordings, tmp_path, capsys):
    run = ["--recordings", str(recordings), "--workdir", str(tmp_path)]
    for arguments, words in (
        (["test", *run], "bin/denoise train makes them"),
        (["train", *run, "--exposure", "3"], "no two dark frames of 3 s"),
        (["train", *run, "--exposure", "10", "--noise", "nonsense"], "neither"),
        (["train", *run, "--exposure", "10", "--noise", "pg+nonsense"], "neither"),
    ):
        assert main(arguments) == 2
        error = capsys.readouterr().err.splitlines()[-1]
        assert error.startswith("bin/denoise: ") and words in error
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("noise", ["pg", "calibrated"])
@pytest.mark.parametrize(
    ("width", "copied", "words"), [(72, False, "patches need 64"), (144, True, "no two")]
)
def test_small_frames_and_copies_are_refused_before_anything_is_made(
    recordings, tmp_path, capsys, width, copied, words, noise
):
    """Of darks that are one frame twice no noise is left to train on."""
    (tmp_path / "in").mkdir()
    for path in recordings.iterdir():
        recording = read_recording(path)
        frames = np.asarray(recording.frames[:])[:, :, :width]
        frames = frames[[0, 0, 0, 0]] if copied and recording.kind == "dark" else frames
        write_recording(tmp_path / "in" / path.name, dataclasses.replace(recording, frames=frames))
    run = ["--recordings", str(tmp_path / "in"), "--workdir", str(tmp_path / "out"), "--noise", noise]
    assert main(["train", *run, "--exposure", "10"]) == 2
    assert words in capsys.readouterr().err.splitlines()[-1] and not (tmp_path / "out").exists()
