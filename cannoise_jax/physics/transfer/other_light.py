"""Flats of another light than that of their lamp: the same lamp lights all parts of the frame alike, however
long it shines.

Light that reaches the pixels while they are read, a shutter that opens from one side, or charge that is
still moved under the light add an image that does not grow with the exposure. It is smooth, as light is, and
would be taken for light; beside a longer flat of the same lamp it is none.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import stats

from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.recordings.recording import DARK

_SHORTER = 1.5
"""Times a shorter exposure, from which on flats are compared."""
_ONE_LAMP = 0.25
"""Share by which the light per second of flats may differ that are of one lamp."""
_BANDS = 16
"""Bands of rows, and of columns, that are compared."""
_CLIPPED = 0.01
"""Share of the pixels of a flat at a rail from which on it tells no light."""
_MATTERS, _CHANCE = 0.02, 1e-6
"""Share of the light of a band by which it differs at least, and chance of any of them that differs so."""
_FEWEST = 5
"""Frames of a flat that say how light scatters."""
_STRAIGHT = 0.5
"""Share of the white level up to which a response hardly bends: of brighter flats the middle is brighter."""


class _Profile(NamedTuple):
    """Light of the bands of one flat over that of the whole frame, and its standard error by the frames."""

    light: Float[np.ndarray, "k"]
    error: Float[np.ndarray, "k"]


def other_light_line(statistics: Sequence[FrameStatistics]) -> str:
    """That a flat has another distribution of light than a longer one of the same lamp; empty where none
    has."""
    flats = [
        s
        for s in statistics
        if s.recording.kind == "flat"
        and s.recording.exposure_s
        and s.recording.count >= _FEWEST
        and s.clipped.mean() < _CLIPPED
        and float(np.max(s.level)) < _STRAIGHT * s.recording.white_level
    ]
    darks = [s for s in statistics if s.recording.kind in DARK]
    told = []
    for short in flats:
        own = [d for d in darks if d.mean.shape == short.mean.shape]
        longer = [s for s in flats if own and s.mean.shape == short.mean.shape and _one_lamp(short, s, own)]
        if longer and (found := _unlike(short, long := max(longer, key=_seconds), own)) is not None:
            told.append((*found, short, long))
    if not told:
        return ""
    more, where, short, long = max(told, key=lambda t: abs(t[0]))
    return (
        f"{short.recording.path or 'a flat'}: its light is distributed differently over the frame than that "
        f"of the longer {long.recording.path or 'flat'}, by {100 * more:+.2g} % in {where}, though both seem "
        "to be of one lamp: light that falls on the pixels while they are read, a shutter, or a lamp that "
        "was moved. It is taken for light, and means over the exposure are off by as much"
    )


def _seconds(s: FrameStatistics) -> float:
    return float(s.recording.exposure_s or 0.0)


def _one_lamp(short: FrameStatistics, long: FrameStatistics, darks: Sequence[FrameStatistics]) -> bool:
    """Whether the second is longer, of as much light a second."""
    if _SHORTER * _seconds(short) >= _seconds(long):
        return False
    rates = [_level(s, darks) / _seconds(s) for s in (short, long)]
    return min(rates) > 0 and abs(rates[0] / rates[1] - 1) <= _ONE_LAMP


def _unlike(
    short: FrameStatistics, long: FrameStatistics, darks: Sequence[FrameStatistics]
) -> tuple[float, str] | None:
    """By how much the light of one band differs most, as a share of it, and which; None where none does."""
    found: tuple[float, str] | None = None
    sure = float(stats.t.isf(_CHANCE / (4 * _BANDS), min(short.recording.count, long.recording.count) - 1))
    for axis, what in enumerate(("rows", "columns")):
        if short.mean.shape[axis] < _BANDS:
            continue
        one, other = _profile(short, darks, axis), _profile(long, darks, axis)
        if min(one.light.min(), other.light.min()) <= 0:
            continue
        more = one.light / other.light - 1
        error = np.hypot(one.error / one.light, other.error / other.light)
        k = int(np.argmax(np.abs(more) - sure * error))
        if abs(more[k]) > max(_MATTERS, sure * error[k]) and abs(more[k]) > abs(found[0] if found else 0):
            lines = np.array_split(np.arange(short.mean.shape[axis]), _BANDS)[k]
            found = float(more[k]), f"{what} {lines[0] + 1} to {lines[-1] + 1}"
    return found


def _dark_of(s: FrameStatistics, darks: Sequence[FrameStatistics]) -> FrameStatistics:
    """The dark of the exposure nearest to that of a flat."""
    return min(darks, key=lambda d: abs(np.log(max(_seconds(d), 1e-6) / _seconds(s))))


def _level(s: FrameStatistics, darks: Sequence[FrameStatistics]) -> float:
    return float(np.mean(s.frame_means) - np.mean(_dark_of(s, darks).frame_means))


def _profile(s: FrameStatistics, darks: Sequence[FrameStatistics], axis: int) -> _Profile:
    dark = _dark_of(s, darks)
    lit, unlit = (t.row_means.mean(2) if axis == 0 else t.column_means.mean(1) for t in (s, dark))
    light = lit - unlit.mean(0)
    bands = np.stack([b.mean(1) for b in np.array_split(light, _BANDS, 1)], 1)
    each = bands / np.maximum(np.abs(bands.mean(1, keepdims=True)), 1e-9)
    return _Profile(each.mean(0), each.std(0, ddof=1) / np.sqrt(len(each)))
