"""The photon transfer line of one channel: temporal variance against mean, robust, with its error.

Rule for outliers: at every pixel the temporal variance is divided by the fitted one; a pixel is set aside
when the quotient exceeds the larger of 4 (twice the noise) and the value that chi-square with the pixel's
degrees of freedom exceeds once in 10^4 pixels. What this cuts off a healthy population is known and given
back. Noise below half a code is taken for half a code by this rule: of most pixels no value ever changes, and
one that changes by a code is no outlier. Pixels that touched a rail in any frame are left out beforehand.

The mean of T frames is itself noisy, which flattens a regression on it; the moments of that error are known
(variance v/T, and its covariance with the sample variance, the third cumulant K^2 (mean) / T of shot noise)
and taken out of the normal equations.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.estimate import Estimate, jackknife_estimate

_RARE = 1e-4
"""Share of healthy pixels that the rule sets aside, and gives back."""
_LEAST_CUT = 4.0
"""Least quotient of an outlier, twice the noise: from 8 degrees of freedom on it rules, and sets aside
fewer."""
_BLOCKS = 8
"""Along either side: of 64 blocks a jackknifed error is itself known to 1 / sqrt(2 x 63) = 9 %."""
_ROUNDS = 4
"""Of the weights: at the fourth, slopes through 64 x 64 pixels of four levels, up to 5 % of them 20 times as
noisy, moved by less than 1e-10 of their standard error; at the second by up to 4e-5."""
_LEAST_SLOPE = 1e-9
"""DN/e-, of a camera whose noise does not grow with the light."""
HALF_A_CODE = 3.0
"""Its square in units of the variance that rounding adds: 1/4 over 1/12."""
_APART = 0.2
"""Of the median distance from the darkest class, from which on another one is far from it."""
_UNSURE = 0.3
"""Standard error over the slope above which there is no gain: electrons per DN, 1 / slope, are then biased by
its square, 9 %, and three errors reach zero."""


class ChannelMaps(NamedTuple):
    """One channel of one recording: signal above dark and temporal variance of every pixel, DN and DN^2.

    known_signal: the signal is known not to vary (darks: zero), so its map carries no error. unlike: by what
    factor the variance of a pixel is that of all, where kinds of pixels are known to differ.
    """

    signal: Float[np.ndarray, "h w"]
    variance: Float[np.ndarray, "h w"]
    usable: Bool[np.ndarray, "h w"]
    frames: int
    dof: float
    known_signal: bool
    unlike: Float[np.ndarray, "h w"] | float = 1.0


@dataclass(frozen=True)
class Line:
    """variance = slope * signal + offset. dropped: share of pixels set aside by the rule.

    slope in DN/e-; offset, DN^2, is the dark temporal variance with the rounding taken out.
    """

    slope: Estimate
    offset: Estimate
    dropped: float

    @property
    def sure(self) -> bool:
        """Whether the standard error of the slope is no more than 0.3 of it."""
        return self.slope.stderr <= _UNSURE * abs(self.slope.value)


@lru_cache(maxsize=256)
def cut_and_loss(dof: float) -> tuple[float, float]:
    """The quotient above which a pixel is set aside, and by what factor this shrinks a healthy mean."""
    cut = max(_LEAST_CUT, float(stats.chi2.isf(_RARE, dof)) / dof)
    return cut, float(stats.chi2.cdf(cut * dof, dof + 2) / stats.chi2.cdf(cut * dof, dof))


def robust_mean_square(
    variance: Float[np.ndarray, "*n"],
    dof: float,
    expected: Float[np.ndarray, "*n"] | float | None = None,
    rounding: float = 0.0,
) -> tuple[float, Bool[np.ndarray, "*n"]]:
    """Mean temporal variance by the outlier rule, and the pixels kept. expected: the fitted variance; where
    none is known, the median's. rounding: see `fit_line`."""
    if expected is None:
        expected = float(median(variance)) / median_quotient(dof)
    cut, loss = cut_and_loss(dof)
    keep = variance <= cut * np.maximum(expected, max(HALF_A_CODE * rounding, 1e-12))
    return float(variance[keep].mean()) / loss, keep


@lru_cache(maxsize=256)
def median_quotient(dof: float) -> float:
    """Median of a mean square in units of its expectation."""
    return float(stats.chi2.median(dof) / dof)


