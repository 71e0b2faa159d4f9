"""Whether the frames of one recording show one picture: a shadow over one flat, or a part of one dark that
was not read, is no noise of theirs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.robust import robust_std
from cannoise_jax.recordings.metadata import chunks
from cannoise_jax.recordings.recording import DARK, Recording

_CELLS = 8
"""Parts along a side whose levels are compared."""
_LIGHT = 0.05
"""Share by which the light on a part of a flat may differ from that of the other frames, beside its level and
its lean: a lamp, or the sky, changes smoothly."""
_OFFSET = 8.0
"""Standard deviations of the noise of a pixel by which a part of a dark may: offsets of amplifiers drift."""
_SIGMAS = 8.0
"""Standard errors of the level of a part beyond both."""
_HALF = 0.5
"""Of the largest difference, from which a part is named."""
_FEWEST, _MOST_APART = 3, 0.25
"""Frames from which one can be told to be odd, and the share up to which the others are surely the rule."""


class Odd(NamedTuple):
    """A frame, from 0, of which a part is another than in the other frames. most: how far it lies from those
    there: a share of the light of a flat, DN of a dark. rows, columns: the parts, from where to where."""

    number: int
    most: float
    rows: tuple[int, int]
    columns: tuple[int, int]


def odd_pictures(recording: Recording) -> list[Odd]:
    """The few frames of flats or darks that differ from the others in some of their parts; none of scenes,
    which may move, nor where no picture is the rule."""
    if recording.count < _FEWEST or recording.kind == "scene" or min(recording.size) < 2 * _CELLS:
        return []
    dark = recording.kind in DARK
    levels, noise, size = _levels(recording)
    black = float(np.mean(recording.black_level))
    if dark:
        shown = levels - np.median(levels, axis=0)
        apart = levels - np.median(levels, axis=(1, 2), keepdims=True)
        room = noise * max(_OFFSET, _SIGMAS / np.sqrt(size))
    else:
        signal = levels - black
        if np.min(np.median(signal, axis=0)) <= 0:
            return []
        shown = signal / np.median(signal, axis=0)
        shown = shown / np.median(shown, axis=(1, 2), keepdims=True)
        apart = np.array([_without_lean(a) for a in shown])
        room = max(_LIGHT, _SIGMAS * noise / np.sqrt(size) / float(np.median(signal)))
    apart = apart - np.median(apart, axis=0)
    far = np.abs(apart) > room
    odd = np.flatnonzero(far.any((1, 2)))
    if not len(odd) or len(odd) > _MOST_APART * recording.count:
        return []
    out = []
    for number in odd:
        # As it is seen: the lean of the whole frame holds part of a shadow.
        here = shown[number] - (0.0 if dark else float(np.median(shown[number])))
        most = float(here.ravel()[int(np.argmax(np.abs(here)))])
        spans = []
        for axis, length in enumerate(recording.size):
            which = np.flatnonzero((here / most > _HALF).any(1 - axis))
            edges = np.linspace(0, length, _CELLS + 1).astype(int)
            spans.append((int(edges[which[0]]) + 1, int(edges[which[-1] + 1])))
        out.append(Odd(int(number), most, spans[0], spans[1]))
    return out


def told(recording: Recording, odd: Odd) -> str:
    """What of the frame is another."""
    part = f"its rows {odd.rows[0]} to {odd.rows[1]}, columns {odd.columns[0]} to {odd.columns[1]}"
    if (odd.rows, odd.columns) == tuple((1, n) for n in recording.size):
        part = "all parts of it"
    if recording.kind in DARK:
        return f"{part} lie {odd.most:+.0f} DN from the other frames: read in part, or interfered with"
    share = f"{100 * max(odd.most, -1.0):+.0f} %"
    return f"{part} have {share} of light against the other frames: a shadow, or a reflection"


def _levels(recording: Recording) -> tuple[Float[np.ndarray, "T y x"], float, int]:
    """Mean level of every part of every frame, DN, the noise of a pixel, and how many tell a level."""
    rows, columns = (np.array_split(np.arange(n), _CELLS) for n in recording.size)
    out: list[np.ndarray] = []
    noises, previous = [], None
    for part in chunks(recording.frames):
        for frame in part:
            values = frame.astype(np.float64)
            out.append(
                np.array([[values[r[0] : r[-1] + 1, c[0] : c[-1] + 1].mean() for c in columns] for r in rows])
            )
            if previous is not None:
                noises.append(robust_std(values - previous) / np.sqrt(2))
            previous = values
    return np.array(out), max(float(np.median(noises)), 0.5), len(rows[0]) * len(columns[0])


def _without_lean(ratio: Float[np.ndarray, "y x"]) -> Float[np.ndarray, "y x"]:
    """Light over that of the other frames, less its level and its lean; medians, that a shadow does not
    lean."""
    rest = ratio / float(np.median(ratio)) - 1
    for axis in (0, 1):
        middle = np.median(rest, axis=1 - axis)
        place = np.arange(len(middle))
        away = np.subtract.outer(place, place)
        slope = float(np.median(np.subtract.outer(middle, middle)[away != 0] / away[away != 0]))
        line = slope * (place - (len(middle) - 1) / 2)
        rest = rest - (line[:, None] if axis == 0 else line[None])
    return rest - float(np.median(rest))
