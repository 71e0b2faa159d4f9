"""Arrays with a description: as they were written, or refused."""

import json

import numpy as np
import pytest

from cannoise_jax.recordings.described import read_described, write_described
from cannoise_jax.recordings.recording import BadInput

ABOUT = {"format": "x/1", "rates": (0.1, 1e-9), "name": "ä", "none": None}
ARRAYS = {"a/b": np.arange(6, dtype=np.float32).reshape(2, 3), "n": np.int32(3)}


def changed(path, **arrays):
    """The file written anew by NumPy, with other arrays; None takes one away."""
    with np.load(path) as file:
        kept = {name: file[name] for name in file.files} | arrays
    np.savez(path, **{name: value for name, value in kept.items() if value is not None})


def test_what_is_written_comes_back(tmp_path):
    write_described(tmp_path / "f.npz", ABOUT, ARRAYS)
    found = read_described(tmp_path / "f.npz")
    assert found.sealed and found.description == json.loads(json.dumps(ABOUT))
    assert set(found.arrays) == set(ARRAYS)
    for name, value in ARRAYS.items():
        np.testing.assert_array_equal(found.arrays[name], value)


@pytest.mark.parametrize(
    "change",
    [
        {"n": np.int32(4)}, {"n": np.int64(3)}, {"a/b": ARRAYS["a/b"].T}, {"a/b": None}, {"c": np.zeros(1)},
        {"a/b": ARRAYS["a/b"] * np.nan},
    ],
)  # fmt: skip
def test_what_was_written_anew_is_refused(tmp_path, change):
    write_described(tmp_path / "f.npz", ABOUT, ARRAYS)
    changed(tmp_path / "f.npz", **change)
    with pytest.raises(ValueError):
        read_described(tmp_path / "f.npz")


def test_another_description_is_refused_and_one_without_a_seal_said(tmp_path):
    write_described(tmp_path / "f.npz", ABOUT, ARRAYS)
    with np.load(tmp_path / "f.npz") as file:
        text = str(file["description"])
    changed(tmp_path / "f.npz", description=np.array(text.replace("x/1", "x/2")))
    with pytest.raises(ValueError):
        read_described(tmp_path / "f.npz")
    changed(tmp_path / "f.npz", description=np.array(json.dumps(ABOUT)))
    assert not read_described(tmp_path / "f.npz").sealed
    changed(tmp_path / "f.npz", n=np.array(np.inf))
    with pytest.raises(ValueError):
        read_described(tmp_path / "f.npz")


def test_a_place_that_takes_no_file_is_named_in_one_line(tmp_path):
    with pytest.raises(BadInput, match="cannot be written"):
        write_described(tmp_path / "none" / "f.npz", ABOUT, ARRAYS)