def fit_line(levels: list[ChannelMaps], rounding: float) -> Line | None:
    """The photon transfer line through all pixels of `levels` (all of one size), each weighted by its degrees
    of freedom over the square of the fitted variance. rounding: the variance that rounding to codes adds,
    DN^2. None when the levels do not span a slope.
    """
    slope, offset = _start(levels)
    if not np.isfinite(slope) or not np.isfinite(offset):
        return None
    normal, right = np.zeros((1, 2, 2)), np.zeros((1, 2))
    dropped = 0.0
    for _ in range(_ROUNDS):
        sums = [_block_sums(level, slope, offset, rounding) for level in levels]
        normal = np.sum([s[0] for s in sums], axis=0)
        right = np.sum([s[1] for s in sums], axis=0)
        dropped = 1 - sum(s[2] for s in sums) / max(sum(s[3] for s in sums), 1)
        solved = _solve(normal.sum(0), right.sum(0))
        if solved is None:
            return None
        offset, slope = solved
        if slope < _LEAST_SLOPE:  # no noise falls with the light: all of it is the offset's
            slope, offset = _LEAST_SLOPE, float(right[:, 0].sum() / normal[:, 0, 0].sum())
    without = [_solve(normal.sum(0) - n, right.sum(0) - r) for n, r in zip(normal, right, strict=True)]
    left = np.array([w for w in without if w is not None])
    if len(left) < 8:
        return None
    return Line(
        jackknife_estimate(slope, left[:, 1]),
        jackknife_estimate(offset - rounding, left[:, 0] - rounding),
        dropped,
    )


def _start(levels: list[ChannelMaps]) -> tuple[float, float]:
    """A first line through medians of sixteen classes of equal signal per level; where it does not rise, for
    a class may hold dead pixels, from the darkest with the median of the slopes to those far from it."""
    points = []
    for level in levels:
        signal, variance = level.signal[level.usable], level.variance[level.usable]
        if len(signal) < 64:
            continue
        classes = 1 if level.known_signal else 16
        for part in np.array_split(np.argsort(signal, kind="stable"), classes):
            points.append((signal[part].mean(), median(variance[part]) / median_quotient(level.dof)))
    x, y = np.array(points).reshape(-1, 2).T
    if len(x) < 2 or np.ptp(x) == 0:
        return np.nan, np.nan
    weight = 1 / np.maximum(y, 1e-6)
    slope, offset = np.polyfit(x, y, 1, w=weight)
    if slope <= 0:
        low = int(np.argmin(x))
        apart = x - x[low]
        far = apart > _APART * (median(apart) or np.ptp(x))
        slope = float(median((y[far] - y[low]) / apart[far]))
        offset = float(y[low] - slope * x[low])
    offset = offset if offset > 0 else max(float(y.min()) * 0.5, 1e-6)
    return max(float(slope), 1e-6), float(offset)


def _block_sums(
    level: ChannelMaps, slope: float, offset: float, rounding: float
) -> tuple[np.ndarray, np.ndarray, int, int]:
    """Normal equations of each block of the image: [B, 2, 2] and [B, 2] for (offset, slope)."""
    cut, loss = cut_and_loss(level.dof)
    fitted = np.maximum(slope * level.signal + offset, max(0.1 * offset, rounding, 1e-9))
    keep = level.usable & (level.variance <= cut * np.maximum(fitted * level.unlike, HALF_A_CODE * rounding))
    weight = np.where(keep, level.dof / fitted**2, 0.0)
    variance = level.variance / loss
    signal = level.signal
    error = 0.0 if level.known_signal else fitted / level.frames
    third = 0.0 if level.known_signal else slope**2 * np.maximum(signal, 0.0) / level.frames
    terms = (
        weight, weight * signal, weight * (signal**2 - error),
        weight * variance, weight * (signal * variance - third),
    )  # fmt: skip
    one, first, second, plain, cross = (block_sums(t) for t in terms)
    normal = np.stack([np.stack([one, first], -1), np.stack([first, second], -1)], -2)
    return normal, np.stack([plain, cross], -1), int(keep.sum()), int(level.usable.sum())


def block_sums(values: Float[np.ndarray, "h w"], blocks: int = _BLOCKS) -> Float[np.ndarray, "b"]:
    """Sums over a grid of at most `blocks` x `blocks` parts of an image."""
    height, width = values.shape
    rows = np.linspace(0, height, min(blocks, height) + 1).astype(int)[:-1]
    columns = np.linspace(0, width, min(blocks, width) + 1).astype(int)[:-1]
    return np.add.reduceat(np.add.reduceat(values, rows, 0), columns, 1).ravel()


def _solve(normal: np.ndarray, right: np.ndarray) -> tuple[float, float] | None:
    """(offset, slope), or None where the two cannot be told apart."""
    determinant = normal[0, 0] * normal[1, 1] - normal[0, 1] ** 2
    if not determinant > 1e-10 * normal[0, 0] * abs(normal[1, 1]):
        return None
    offset, slope = np.linalg.solve(normal, right)
    return float(offset), float(slope)
