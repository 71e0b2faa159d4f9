"""bin/sample: frames of clean images as a camera of the model, or of a recording, would record them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.commands.sample import main
from cannoise_jax.model_file import load_model, save_model
from cannoise_jax.networks import Encoder, Generator
from cannoise_jax.recordings.native import read_recording, write_recording
from cannoise_jax.recordings.recording import Recording
from cannoise_jax.sampling import Camera, Setting, make_model

SHOT, READ, BLACK, WHITE = 1e-3, 1e-5, 64.0, 1023.0


def write_model(folder):
    """A generator that hands on its initial noise: its zero start, with the other layers drawn small."""
    generator = Generator(1 / 64, hidden=4, spectral=False, row_noise=False, physics=False)
    encoder = Encoder(1 / 64, hidden=4)
    image, latent, key = jnp.ones((1, 32, 32, 4)), jnp.ones((1, 8)), jax.random.key(0)
    shapes = jax.eval_shape(lambda: generator.init(key, image, image, latent, image, train=False))
    seen = jax.eval_shape(lambda: encoder.init(key, image, train=False))
    g, e = (jax.tree.map(lambda leaf: jnp.full(leaf.shape, 0.01), tree) for tree in (shapes, seen))
    g["params"]["pixels"]["out"] = jax.tree.map(jnp.zeros_like, g["params"]["pixels"]["out"])
    cameras = {
        "A": Camera(jnp.full((2, 32, 32, 4), 0.1), {"100": Setting(np.full(4, SHOT), np.full(4, READ))})
    }
    save_model(folder / "model.npz", make_model(generator, g, encoder, e, cameras))
    return folder


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return write_model(tmp_path_factory.mktemp("model"))


def run(model, clean, reference, out, *more):
    flags = ["--model", model, "--clean", clean, "--reference", reference, "--out", out, *more]
    return main([str(f) for f in flags])


def write(path, **fields):
    known = {"cfa": "GBRG", "black_level": (BLACK,) * 4, "white_level": WHITE, "camera": "B", "iso": 200.0}
    frames = np.random.default_rng(0).normal(BLACK + 200, 8, (2, 64, 64)).astype(np.uint16)
    write_recording(path, Recording(frames=frames, **(known | fields)))
    return path


LEVELS = ("--black-level", BLACK, "--white-level", WHITE)


def test_a_camera_of_the_model_at_an_iso(model, tmp_path):
    (tmp_path / "in").mkdir()
    image = np.full((64, 66), 0.1, np.float32)  # 33 packed columns
    np.save(tmp_path / "in" / "a.npy", image)
    np.save(tmp_path / "in" / "b.npy", image)
    out = tmp_path / "out"
    assert run(model, tmp_path / "in", "A", out, "--iso", 100, "--frames", 3, *LEVELS) == 0
    assert sorted(p.name for p in out.iterdir()) == ["a_A.h5", "b_A.h5"]
    first, second = (read_recording(out / f"{n}_A.h5") for n in "ab")
    assert first.frames.shape == (3, 64, 66) and first.camera == "A" and first.iso == 100
    np.testing.assert_allclose(first.shot, SHOT)
    frames = np.asarray(first.frames).astype(float)
    noise = (frames - BLACK) / (WHITE - BLACK) - 0.1
    variance = SHOT * 0.1 + READ + 1 / 12 / (WHITE - BLACK) ** 2
    assert abs(noise.var() / variance - 1) < 5 * (2 / noise.size) ** 0.5
    assert abs(np.corrcoef(noise[0].ravel(), noise[1].ravel())[0, 1]) < 0.08
    assert not np.array_equal(frames, np.asarray(second.frames))


def test_a_recording_as_reference_sets_camera_levels_and_noise(model, tmp_path):
    reference = write(tmp_path / "ref.h5")
    clean = write(tmp_path / "scene.h5", camera="C", black_level=(10.0,) * 4, white_level=400.0)
    assert run(model, clean, reference, tmp_path / "out") == 0
    made = read_recording(tmp_path / "out" / "scene_B.h5")
    assert (made.camera, made.cfa, made.iso, made.white_level) == ("B", "GBRG", 200, WHITE)
    noise = np.asarray(made.frames)[0] - (BLACK + np.asarray(made.clean) * (WHITE - BLACK))
    assert abs(np.std(noise) / 8 - 1) < 0.15  # the reference's noise, estimated from its pixels
    # Levels for the clean image leave the reference's, and so its noise and what is written, alone.
    assert run(model, clean, reference, tmp_path / "again", "--white-level", 300, "--black-level", 5) == 0
    again = read_recording(tmp_path / "again" / "scene_B.h5")
    assert (again.black_level, again.white_level, again.shot) == (made.black_level, WHITE, made.shot)
    np.testing.assert_allclose(again.clean, np.asarray(made.clean) * 390 / 295 + 5 / 295, atol=1e-6)


def test_a_reference_that_states_no_levels_has_flags_of_its_own(model, tmp_path, capsys):
    np.save(tmp_path / "ref.npy", np.random.default_rng(0).integers(100, 140, (64, 64)).astype(np.uint16))
    clean = good(tmp_path)
    assert run(model, clean, tmp_path / "ref.npy", tmp_path / "out", *LEVELS) == 2
    assert "ref.npy: does not state cfa: set it with --reference-cfa" in capsys.readouterr().err
    flags = ("--cfa", "RGGB", *LEVELS, "--reference-black-level", 50, "--reference-white-level", 999)
    assert run(model, clean, tmp_path / "ref.npy", tmp_path / "out", *flags) == 0
    assert read_recording(next((tmp_path / "out").glob("*.h5"))).white_level == 999


def test_a_model_that_was_told_levels_asks_for_them_and_one_that_was_not_reads_them_off(
    model, tmp_path, capsys
):
    reference, clean = write(tmp_path / "ref.h5"), write(tmp_path / "scene.h5", camera="C")
    for level, camera, message in (("given", reference, "shot and read"), ("estimated", "A", "a recording")):
        save_model(tmp_path / "model.npz", load_model(model).replace(level=level))
        assert run(tmp_path / "model.npz", clean, camera, tmp_path / "out", *(
            () if camera is reference else ("--iso", 100)
        )) == 2  # fmt: skip
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1
    assert run(tmp_path / "model.npz", clean, reference, tmp_path / "out") == 0


def test_a_reference_on_coarse_codes_gives_its_codes(model, tmp_path):
    reference = write(tmp_path / "ref.h5", code_step=4.0)
    clean = write(tmp_path / "scene.h5", camera="C")
    assert run(model, clean, reference, tmp_path / "out") == 0
    made = read_recording(tmp_path / "out" / "scene_B.h5")
    assert made.code_step == 4 and not np.any(np.asarray(made.frames) % 4)


def test_a_dark_reference_without_stated_noise_is_refused(model, tmp_path, capsys):
    reference = write(tmp_path / "ref.h5", kind="dark")
    assert run(model, write(tmp_path / "scene.h5", camera="C"), reference, tmp_path / "out") == 2
    assert "no shot noise" in capsys.readouterr().err and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "size",
    [(2, 2), pytest.param((10, 14), marks=pytest.mark.slow), pytest.param((22, 64), marks=pytest.mark.slow)],
)
def test_a_reference_may_be_of_any_size(model, tmp_path, size):
    frames = np.random.default_rng(0).normal(BLACK + 200, 8, (2, *size)).astype(np.uint16)
    np.save(tmp_path / "ref.npy", frames)
    clean = good(tmp_path)
    flags = ("--cfa", "GBRG", *LEVELS)
    assert run(model, clean, tmp_path / "ref.npy", tmp_path / "out", *flags) == 0
    made = read_recording(tmp_path / "out" / f"good_{tmp_path.name}.h5")
    assert np.asarray(made.frames).std() > 0 or size == (2, 2)


def test_the_seed_decides(model, tmp_path):
    clean = write(tmp_path / "scene.h5")
    for out, seed in (("one", 0), ("two", 0), ("three", 1)):
        assert run(model, clean, "A", tmp_path / out, "--iso", 100, "--seed", seed) == 0
    one, two, three = (
        np.asarray(read_recording(tmp_path / out / "scene_A.h5").frames) for out in ("one", "two", "three")
    )
    assert np.array_equal(one, two) and not np.array_equal(one, three)


def test_flags_hold_for_the_reference_file_too(model, tmp_path):
    frames = np.random.default_rng(0).normal(BLACK + 200, 8, (2, 64, 64)).astype(np.uint16)
    np.save(tmp_path / "ref.npy", frames)
    np.save(tmp_path / "clean.npy", np.full((64, 64), 0.2, np.float32))
    flags = ("--cfa", "GBRG", *LEVELS)
    assert run(model, tmp_path / "clean.npy", tmp_path / "ref.npy", tmp_path / "out", *flags) == 0
    made = read_recording(tmp_path / "out" / f"clean_{tmp_path.name}.h5")
    assert (made.cfa, made.black_level, made.white_level) == ("GBRG", (BLACK,) * 4, WHITE)
    assert abs(np.std(np.asarray(made.frames)) / 8 - 1) < 0.15


def test_an_array_has_the_colour_order_of_the_reference(model, tmp_path):
    np.save(tmp_path / "clean.npy", np.full((64, 64), 0.2, np.float32))
    assert run(model, tmp_path / "clean.npy", write(tmp_path / "ref.h5"), tmp_path / "out") == 0
    assert read_recording(tmp_path / "out" / "clean_B.h5").cfa == "GBRG"


def test_levels_that_change_nothing_are_said_and_others_are_not(model, tmp_path, capsys):
    array, bare = good(tmp_path), tmp_path / "bare.npy"
    np.save(bare, np.random.default_rng(0).normal(BLACK + 200, 8, (2, 64, 64)).astype(np.uint16))
    stated, recorded = write(tmp_path / "ref.h5"), write(tmp_path / "scene.h5")
    assert run(model, array, stated, tmp_path / "a", "--white-level", 300) == 0
    said = capsys.readouterr().err
    assert said.startswith("bin/sample: --white-level: not used: the clean images are normalised, and ")
    assert said.count("\n") == 1 and said.endswith("--reference-white-level replaces them\n")
    assert read_recording(tmp_path / "a" / "good_B.h5").white_level == WHITE
    assert run(model, array, bare, tmp_path / "b", "--cfa", "GBRG", *LEVELS) == 0
    assert run(model, recorded, stated, tmp_path / "c", "--white-level", 300) == 0
    assert run(model, array, "A", tmp_path / "d", "--iso", 100, *LEVELS) == 0
    assert "not used" not in capsys.readouterr().err


def test_a_folder_of_arrays_and_recordings_gives_one_file_each(model, tmp_path):
    (tmp_path / "in").mkdir()
    np.save(tmp_path / "in" / "a.npy", np.full((64, 64), 0.1, np.float32))
    for name in ("b", "c"):
        write(tmp_path / "in" / f"{name}.h5", camera=name)
    (tmp_path / "in" / "notes.txt").write_text("of no use")
    assert run(model, tmp_path / "in", "A", tmp_path / "out", "--iso", 100, *LEVELS) == 0
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["a_A.h5", "b_A.h5", "c_A.h5"]


def codes(folder):
    np.save(folder / "codes.npy", np.full((64, 64), 500, np.float32))
    return folder / "codes.npy"


def nan(folder):
    image = np.zeros((64, 64), np.float32)
    image[3, 4] = np.nan
    np.save(folder / "nan.npy", image)
    return folder / "nan.npy"


def odd(folder):
    np.save(folder / "odd.npy", np.zeros((63, 64), np.float32))
    return folder / "odd.npy"


def packed(folder):
    np.save(folder / "packed.npy", np.zeros((32, 32, 4), np.float32))
    return folder / "packed.npy"


def good(folder):
    np.save(folder / "good.npy", np.zeros((64, 64), np.float32))
    return folder / "good.npy"


@pytest.mark.parametrize(
    ("clean", "more", "message"),
    [
        (nan, ("--iso", 100, *LEVELS), "NaN"),
        (codes, ("--iso", 100, *LEVELS), "values from 500 to 500"),
        (odd, ("--iso", 100, *LEVELS), "even sizes"),
        (packed, ("--iso", 100, *LEVELS), "expected one clean mosaic"),
        (good, ("--iso", 100), "levels unknown"),
        (good, LEVELS, "known at ISO 100"),
        (good, ("--iso", 3200, *LEVELS), "known at ISO 100"),
        (good, ("--iso", 100, "--black-level", 9, "--white-level", 9), "expected black < white"),
        (good, ("--iso", 100, *LEVELS, "--reference", "Z"), "neither a file nor a camera"),
        (good, ("--iso", 100, *LEVELS, "--model", "nowhere"), "no such file"),
        (lambda folder: folder / "absent", ("--iso", 100, *LEVELS), "no such file"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(model, tmp_path, capsys, clean, more, message):
    out = tmp_path / "out"
    assert run(model, clean(tmp_path), "A", out, *more) == 2
    error = capsys.readouterr().err
    assert error.startswith("bin/sample: ") and message in error and error.count("\n") == 1
    assert not out.exists()


def test_nothing_is_written_over(model, tmp_path, capsys):
    clean = good(tmp_path)
    kept = tmp_path / "out" / "good_A.h5"
    kept.parent.mkdir()
    kept.write_bytes(b"kept")
    assert run(model, clean, "A", kept.parent, "--iso", 100, *LEVELS) == 2
    assert "--force" in capsys.readouterr().err and kept.read_bytes() == b"kept"
