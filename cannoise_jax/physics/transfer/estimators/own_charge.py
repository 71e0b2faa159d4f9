"""Dark charge of the pixels of one dark, told by its shot noise: pixels that hold more of it lie higher, and
their variance is larger by gain times as much.

Mean and variance are those of different frames, for noise with a skew ties those of the same ones.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.physics.transfer.estimators.pick import steady_pixels
from cannoise_jax.physics.transfer.frames import FrameStatistics, steady_frames
from cannoise_jax.physics.transfer.views import pixel_variance
from cannoise_jax.recordings.packing import site

_SURE = 5.0
"""Standard errors of how mean and variance go together from which on dark charge shows."""
_SHOWN = 0.015
"""Of the variance of a pixel, how much more or less of it goes with its level where charge matters: pixels'
currents differ by a third or more, so that the charge is 4 % of the variance, and the noise 2 % too large."""
_FAR = 4.0
"""Robust standard deviations about the median level within which pixels count: hot ones tell of no other."""
_LEAST = 0.1
"""Of the usual variance, the least that is expected of a pixel whose mean lies below the others."""


class Half(NamedTuple):
    """Temporal variance of every pixel in a half of the frames, and its mean, DN."""

    variance: Float[np.ndarray, "H W"]
    mean: Float[np.ndarray, "H W"]


def halves_of(dark: FrameStatistics) -> list[tuple[Half, Half]]:
    """The two halves of the frames of a repeated dark, for the three ways to make halves of four groups of
    frames that take turns."""
    counts, sums, squares = np.zeros(4), [], []
    for at, frame in enumerate(steady_frames(dark)):
        values = frame - dark.mean  # shifted, so that sums of squares do not cancel
        if at < 4:
            sums.append(values)
            squares.append(values**2)
        else:
            sums[at % 4] += values
            squares[at % 4] += values**2
        counts[at % 4] += 1

    def half(pair: tuple[int, int]) -> Half:
        count = sum(counts[k] for k in pair)
        mean = sum(sums[k] for k in pair) / count
        square = sum(squares[k] for k in pair) / count
        return Half((square - mean**2) * count / (count - 1), mean + dark.mean)

    ways = (((0, 1), (2, 3)), ((0, 2), (1, 3)), ((0, 3), (1, 2)))
    return [(half(first), half(second)) for first, second in ways]


def expected_logs(
    mean: Float[np.ndarray, "h w"], keep: Bool[np.ndarray, "h w"], variance: float, gain: float
) -> Float[np.ndarray, "h w"]:
    """Logarithm of the variance that pixels have by the shot noise of their own charge, where all that their
    means differ by is charge. variance: the mean of those kept, DN^2; gain: DN/e-."""
    apart = mean - float(mean[keep].mean())
    return np.log(np.maximum(variance + gain * apart, _LEAST * variance))


def holds_charge(dark: FrameStatistics, pairs: list[tuple[Half, Half]] | None = None) -> bool:
    """Whether the pixels of a dark that lie higher are noisier, by as much as matters: it holds charge. A
    bias has none, and fewer than four frames do not tell. pairs: its `halves_of`, where they are at hand."""
    if dark.recording.kind == "bias" or dark.variance is None or dark.recording.count < 4:
        return False
    pairs = halves_of(dark) if pairs is None else pairs
    values, levels, usual = [], [], []
    for c in range(4):
        level = site(dark.mean, c)
        keep = steady_pixels(dark, c)
        if not keep.any():
            return False
        middle = float(median(level[keep]))
        keep &= np.abs(level - middle) < _FAR * robust_std(level[keep], middle)
        if not keep.any():
            return False
        usual.append(float(pixel_variance(dark, c)[keep].mean()))
        both = [_apart(site(v, c), keep) * _apart(site(m, c), keep) for v, m in _crossed(pairs)]
        values.append(np.mean(both, axis=0))
        levels.append(float(level[keep].var()))
    products = np.concatenate(values)
    together, spread = float(products.mean()), float(np.mean(levels))
    if spread <= 0 or together <= _SURE * float(products.std()) / np.sqrt(products.size):
        return False
    return together / np.sqrt(spread) > _SHOWN * float(np.mean(usual))


def _crossed(pairs: list[tuple[Half, Half]]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Variances of one half with means of the other, both ways."""
    return [(a.variance, b.mean) for one, other in pairs for a, b in ((one, other), (other, one))]


def _apart(values: Float[np.ndarray, "h w"], keep: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "n"]:
    return values[keep] - values[keep].mean()
