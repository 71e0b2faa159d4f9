import dataclasses

import numpy as np
import pytest

from cannoise_jax.recordings.metadata import checked
from cannoise_jax.recordings.recording import BadInput, Recording, mosaic_map, per_channel


def test_mosaic_map_follows_mosaic_order():
    field = mosaic_map((1, 2, 3, 4), (3, 5))
    assert field.shape == (3, 5)
    for i in range(3):
        for j in range(5):
            assert field[i, j] == 1 + 2 * (i % 2) + j % 2


def test_per_channel_takes_one_or_four():
    assert per_channel(7) == (7.0,) * 4
    assert per_channel((1, 2, 3, 4)) == (1.0, 2.0, 3.0, 4.0)
    with pytest.raises(ValueError, match="1 or 4"):
        per_channel((1, 2))


def test_black_map_has_the_frames_size():
    recording = Recording(np.zeros((2, 4, 6), np.uint16), "RGGB", (10, 20, 30, 40), 1023)
    assert recording.count == 2 and recording.black_map().shape == (4, 6)
    assert recording.black_map()[3, 3] == 40


def test_a_message_keeps_both_ends_of_what_a_file_holds():
    said = str(BadInput(f"in/sensor.json: cfa is {'a' * 5000}, not one of RGGB: correct the entry"))
    assert len(said) < 900
    assert said.startswith("in/sensor.json: cfa is aaa") and said.endswith(
        "not one of RGGB: correct the entry"
    )


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("in/a\x1b[2Jb.npy: broken", "in/a?[2Jb.npy: broken"),
        ("in/a\r\n  b.npy\t: broken\n", "in/a b.npy : broken"),
        ("in/\udcff\u202e.npy: broken", "in/??.npy: broken"),
        ("in/two  spaces é.npy: broken", "in/two  spaces é.npy: broken"),
    ],
)
def test_a_message_is_one_printable_line_whatever_a_name_holds(text, line):
    assert str(BadInput(text)) == line


def test_a_colour_order_in_small_letters_is_checked_as_of_files():
    recording = Recording(np.zeros((2, 4, 6), np.uint16), "rggb", (0.0,) * 4, 255.0)
    assert checked(recording).cfa == "RGGB"
    with pytest.raises(BadInput, match="cfa .*expected text"):
        checked(dataclasses.replace(recording, cfa=np.array([[0, 1], [1, 2]])))
