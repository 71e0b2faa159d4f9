"""Frames without noise are left out, and what is left is what was there."""

import dataclasses

import numpy as np
import pytest

from cannoise_jax.recordings.recording import BadInput, CaptureSet, Recording
from cannoise_jax.recordings.usable import fault_of, usable

RNG = np.random.default_rng(0)


def recording(frames, **more):
    return Recording(np.asarray(frames, np.uint16), "MONO", (64,) * 4, 1023.0, kind="flat", **more)


def noisy(count=5):
    return RNG.integers(100, 900, (count, 12, 14)).astype(np.uint16)


def test_sound_frames_are_left_as_they_are():
    capture = CaptureSet("c", (recording(noisy()), recording(noisy(1))))
    kept, lines = usable(capture)
    assert kept.recordings == capture.recordings and lines == ()


@pytest.mark.parametrize("index", [slice(None), 1, slice(1, 3), (slice(0, 2), slice(2, 7)), [2, 0]])
def test_the_others_keep_their_order_and_their_own_reference(index):
    frames = noisy(6)
    frames[2], frames[4] = frames[1], 1023
    clean = np.arange(6, dtype=np.float32)[:, None, None] * np.ones((12, 14), np.float32)
    kept, lines = usable(CaptureSet("c", (dataclasses.replace(recording(frames), clean=clean),)))
    good = [0, 1, 3, 5]
    np.testing.assert_array_equal(kept.recordings[0].frames[index], frames[good][index])
    np.testing.assert_array_equal(kept.recordings[0].clean[index], clean[good][index])
    assert kept.recordings[0].count == 4 and len(lines) == 2


@pytest.mark.parametrize(
    "change, said",
    [
        ({"frames": noisy().astype(float)}, "frames are float64: expected"),
        ({"frames": noisy().astype(np.int16)}, "frames are int16: expected"),
        ({"frames": noisy()[0]}, "expected .frames, rows, columns."),
        ({"kind": "Dark"}, "unknown kind 'Dark': use one of scene, flat, dark, bias"),
        ({"cfa": "rgbg"}, "unknown CFA"),
        ({"black_level": (64.0,) * 3}, "black_level .*expected 1 or 4 numbers"),
        ({"clean": np.zeros((6, 14), np.float32)}, "clean has shape"),
        ({"exposure_s": -1.0}, "exposure_s is -1: expected at least 0"),
        ({"exposure_s": float("nan")}, "exposure_s is not finite"),
        ({"white_level": 64.0}, "is not below white level"),
        ({"exposure_s": "1"}, "exposure_s is '1', a text: give a number"),
        ({"black_level": ("64",) * 4}, "black_level is .* a text"),
    ],
)
def test_recordings_that_no_file_may_hold_are_refused_where_they_are_used(change, said):
    made = dataclasses.replace(recording(noisy()), path="mine", **change)
    with pytest.raises(BadInput, match=f"^mine: .*{said}") as caught:
        usable(CaptureSet("c", (made,)))
    assert "\n" not in str(caught.value)


def test_recordings_without_a_file_have_names_in_messages():
    dim, bright = noisy(), noisy() + np.uint16(500)
    own = (dataclasses.replace(recording(bright), kind="dark"), recording(dim))
    said = r"recording 2 \(flat\): the brightest flat, .* is darker than recording 1 \(dark\)"
    with pytest.raises(BadInput, match=said):
        usable(CaptureSet("c", own))


def test_a_set_without_recordings_is_refused():
    with pytest.raises(BadInput, match="^c: holds no recordings"):
        usable(CaptureSet("c", ()))


def test_a_copy_in_another_recording_is_one_too():
    frames = noisy()
    both = recording(frames, path="a.h5"), recording(frames[[3, 1]], path="b.h5")
    kept, lines = usable(CaptureSet("c", both))
    assert [r.path for r in kept.recordings] == ["a.h5"]
    assert "b.h5: frames 1 to 2: copies of earlier frames of a.h5" in lines[0]


def test_codes_shifted_to_16_bits_end_lower():
    assert "(saturated)" in str(fault_of(np.full((9, 9), 65520, np.uint16)))


def test_too_few_that_are_left_are_refused_but_single_frames_are_not():
    lone = recording(noisy(1))
    assert usable(CaptureSet("c", (lone,)))[0].recordings == (lone,)
    copies = recording(noisy()[[0, 0]])
    for recordings in ((copies,), (copies, lone)):
        with pytest.raises(BadInput, match="copy of frame 1") as refused:
            usable(CaptureSet("c", recordings))
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"frames": noisy()[0]}, "frames have shape"),
        ({"frames": noisy().astype(float)}, "frames are float64"),
        ({"cfa": "ABCD"}, "unknown CFA 'ABCD'"),
        ({"kind": "drak"}, "unknown kind 'drak'"),
        ({"shot": (-1.0,) * 4, "read": (1e-4,) * 4}, "shot is -1"),
        ({"white_level": 1e30}, "far beyond codes of 16 bits"),
        ({"temperature_c": -400.0}, "temperature_c is -400"),
        ({"clean": np.zeros((2, 2), np.float32)}, "clean has shape"),
    ],
)
def test_recordings_of_ones_own_are_held_to_the_rules_for_files(fields, message):
    wrong = dataclasses.replace(recording(noisy()), **fields)
    with pytest.raises(BadInput, match=message):
        usable(CaptureSet("a", (wrong,)))


def test_one_black_level_is_that_of_all_sites():
    one = dataclasses.replace(recording(noisy()), black_level=64.0)
    assert usable(CaptureSet("a", (one,)))[0].recordings[0].black_level == (64.0,) * 4


def test_the_code_at_which_frames_are_full_is_kept_with_the_others():
    dim, full = recording(noisy(), iso=100.0), recording(np.full((2, 12, 14), 1023), iso=100.0)
    kept, lines = usable(CaptureSet("c", (dim, full, recording(noisy(), iso=200.0))))
    assert [r.full_code for r in kept.recordings] == [1023.0, None] and len(lines) == 1
    lost = dataclasses.replace(full, frames=np.full((2, 12, 14), 0, np.uint16))
    kept, _ = usable(CaptureSet("c", (recording(noisy(), iso=100.0), lost)))
    assert [r.full_code for r in kept.recordings] == [None]
