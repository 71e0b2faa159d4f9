"""What a frame shares with the one before it: charge that stays in the pixel, or an average over time.

A share k of the charge that comes with the next frame leaves (1-k)^2 + k^2 of the variance of white noise,
and k (1-k) between a frame and the next. Light that moves is alike in pixels some way apart, so that their
differences are looked at; what pixels have over many frames each, as telegraph pixels do, is not that of two,
so that of the covariance with the next frame that with all later ones is taken off.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cannoise_jax.physics.transfer.estimate import Estimates, NotMeasurable
from cannoise_jax.physics.transfer.estimators.neighbours import residuals, solved, through
from cannoise_jax.physics.transfer.estimators.pick import brightest_flat, darkest, no_flat
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.smoothed import moving

_LEAST_FRAMES = 3
"""Frames of which some do not follow each other."""
_WIDE = 16
"""Columns that tell pixels apart."""
_MOST_LEFT = 0.45
"""Share left behind beyond which more comes late than in time."""
_AS_DARK, _SURE = 0.5, 5.0
"""Of the correlation in flats, that in darks from which on it is no charge: their noise is none. Standard
errors by which it has to be there."""
_APART, _OVERLAP = 4, 1.5
"""Pixels apart, and by how much the variance of a sum over products of such differences is larger than of
independent ones: each pixel is in two, whose products correlate by a quarter."""
_TOO_ALIKE = NotMeasurable(
    "frames that follow each other are more alike than charge left behind makes them: the light moves, or "
    "frames are averaged over time: record raw frames of a steady light"
)
_AVERAGED = NotMeasurable(
    "frames that follow each other are alike in darks as well: they are averaged over time: record raw frames"
)


class _Shared(NamedTuple):
    """Covariance of frames that follow each other, its standard error, and the variance, DN^2."""

    value: float
    error: float
    variance: float


def _left(share: float) -> float:
    return (1 - share) ** 2 + share**2


def kept(share: float, statistics: Sequence[FrameStatistics]) -> float:
    """Of the variance of white noise, what flats show where this share of the charge comes with the next
    frame."""
    flat = brightest_flat(statistics)
    count = 2 if flat is None else flat.recording.count
    return _left(share) - _in_mean(share * (1 - share), count)


def image_lag(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """fraction of the charge that comes with the next frame, from the covariance of flats that follow each
    other, in shot noise as it is measured. Beside light that moves none is told."""
    flat, dark = brightest_flat(statistics), darkest(statistics)
    if flat is None:
        return no_flat(statistics)
    if flat.recording.count < _LEAST_FRAMES:
        return NotMeasurable(
            f"record at least {_LEAST_FRAMES} frames of a flat, one after the other, better 16"
        )
    if flat.recording.size[1] <= _WIDE:
        return NotMeasurable(f"record frames of more than {_WIDE} columns")
    if moving(flat):
        return _TOO_ALIKE
    lit = _shared(flat)
    read = 0.0
    if dark is not None and dark.recording.count >= _LEAST_FRAMES:
        unlit = _shared(dark)
        alike = unlit.value * lit.variance > _AS_DARK * lit.value * unlit.variance
        if alike and unlit.value > _SURE * unlit.error:
            return _AVERAGED
        read = unlit.variance
    shot = max(lit.variance - read, 1e-12)
    rho, error = lit.value / shot, lit.error / shot
    if abs(rho) > _late(_MOST_LEFT):
        return _TOO_ALIKE
    return {"fraction": through(lambda r: solved(_late, r, _MOST_LEFT), rho, error)}


def _late(share: float) -> float:
    return share * (1 - share) / _left(share)


def _shared(s: FrameStatistics) -> _Shared:
    """Covariance with the next frame less that with later ones, over all pixels."""
    next_ones, square, spread, before = 0.0, 0.0, 0.0, None
    # Pixels that a shadow or a spot came over have changed for good.
    used = ~s.clipped[:, _APART:] & ~s.clipped[:, :-_APART]
    for frame in residuals(s):
        rest = used * (frame[:, _APART:] - frame[:, :-_APART]) / np.sqrt(2)
        square += float(np.sum(rest**2))
        if before is not None:
            product = rest * before
            next_ones += float(product.sum())
            spread += float(np.sum(product**2))
        before = rest
    count, pixels = s.recording.count, max(int(used.sum()), 1)
    pairs, others = count - 1, (count - 1) * (count - 2) // 2
    # All frames add up to nothing: what pairs share, over all of them, is half of what each has, less.
    later = -square / 2 - next_ones
    value = (next_ones / pairs - later / others) / pixels / _seen(count)
    error = np.sqrt(_OVERLAP * spread / pairs / pixels * _doubt(count) / pixels) / _seen(count)
    return _Shared(value, float(error), square / pixels / pairs + _in_mean(value, count))


def _seen(count: int) -> float:
    """Of what frames share with the next beyond later ones, what the mean of all, taken out, leaves."""
    return 1 - 2 / (count * (count - 1))


def _doubt(count: int) -> float:
    """Variance of that of independent frames, in the mean square of a product of two of them: traces of the
    products of the weights with the projection that takes the mean out."""
    return (count + 1) * count**2 / ((count - 1) ** 2 * ((count - 1) ** 2 + 2))


def _in_mean(shared: float, count: int) -> float:
    """Variance that the mean of so many frames takes out of each beside that of independent ones."""
    return 2 * shared / count
