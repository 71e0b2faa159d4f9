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
_MATTERS, _SURE = 0.02, 8.0
"""Share of the light of a band, and standard errors by how its frames scatter, from which on it is told."""
_FEWEST = 3
"""Frames of a flat that say how light scatters."""


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
    ]
    darks = [s for s in statistics if s.recording.kind in DARK]
    if len(flats) < 2 or not darks:
        return ""
    longest = max(flats, key=_seconds)
    told = [
        found
        for s in flats
        if _SHORTER * _seconds(s) < _seconds(longest) and (found := _unlike(s, longest, darks)) is not None
    ]
    if not told:
        return ""
    more, where, short = max(told, key=lambda t: abs(t[0]))
    name = short.recording.path or "a flat"
    other = longest.recording.path or "flat"
    return (
        f"{name}: its light lies otherwise over the frame than that of the longer {other}, by "
        f"{100 * more:+.2g} % in {where}, though it seems to be of one lamp: light that falls on the pixels "
        "while they are read, a shutter, or a lamp that was moved. It is taken for light, and means over the "
        "exposure are off by as much"
    )


def _seconds(s: FrameStatistics) -> float:
    return float(s.recording.exposure_s or 0.0)


def _unlike(
    short: FrameStatistics, long: FrameStatistics, darks: Sequence[FrameStatistics]
) -> tuple[float, str, FrameStatistics] | None:
    """By how much the light of one band differs most, as a share of it, and which; None where none does, or
    the lamps are two."""
    rates = [_level(s, darks) / _seconds(s) for s in (short, long)]
    if min(rates) <= 0 or abs(rates[0] / rates[1] - 1) > _ONE_LAMP:
        return None
    found = None
    for axis, what in enumerate(("rows", "columns")):
        one, other = _profile(short, darks, axis), _profile(long, darks, axis)
        if min(one.light.min(), other.light.min()) <= 0:
            continue
        more = one.light / other.light - 1
        error = np.hypot(one.error / one.light, other.error / other.light)
        k = int(np.argmax(np.abs(more) - _SURE * error))
        if abs(more[k]) > max(_MATTERS, _SURE * error[k]) and abs(more[k]) > abs(found[0] if found else 0):
            lines = np.array_split(np.arange(short.mean.shape[axis]), _BANDS)[k]
            found = float(more[k]), f"{what} {lines[0] + 1} to {lines[-1] + 1}", short
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
