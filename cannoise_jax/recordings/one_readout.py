"""Whether the frames of one recording were read out alike: a frame whose rows or columns jump far more than
those of all others was disturbed, and is no repeat of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.robust import robust_std
from cannoise_jax.recordings.recording import Recording

_FEWEST, _MOST_APART = 5, 0.1
"""Frames from which one can be told to be disturbed, and the share up to which more than one are."""
_FAR, _ALIKE = 2.5, 1.5
"""Times the usual scatter of its rows that a disturbed frame has, and that all others stay below. Of the
recordings of six cameras none had a frame of more than 1.8 times."""
_SIDE = 32
"""Rows or columns from which their scatter is known."""


class Disturbed(NamedTuple):
    """Frames, from 0, whose lines scatter far more than those of the others: which lines, by how much at
    most, and how much the others do, DN."""

    numbers: tuple[int, ...]
    lines: str
    most: float
    usual: float


def disturbed(recording: Recording) -> Disturbed | None:
    """The few frames of flats or darks whose rows, or columns, scatter far more than those of the others,
    which agree; None where there are none, for scenes and for small or few frames."""
    if recording.count < _FEWEST or recording.kind == "scene" or min(recording.size) < _SIDE:
        return None
    for lines, profiles in zip(("rows", "columns"), _profiles(recording), strict=True):
        changes = profiles - np.median(profiles, 0)
        # Of next but one, which are of one colour: light that drifts is smooth, and cancels.
        scatter = np.array([robust_std(line[2:] - line[:-2]) for line in changes]) / np.sqrt(2)
        usual = float(np.median(scatter))
        odd = np.flatnonzero(scatter > _FAR * usual)
        others = np.delete(scatter, odd)
        few = len(odd) <= max(_MOST_APART * recording.count, 1)
        if len(odd) and few and usual > 0 and others.max() < _ALIKE * usual:
            return Disturbed(tuple(odd.tolist()), lines, float(scatter.max()), usual)
    return None


def told_readout(found: Disturbed, count: int) -> str:
    """How the lines of the frames scatter beside those of the others."""
    return (
        f"{found.lines} scatter by {found.most:.2g} DN from frame to frame, those of the other "
        f"{count - len(found.numbers)} frames by {found.usual:.2g} DN: a disturbed readout"
    )


def _profiles(recording: Recording) -> tuple[Float[np.ndarray, "t h"], Float[np.ndarray, "t w"]]:
    """Means of the rows and of the columns of every frame, DN."""
    rows, columns = [], []
    for number in range(recording.count):
        frame = np.asarray(recording.frames[number : number + 1])[0]
        rows.append(frame.mean(1, dtype=np.float64))
        columns.append(frame.mean(0, dtype=np.float64))
    return np.array(rows), np.array(columns)
