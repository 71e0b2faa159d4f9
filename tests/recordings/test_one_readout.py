"""A frame whose rows or columns were disturbed at readout is named and left out; honest ones stay."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.recordings.one_readout import disturbed
from cannoise_jax.recordings.recording import CaptureSet, Recording
from cannoise_jax.recordings.usable import usable

SIZE = (64, 48)


def recording(kind, frames, rows, columns=0.0, seed=0):
    """Frames whose rows and columns have offsets of these standard deviations, DN, one for each frame."""
    rng = np.random.default_rng(seed)
    by_row = np.broadcast_to(rows, frames)[:, None, None] * rng.standard_normal((frames, SIZE[0], 1))
    by_column = np.broadcast_to(columns, frames)[:, None, None] * rng.standard_normal((frames, 1, SIZE[1]))
    codes = 500 + 4 * rng.standard_normal((frames, *SIZE)) + by_row + by_column
    codes += 3 * rng.standard_normal(SIZE)
    return Recording(
        np.rint(codes).astype(np.uint16), "MONO", (100.0,) * 4, 16383.0, "c", kind, path=f"{kind}.h5"
    )


def one_of(frames, usual, odd):
    return np.where(np.arange(frames) == 3, odd, usual)


@pytest.mark.parametrize(
    ("kind", "rows", "columns", "odd"),
    [
        ("dark", one_of(8, 0.5, 6.0), 0.0, ("rows", (3,))),
        ("flat", 0.5, one_of(8, 0.0, 6.0), ("columns", (3,))),
        ("bias", one_of(5, 0.5, 6.0), 0.0, ("rows", (3,))),
        ("scene", one_of(8, 0.5, 6.0), 0.0, None),
        ("dark", one_of(4, 0.5, 6.0), 0.0, None),  # too few to say
        ("dark", one_of(8, 0.5, 0.8), 0.0, None),
        ("dark", np.linspace(0.5, 6, 8), 0.0, None),  # it grows from frame to frame
        ("dark", np.tile([0.5, 4.0], 4), 0.0, None),  # every other one
    ],
)
def test_a_disturbed_frame_is_told_from_noise_of_rows_that_changes(kind, rows, columns, odd):
    frames = max(np.size(rows), np.size(columns))
    found = disturbed(recording(kind, frames, rows, columns))
    assert (None if found is None else (found.lines, found.numbers)) == odd


def test_none_of_many_honest_recordings_holds_a_disturbed_frame():
    rng = np.random.default_rng(1)
    for seed in range(150):
        strengths = rng.choice([0.0, 0.5, 5.0], 2)
        assert disturbed(recording("dark", int(rng.integers(5, 17)), *strengths, seed)) is None


def test_it_is_said_in_one_line():
    kept, lines = usable(CaptureSet("c", (recording("dark", 8, one_of(8, 0.5, 6.0)),)))
    assert kept.recordings[0].count == 7
    assert lines[0].startswith("dark.h5: frame 4: rows scatter by ")
    assert lines[0].endswith(" DN: a disturbed readout: left out")
