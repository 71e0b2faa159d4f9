"""Whether frames were smoothed before they were stored: their noise is then no longer that of single pixels.

Read noise is the pixel's own, or is shared along rows, along columns or by a wave. None of these is shared by
neighbours across and down alike and no longer some pixels away: a filter, a scaling or the filling in of
colours leaves such a noise. What tells noise of rows, of columns, pink noise, waves and loud values takes the
rest for white, so that of smoothed frames none of it may enter a camera model.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.transfer.clamped import clamped
from cannoise_jax.physics.transfer.estimators.neighbours import filtered, lag_covariances
from cannoise_jax.physics.transfer.estimators.pick import brightest_flat, darkest
from cannoise_jax.physics.transfer.frames import FrameStatistics

_DARK = 0.15
"""Correlation with the neighbours, less that some pixels away, from which darks are smoothed: crosstalk of a
quarter of the charge leaves as much where dark charge makes all of the noise."""
_FLAT = 0.45
"""The same of flats: crosstalk, which they show, can leave 0.48, with 60 % of the charge given away."""
_APART, _MOVING, _SIGMAS = 4, 0.1, 5.0
"""Pixels that no charge reaches across, and the correlation over them from which the light of flats moves: of
so much of the noise the gain is too large. Standard errors by which it has to be more."""
_AWAY = (7, 8)
"""Pixels from which on filters reach no further."""
_ONE_WAY = 0.5
"""Of the correlation along one axis, that along the other up to which frames are smoothed one way."""


def smoothed(statistics: Sequence[FrameStatistics]) -> str:
    """That the noise of neighbours in darks is alike as no sensor makes it, or that in flats along one axis,
    or that no pixel of these is above all about it, and what to record; empty where it is not."""
    flat, dark = brightest_flat(statistics), darkest(statistics)
    of_dark = _shared(dark)
    alike = _alike(dark, of_dark, _DARK) or _one_way(flat, of_dark)
    how = f"{alike}, as after smoothing, scaling or filling in of colours" if alike else clamped(flat)
    return how and (
        f"the frames are processed, not raw: {how}; gain and noise are those of the codes that were made of "
        "them: record raw frames"
    )


def flats_alike(statistics: Sequence[FrameStatistics]) -> str:
    """The same of flats, whose light may move as well: then pixels further apart are alike too. Empty where
    no flat tells."""
    flat = brightest_flat(statistics)
    return _said(_alike(flat, _shared(flat), _FLAT)) or flats_moving(statistics) or _filtered(flat)


def _filtered(flat: FrameStatistics | None) -> str:
    """That pixels of one colour share as much of their noise along the diagonals as beside each other."""
    if flat is None or min(flat.recording.size) < 2 * _AWAY[-1]:
        return ""
    if not filtered(flat, 1 if flat.recording.cfa == "MONO" else 2):
        return ""
    return (
        "the noise of neighbours in the flats is as much alike along the diagonals as beside them: frames "
        "were filtered (a median, or loud pixels clamped to those about them): the gain is not to be "
        "trusted, record raw frames"
    )


def flats_moving(statistics: Sequence[FrameStatistics]) -> str:
    """Which the light moves under, by pixels further apart; empty for none."""
    return _said(next(filter(None, map(moving, statistics)), ""))


def _said(alike: str) -> str:
    return alike and (
        f"{alike}, as where the light moves between them or frames are smoothed: the gain is not to be "
        "trusted, record raw frames of a steady light"
    )


def moving(s: FrameStatistics) -> str:
    """That the noise of a flat is alike in pixels further apart than charge of one reaches, both across and
    down; what rows or columns have together is alike in one direction only. Empty where it is not."""
    if s.recording.kind != "flat" or s.variance is None or min(s.recording.size) < 2 * _AWAY[-1]:
        return ""
    found = lag_covariances(s, ((0, 0), (0, _APART), (_APART, 0)))
    power = max(found[0, 0][0], 1e-12)
    across, down = ((found[lag][0] - _SIGMAS * found[lag][1]) / power for lag in ((0, _APART), (_APART, 0)))
    if min(across, down) < _MOVING:
        return ""
    across, down = (found[lag][0] / power for lag in ((0, _APART), (_APART, 0)))
    return (
        f"the noise of pixels {_APART} apart in the flats is alike by {across:.2f} across and {down:.2f} down"
    )


def _alike(s: FrameStatistics | None, shared: Float[np.ndarray, "3"] | None, least: float) -> str:
    if s is None or shared is None:
        return ""
    power, across, down = shared
    return _of_neighbours(s, across / power, down / power) if min(across, down) >= least * power else ""


def _one_way(flat: FrameStatistics | None, of_dark: Float[np.ndarray, "3"] | None) -> str:
    """The same of a flat whose shot noise neighbours share along one axis: charge goes both ways, and the
    noise of rows or columns is no shot noise."""
    of_flat = _shared(flat)
    if flat is None or of_flat is None:
        return ""
    power, *along = of_flat if of_dark is None else of_flat - of_dark
    least, most = min(along), max(along)
    if most < _DARK * power or least > _ONE_WAY * most or moving(flat):
        return ""
    return _of_neighbours(flat, along[0] / power, along[1] / power)


def _of_neighbours(s: FrameStatistics, across: float, down: float) -> str:
    kind = f"{s.recording.kind}s" if s.recording.kind != "bias" else "biases"
    return f"the noise of neighbours in the {kind} is alike by {across:.2f} across and {down:.2f} down"


def _shared(s: FrameStatistics | None) -> Float[np.ndarray, "3"] | None:
    """Variance, and covariance with the next pixel across and down less the largest some pixels away, DN^2;
    None for frames too small to tell."""
    if s is None or min(s.recording.size) < 2 * _AWAY[-1]:
        return None
    far = tuple(lag for n in _AWAY for lag in ((0, n), (n, 0)))
    found = lag_covariances(s, ((0, 0), (0, 1), (1, 0), *far))

    def over(near: tuple[int, int], away: list[tuple[int, int]]) -> float:
        return found[near][0] - max(abs(found[lag][0]) for lag in away)

    power = max(found[0, 0][0], 1e-12)
    return np.array([power, over((0, 1), [(0, n) for n in _AWAY]), over((1, 0), [(n, 0) for n in _AWAY])])
