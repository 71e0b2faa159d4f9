"""Spectra as few recordings show them: noise out of maps, shapes told from the chance of frequencies."""

from __future__ import annotations

import numpy as np
from scipy import fft, ndimage, stats

from cannoise_jax.physics.robust import robust_std

_WIDE = 7
"""Frequencies over which a broad shape is averaged: of 49 it is known to a seventh of one, of 7 along a line
to 0.38."""
SURE, LIKELY = 3.0, 2.0
"""Standard errors from which a part of a spectrum is not what it is elsewhere: of fixed maps, of redrawn
noise."""


def wiener(values: np.ndarray, noise: float, seed: int) -> np.ndarray:
    """A map drawn towards its mean, frequency by frequency, by the share of its power that is noise.

    What the frames leave open is drawn at random, so that the map has the pattern's own power.
    What stands out is kept.
    """
    centre = float(np.median(values))
    away = values - centre
    scale = max(robust_std(away, 0), np.sqrt(noise))
    out = np.abs(away) > 5 * scale
    waves = fft.fft2(np.where(out, 0.0, away))
    beyond = np.maximum(smooth(np.abs(waves) ** 2 / values.size - noise, 1, noise, SURE), 0)
    seen, share = beyond + noise, beyond / (beyond + noise)
    open_part = fft.fft2(np.random.default_rng(seed).standard_normal(values.shape))
    rest = fft.ifft2(share * waves + np.sqrt(share * (1 - share) * seen) * open_part).real
    return centre + np.where(out, away, rest)


def smooth(power: np.ndarray, n: int, level: float, errors: float) -> np.ndarray:
    """A spectrum (of `n` fields together) as white as it may be.

    Broad shapes, rows, columns, those of odd against even pixels, and single frequencies depart from white
    only where they stand out of their scatter.
    White that does not stand out either is no power at all.
    level: power that is not in `power`, but that it scatters by.
    errors: standard errors from which it stands out.
    """
    h, w = power.shape
    own_rows, own_columns = ([0, m // 2] if m % 2 == 0 else [0] for m in (h, w))
    plane = power.copy()
    for i in own_rows:
        plane[i] = (power[(i + 2) % h] + power[i - 2]) / 2
    for j in own_columns:
        plane[:, j] = (plane[:, (j + 2) % w] + plane[:, j - 2]) / 2
    white = float(plane.mean())
    white = white if abs(white) > errors * level / np.sqrt(n * power.size) else 0.0
    scatter = max(level + white, 0.1 * level)

    def sure(values: np.ndarray, count: int) -> np.ndarray:
        return np.where(np.abs(values - white) > errors * scatter / np.sqrt(n * count), values, white)

    out = sure(ndimage.uniform_filter(plane, _WIDE, mode="wrap"), _WIDE**2)
    for i in own_rows:
        out[i, 1:] = sure(_along(power[i, 1:]), _WIDE)
    for j in own_columns:
        out[1:, j] = sure(_along(power[1:, j]), _WIDE)
    limit = stats.chi2.isf(0.05 / power.size, 2 * n) / (2 * n) - 1
    beside = np.maximum(out + level, 0.1 * level)
    out = np.where(power - out > limit * beside, power, out)
    out[0, 0] = power[0, 0] if power[0, 0] > 4 * scatter else white
    return out


def _along(line: np.ndarray) -> np.ndarray:
    """A line of a spectrum smoothed, single frequencies aside."""
    local = ndimage.median_filter(line, 9, mode="wrap")
    spread = robust_std(line - local, 0)
    return ndimage.uniform_filter1d(np.where(line - local > 6 * spread, local, line), _WIDE, mode="wrap")
