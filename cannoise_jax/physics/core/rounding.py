"""What rounding to codes and clipping at code 0 do to the moments of normal noise, and back.

Noise of less than a code is anything but read^2 + step^2 / 12 once rounded, and a black level near code 0
is cut off below. Pixels whose offsets differ by a good part of a code dither each other: what is asked for is
the mean over them.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import optimize, special

from cannoise_jax.physics.robust import median

_REACH = 12
"""Codes on both sides that are summed over, besides eight standard deviations."""
_NODES = 25
"""Quantiles that stand for the offsets of all pixels."""
COARSE = 1.5
"""Standard deviations, codes, from which step^2 / 12 is what rounding adds, to better than 1e-18 of it."""
CLEAR = 6.0
"""Standard deviations above code 0 from which the clipping there is not seen."""

_BROAD = 0.5
"""Standard deviations of codes from which on rounding moves their mean by less than a hundredth of a code,
wherever it lies."""


def stored_moments(black: float, read: float, step: float, spread: float = 0.0) -> tuple[float, float]:
    """Mean (DN) and temporal variance (DN^2) of normal noise once rounded and clipped at 0, over all pixels.

    black, read: DN. step: spacing of the codes, DN. spread: standard deviation of the pixels' offsets, DN.
    """
    offsets = special.ndtri((np.arange(_NODES) + 0.5) / _NODES) if spread > 1e-3 * step else np.zeros(1)
    at = (black + spread * offsets[:, None]) / step
    near = np.round(black / step)
    reach = int(_REACH + 8 * (read + spread) / step)
    codes = np.arange(max(near - reach, 0), max(near + reach, 0) + 1)
    upper = special.ndtr((codes + 0.5 - at) * step / read)
    chance = np.diff(upper, prepend=0.0)
    chance[:, -1] += 1 - upper[:, -1]
    mean = chance @ codes
    square = chance @ codes**2 - mean**2
    return float(mean.mean()) * step, float(square.mean()) * step**2


def mean_bias(dither: float) -> float:
    """The most by which rounding moves the mean of normal values of this variance, codes squared, in codes:
    the first harmonic of the staircase."""
    return float(np.exp(-2 * np.pi**2 * dither) / np.pi)


def variance_bias(dither: float) -> float:
    """The most by which it moves their variance away from that before rounding plus 1/12, codes squared."""
    return float((1 / np.pi**2 + 4 * dither) * np.exp(-2 * np.pi**2 * dither))


def before_cut(level: float, variance: float, step: float) -> float:
    """Level of a dark, DN, before what code 0 cut off; as it is where that is far, and of noise so small
    (temporal variance of the codes, DN^2) that the offsets of pixels decide where it lies between two codes.
    """
    sigma = float(np.sqrt(variance))
    if sigma < _BROAD * step or level > CLEAR * sigma:
        return level
    return before_rounding(level, variance, step)[0]


def level_and_spread(
    means: Float[np.ndarray, "*n"], variance: float, frames: int, step: float
) -> tuple[float, float]:
    """Mean of the ordinary pixels' means over `frames` frames, DN, and standard deviation of their offsets
    once noise of this temporal variance, DN^2, is taken out."""
    near = means[np.abs(means - median(means)) < 6 * max(np.sqrt(variance), step)]
    return float(near.mean()), float(np.sqrt(max(float(near.var()) - variance / frames, 0.0)))


def before_rounding(mean: float, variance: float, step: float, spread: float = 0.0) -> tuple[float, float]:
    """Black level and read noise (DN) whose stored mean (DN) and temporal variance (DN^2) are these, see
    `stored_moments`."""
    start = np.sqrt(max(variance - step**2 / 12, 0.02 * step**2))
    if start > COARSE * step and mean > CLEAR * start:
        return mean, float(start)

    def miss(at: np.ndarray) -> np.ndarray:
        m, v = stored_moments(at[0] * step, np.exp(at[1]) * step, step, spread)
        return np.array([(m - mean) / step, (v - variance) / max(variance, 1e-3 * step**2)])

    best = None
    for shift in (0.0, -0.3, 0.3, -1.0):
        for factor in (1.0, 0.6, 1.5):
            guess = np.array([mean / step + shift, np.log(factor * start / step)])
            found = optimize.least_squares(
                miss, guess, bounds=([mean / step - 5 * start / step - 2, -4], [mean / step + 1, 6])
            )
            if best is None or found.cost < best.cost - 1e-12:
                best = found
        if best is not None and best.cost < 1e-10:
            break
    assert best is not None
    return float(best.x[0] * step), float(np.exp(best.x[1]) * step)
