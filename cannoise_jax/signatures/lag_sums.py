"""Products of neighbouring pixels, summed by their distance."""

from __future__ import annotations

import numpy as np
from scipy import fft

from cannoise_jax.signatures.fields import Fields

REACH = 5
"""Rows and columns from which on neighbours are not looked at."""

LAGS = tuple((dy, dx) for dy in range(REACH) for dx in range(1 - REACH, REACH) if dy > 0 or dx > 0)
DARK_TOO = ("white", "read")
"""Shares of the noise that darks have as well: all of it, or the read noise."""

_ROUNDING = 1e-6
"""Of sums over pixels by Fourier transforms, as a share of the sum of squares: sixty times what weights on
one pixel in eighty leave where no pair is that far apart."""


def pair_weight(field: Fields, law: str) -> np.ndarray:
    """Square root of the weight of a pair: 1, the share of read noise or of shot noise, or the latter times
    the electrons."""
    if law == "white":
        return field.usable.astype(np.float32)
    if law == "read":
        return (np.sqrt(np.clip(1 - field.shot, 0, 1)) * field.usable).astype(np.float32)
    share = np.sqrt(np.clip(field.shot, 0, 1)) * field.usable
    if law == "shot":
        return share.astype(np.float32)
    electrons = field.signal / np.maximum(np.mean(field.gain), 1e-9)
    return (share * np.sqrt(electrons / 1e4)).astype(np.float32)


def lag_sums(fields: tuple[Fields, ...], law: str) -> tuple[np.ndarray, np.ndarray]:
    """Per lag: U = sum of weighted products of neighbours, and its null variance I."""
    score, information = np.zeros(len(LAGS)), np.zeros(len(LAGS))
    rounding = 0.0
    for f in fields:
        if not len(f.contrasts) or not (f.lit or law in DARK_TOO):
            continue
        g = pair_weight(f, law)
        # Row and column offsets are mechanisms of their own: they are taken out, and what that does to the
        # covariance of white noise is known exactly.
        c = f.contrasts
        c = c - c.mean(1, keepdims=True) - c.mean(2, keepdims=True) + c.mean((1, 2), keepdims=True)
        x = c * g
        h, w = f.mean.shape
        shape = (fft.next_fast_len(h + 5), fft.next_fast_len(w + 5))
        power = sum(np.abs(fft.rfft2(v, shape)) ** 2 for v in x)
        auto = fft.irfft2(power, shape)
        squares = fft.irfft2(np.abs(fft.rfft2(g**2, shape)) ** 2, shape) * len(x)
        pairs = fft.irfft2(np.abs(fft.rfft2(g, shape)) ** 2, shape) * len(x)
        for k, (dy, dx) in enumerate(LAGS):
            bias = 1 / (h * w) - (1 / w if dy == 0 else 0.0) - (1 / h if dx == 0 else 0.0)
            score[k] += auto[dy, dx] - bias * pairs[dy, dx]
            information[k] += squares[dy, dx]
        rounding += _ROUNDING * squares[0, 0]
    known = information > rounding  # else no pair is that far apart, and the transforms leave their rounding
    return np.where(known, score, 0.0), np.where(known, information, 0.0)
