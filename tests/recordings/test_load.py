"""All formats together: what the dispatcher promises whatever a file holds."""

import warnings

import numpy as np
import pytest

from cannoise_jax.recordings.folders.shots import scan
from cannoise_jax.recordings.load import load_capture_set, load_recording
from cannoise_jax.recordings.recording import BadInput
from tests.recordings.dng import write_dng
from tests.recordings.test_fits import write as write_fits
from tests.recordings.test_native import write as write_native
from tests.recordings.test_stacks import write as write_stack

FRAMES = np.random.default_rng(0).integers(100, 1000, (3, 64, 96)).astype(np.uint16)
WRITERS = {
    "a.dng": lambda path: write_dng(path, FRAMES[0], noise_profile=[1e-3, 1e-6] * 3, nested=True),
    "b.fits": lambda path: write_fits(path, FRAMES, BAYERPAT="RGGB", EXPTIME=1.0),
    "c.h5": lambda path: write_native(path, FRAMES, clean=np.zeros((64, 96), np.float32), iso=100.0),
    "d.npy": lambda path: write_stack(path, FRAMES),
    "e.npz": lambda path: write_stack(path, FRAMES),
    "f.tif": lambda path: write_stack(path, FRAMES),
    "g.tiff": lambda path: write_stack(path, FRAMES),
}
LEVELS = {"cfa": "RGGB", "black_level": 1, "white_level": 65535}


def test_one_folder_may_hold_every_format(tmp_path):
    for name, writer in WRITERS.items():
        writer(tmp_path / name)
    captures = load_capture_set(tmp_path, camera="any", **LEVELS)
    assert [r.path for r in captures.recordings] == [str(tmp_path / name) for name in WRITERS]
    for recording in captures.recordings:
        np.testing.assert_array_equal(recording.frames[:], FRAMES[: recording.count])


@pytest.mark.parametrize("name", WRITERS)
def test_damaged_bytes_raise_nothing_but_bad_input_in_one_line(tmp_path, name):
    path = tmp_path / name
    WRITERS[name](path)
    whole = path.read_bytes()
    rng = np.random.default_rng(1)
    refused = 0
    for n in range(24):
        damaged = bytearray(whole)
        if n % 3 == 0:
            del damaged[rng.integers(len(whole)) :]
        else:
            reach = len(whole) if n % 3 == 1 else min(2000, len(whole))
            for at in rng.integers(reach, size=4):
                damaged[at] = rng.integers(256)
        path.write_bytes(bytes(damaged))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                recording = load_recording(path, **LEVELS)
                assert np.asarray(recording.frames).dtype == np.uint16
        except BadInput as error:
            refused += 1
            assert str(path) in str(error) and "\n" not in str(error)
    assert refused >= 5  # most truncations at the least


@pytest.mark.parametrize("suffix", [".fits", ".tif", ".dng", ".h5", ".npy", ".png"])
def test_a_text_of_another_name_is_refused_with_what_to_do(tmp_path, suffix):
    (path := tmp_path / f"notes{suffix}").write_text("shopping list\nmilk\n")
    with pytest.raises(BadInput, match=r"not a readable .*(: copy it again|, not with SIMPLE)") as error:
        load_recording(path)
    assert "\n" not in str(error.value)


def test_films_are_told_from_folders_that_hold_nothing(tmp_path):
    (tmp_path / "clip.MOV").write_bytes(b"\0\0\0\x14ftypqt  ")
    with pytest.raises(BadInput, match="only 1 .mov: developed pictures and films hold no raw values"):
        scan(tmp_path)


@pytest.mark.parametrize("load", [load_recording, load_capture_set])
def test_what_is_no_name_is_refused(load):
    with pytest.raises(BadInput, match="path is of type int: give the name of a f"):
        load(3)
