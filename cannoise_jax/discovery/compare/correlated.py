"""How much more the moments of a field scatter where its noise is alike from pixel to pixel.

The mean of the k-th Hermite polynomial of white noise, times a weight over the frame, scatters with variance
k!/N. Of normal noise of a correlation r it is k!/N times the spectrum of r^k, averaged over the frequencies
of the weight: two values of correlation r have polynomials of correlation r^k (Mehler's formula). Noise of
whole rows has little more independent values than there are rows, and so few have a skewed law.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import factorial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import fft, special, stats

from cannoise_jax.signatures import bank

_ORDERS = (2, 3, 4)
"""Of the polynomials: variance, skewness and kurtosis."""
_TERMS = 8
"""Of the expansion of a count."""


class Correlated(NamedTuple):
    """Correlations `[h, w]` of a field's noise with itself, around its edges, and of how many fields they are
    the mean."""

    r: Float[np.ndarray, "h w"]
    fields: int

    def to(self, k: int) -> Float[np.ndarray, "h w"]:
        """Their k-th power, but for the pixel itself 1: squares of none at all come out as 1/N a field."""
        out = self.r**k - (1 / (self.r.size * self.fields) if k == 2 else 0.0)
        out[0, 0] = 1.0
        return out


def correlated(power: Float[np.ndarray, "h v"], width: int, fields: int) -> Correlated:
    """power: periodogram of the noise over a half plane, the mean of so many fields of `width` columns."""
    r = fft.irfft2(power, (power.shape[0], width)).astype(np.float32)
    return Correlated(r / max(r[0, 0], np.float32(1e-30)), fields)


def of_moments(noise: Correlated) -> Float[np.ndarray, "k"]:
    """Variance of each of `bank.hermite` over that of white noise, 1 at least."""
    h, w = noise.r.shape
    rows, columns = (_weights(cosines) for cosines in bank.smooth((h, w)))
    # Over half of the plane, for both.
    columns = columns[:, : w // 2 + 1] * np.where((np.arange(w // 2 + 1) * 2) % w == 0, 1, 2)
    out = []
    for k in _ORDERS:
        spectrum = fft.rfft2(noise.to(k)).real
        table = np.einsum("ai,ij,bj->ab", rows, spectrum, columns, optimize=True)
        parities = [spectrum[0, w // 2], spectrum[h // 2, 0], spectrum[h // 2, w // 2]]
        out.append(np.concatenate([table.ravel(), parities]))
    return np.maximum(np.concatenate(out), 1.0)


def of_counts(noise: Correlated, chances: Sequence[float], squares: bool = False) -> Float[np.ndarray, "k"]:
    """Variance of how many pixels lie beyond limits of these chances, over that of independent ones, 1 at
    least, to `_TERMS` terms of Mehler's formula. The mean of the values is taken out. squares: of sums of
    squares, whose correlation is the square of that of the values."""
    powers = range(1 if squares else 2, _TERMS + 1)
    beside = [float(noise.to(2 * k if squares else k).sum()) - 1 for k in powers]
    out = []
    for p in chances:
        t = stats.norm.isf(p)
        each = [
            stats.norm.pdf(t) ** 2 * special.eval_hermitenorm(k - 1, t) ** 2 / factorial(k) for k in powers
        ]
        out.append(1 + float(np.dot(each, beside)) / (p * (1 - p)))
    return np.maximum(np.array(out), 1.0)


_SKEWED = np.repeat([8 / 2**1.5, 0.0, 1728 / 24**1.5], len(bank.MOMENTS))
"""Skewness of each polynomial of one normal value."""
_NOTICED = 1.5
"""Inflation from which on the law of a mean is no longer taken as normal."""


def unskewed(
    z: Float[np.ndarray, "k"],
    wider: Float[np.ndarray, "k"],
    pixels: float,
    skewed: Float[np.ndarray, "k"] = _SKEWED,
) -> Float[np.ndarray, "k"]:
    """Standard deviations of a normal law that are as rare as these of the mean of few independent values, of
    a gamma law (Wilson and Hilferty, Proc. Natl. Acad. Sci. 17, 684, 1931).

    wider: see `of_moments`; skewed: skewness of one value.
    """
    skewness = np.where(wider > _NOTICED, skewed * np.sqrt(wider / pixels), 0.0)
    root = 2 / np.maximum(skewness, 1e-6)
    moved = 3 * root * (np.cbrt(np.maximum(1 + z / root, 0.0)) - 1 + 1 / (9 * root**2))
    return np.where((skewness > 0) & (z > 0), moved, z)


def _weights(cosines: Float[np.ndarray, "o n"]) -> Float[np.ndarray, "o n"]:
    """Shares of the power of every cosine at the frequencies of a side."""
    power = np.abs(fft.fft(cosines, axis=1)) ** 2
    return power / power.sum(1, keepdims=True)
