"""bin/denoise: a small run from recordings to a table and an image, and what it refuses."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from runpy import run_path

import jax
import numpy as np
import pytest

from cannoise_jax.commands.denoise import main
from cannoise_jax.commands.denoise_sources import verdict_of
from cannoise_jax.evaluation.denoising import Interval
from cannoise_jax.model_file import load_model
from cannoise_jax.recordings.native import read_recording, write_recording
from cannoise_jax.recordings.recording import BadInput, Recording
from cannoise_jax.training.denoise import load_denoiser, save_denoiser


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
    folder = ["apply", "--denoiser", str(files[0]), "--recording", str(recordings), "--out", "x.npy"]
    assert main(folder) == 2 and "is a folder" in capsys.readouterr().err
    frames = tmp_path / "bare.npy"
    np.save(frames, np.asarray(read_recording(recordings / "b.h5").frames[:]))
    bare = [*apply[:4], str(frames), "--out", str(tmp_path / "bare_clean.npy")]
    assert main(bare) == 2 and "set them with --cfa, --black-level and" in capsys.readouterr().err
    assert main([*bare, "--cfa", "RGGB", "--black-level", "200", "--white-level", "4095"]) == 0
    assert np.array_equal(np.load(out), np.load(tmp_path / "bare_clean.npy"))


SMALL = ["--steps", "8", "--features", "4", "--batch", "2", "--scenes", "2", "--seeds", "1"]


@pytest.fixture(scope="module")
def kept(recordings, tmp_path_factory):
    """A workdir of two denoisers."""
    workdir = tmp_path_factory.mktemp("kept")
    run = ["--recordings", str(recordings), "--workdir", str(workdir), "--exposure", "10"]
    assert main(["train", *run, "--noise", "pg,real_darks", *SMALL]) == 0
    return workdir


@pytest.fixture
def workdir(kept, tmp_path):
    """A copy of it that a test may change."""
    return Path(shutil.copytree(kept, tmp_path / "workdir"))


def refused(capsys, workdir, arguments, *words):
    """Whether a call says one line with these words, and leaves everything as it is."""
    before = {p: p.read_bytes() for p in workdir.rglob("*") if p.is_file()}
    capsys.readouterr()
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("bin/denoise: ") and error.count("\n") == 1, error
    assert all(word in error for word in words), error
    assert before == {p: p.read_bytes() for p in workdir.rglob("*") if p.is_file()}


@pytest.mark.parametrize(
    ("flag", "other", "own"),
    [("--steps", "9", "8"), ("--features", "6", "4"), ("--batch", "3", "2"), ("--scenes", "3", "2"),
     ("--full-scale", "40", "100")],
)  # fmt: skip
@pytest.mark.parametrize("noise", ["pg", "gaussian"])
def test_a_workdir_of_other_settings_is_refused(recordings, kept, capsys, flag, other, own, noise):
    run = ["--recordings", str(recordings), "--workdir", str(kept), "--exposure", "10", "--noise", noise]
    words = (f"trained with {flag} {own}, not {other}", f"give {flag} {own}, or another --workdir")
    refused(capsys, kept, ["train", *run, *SMALL, flag, other], *words)


def test_denoisers_of_different_settings_are_not_compared(recordings, workdir, tmp_path, capsys):
    """One of them comes from another workdir."""
    run = ["--recordings", str(recordings), "--workdir", str(tmp_path / "b"), "--exposure", "10"]
    assert main(["train", *run, "--noise", "gaussian", *SMALL, "--steps", "9"]) == 0
    shutil.copy(tmp_path / "b/denoisers/toy_10s/gaussian_0.npz", workdir / "denoisers/toy_10s")
    test = ["test", *run[:2], "--workdir", str(workdir), "--scenes", "2"]
    refused(capsys, workdir, test, "trained with --steps 8, gaussian_0.npz with 9")


@pytest.fixture(scope="module")
def others(recordings, tmp_path_factory):
    """Recordings of another camera that has the same name."""
    folder = tmp_path_factory.mktemp("others")
    for path in recordings.iterdir():
        recording = read_recording(path)
        frames = np.asarray(recording.frames[:])[::-1]
        write_recording(folder / path.name, dataclasses.replace(recording, frames=frames))
    return folder


def test_denoisers_are_of_the_recordings_that_they_were_trained_on(
    recordings, others, workdir, tmp_path, capsys
):
    train = ["train", "--workdir", str(workdir), "--exposure", "10", "--noise", "pg,calibrated", *SMALL]
    test = ["test", "--workdir", str(workdir), "--scenes", "2"]
    refused(capsys, workdir, [*train, "--recordings", str(others)], "other recordings of toy", "--workdir")
    refused(capsys, workdir, [*test, "--recordings", str(others)], "was trained on other recordings")
    (workdir / "recordings_toy.json").unlink()  # what denoisers say holds without it
    refused(capsys, workdir, [*train, "--recordings", str(others)], "was trained on other recordings")
    moved = shutil.copytree(recordings, tmp_path / "moved")  # where they lie is of no matter
    assert main([*test, "--recordings", str(moved)]) == 0
    path = workdir / "denoisers" / "toy_10s" / "pg_0.npz"
    denoiser = load_denoiser(path)
    del denoiser.about["recordings_sha256"]
    save_denoiser(path, denoiser)
    refused(capsys, workdir, [*test, "--recordings", str(moved), "--force"], "states no recordings")


@pytest.mark.parametrize("left", [0, 1000])
def test_a_damaged_denoiser_is_trained_again(recordings, workdir, capsys, left):
    path = workdir / "denoisers" / "toy_10s" / "pg_0.npz"
    sound, kept_ns = path.read_bytes(), path.with_name("real_darks_0.npz").stat().st_mtime_ns
    path.write_bytes(sound[:left])
    run = ["--recordings", str(recordings), "--workdir", str(workdir), "--exposure", "10"]
    assert main(["train", *run, "--noise", "pg,real_darks", *SMALL]) == 0
    said = f"bin/denoise: {path}: not a readable denoiser: trained again"
    assert said in capsys.readouterr().err.splitlines()
    same = jax.tree.map(np.array_equal, load_denoiser(path).variables, _loaded(sound, path).variables)
    assert all(jax.tree.leaves(same))
    assert path.with_name("real_darks_0.npz").stat().st_mtime_ns == kept_ns


def _loaded(content, path):
    other = path.with_name("other.npz")
    other.write_bytes(content)
    return load_denoiser(other)


def test_too_few_frames_are_said_where_flats_and_darks_are_there(recordings, tmp_path, capsys):
    (tmp_path / "in").mkdir()
    for path in recordings.iterdir():
        recording = read_recording(path)
        frames = np.asarray(recording.frames[:2])
        write_recording(tmp_path / "in" / path.name, dataclasses.replace(recording, frames=frames))
    run = ["--recordings", str(tmp_path / "in"), "--workdir", str(tmp_path / "out")]
    assert main(["train", *run, "--exposure", "10"]) == 2
    error = capsys.readouterr().err
    assert "of its flats and darks one frame is for training" in error and error.count("\n") == 1
    assert "three frames or more" in error and not (tmp_path / "out").exists()


@pytest.mark.slow
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
    refused(
        capsys, tmp_path, ["train", *run, *small, *names, "--generator-steps", "3"], "--generator-steps 2"
    )
    own.unlink()
    refused(
        capsys, tmp_path, ["train", *run, *small, *names, "--generator-steps", "3"], "--generator-steps 2"
    )
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


@pytest.mark.parametrize("content", ["{}", "[]", '{"adopted": 1}', '{"adopted": true, "judged_by": null}'])
def test_a_damaged_verdict_on_a_generator_is_refused(tmp_path, content):
    path = tmp_path / "gain.json"
    path.write_text(content)
    with pytest.raises(BadInput, match="remove it and run again"):
        verdict_of(path)
    path.write_text('{"adopted": true, "judged_by": {"generator_steps": 2}}')
    assert verdict_of(path)["adopted"]
