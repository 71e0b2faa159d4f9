"""Spectra as few recordings show them: shapes told from the chance of frequencies."""

from __future__ import annotations

import numpy as np
from scipy import ndimage, stats

from cannoise_jax.physics.robust import median, robust_std

_WIDE = 7
"""Frequencies over which a broad shape is averaged: of 49 it is known to a seventh of one, of 7 along a line
to 0.38."""
SURE, LIKELY = 3.0, 2.0
"""Standard errors from which a part of a spectrum is not what it is elsewhere: of fixed maps, of redrawn
noise."""


def smooth(power: np.ndarray, n: int | float, level: float | np.ndarray, errors: float) -> np.ndarray:
    """A spectrum (of `n` fields together) as white as it may be.

    Broad shapes, rows, columns, those of odd against even pixels, frequencies along rows (or down columns)
    whose phase is another one in each, and single frequencies depart from white only where they stand out of
    their scatter.
    White that does not stand out either is no power at all.
    level: power that is not in `power`, but that it scatters by: one number, or of every frequency.
    errors: standard errors from which it stands out.
    """
    h, w = power.shape
    level = np.broadcast_to(np.asarray(level, float), power.shape)
    own_rows, own_columns = ([0, m // 2] if m % 2 == 0 else [0] for m in (h, w))
    limit = stats.chi2.isf(0.05 / power.size, 2 * n) / (2 * n) - 1
    every, (single, calm) = power, _singles(power, n, level, limit)
    power = np.where(single, calm, power)
    plane = power.copy()
    for i in own_rows:
        plane[i] = (power[(i + 2) % h] + power[i - 2]) / 2
    for j in own_columns:
        plane[:, j] = (plane[:, (j + 2) % w] + plane[:, j - 2]) / 2
    # Frequencies at which there is much noise say little of those about them.
    least = 1e-12 * float(level.max()) + 1e-300
    chance = 1 / np.maximum(np.maximum(level + float(plane.mean()), 0.1 * level), least) ** 2
    lines = []
    for axis, own in ((0, own_rows), (1, own_columns)):
        inner, certain = np.delete(plane, own, axis), np.delete(chance, own, axis)
        lines.append(
            _narrow(np.average(inner, axis, weights=certain), errors / np.sqrt(n * certain.sum(axis)))
        )
    narrow = lines[0][None, :] + lines[1][:, None]
    plane = plane - narrow
    certain = 1 / np.maximum(level, least) ** 2
    white = float(np.average(plane, weights=certain))
    # Every wave is counted twice.
    white = white if abs(white) > errors * np.sqrt(2 / (n * float(certain.sum()))) else 0.0
    scatter = np.maximum(level + white, 0.1 * level)

    def sure(values: np.ndarray, error: np.ndarray) -> np.ndarray:
        return np.where(np.abs(values - white) > errors * error, values, white)

    certain = 1 / np.maximum(scatter, least) ** 2
    about = ndimage.uniform_filter(certain, _WIDE, mode="wrap")
    broad = ndimage.uniform_filter(plane * certain, _WIDE, mode="wrap") / about
    out = sure(broad, 1 / np.sqrt(n * _WIDE**2 * about)) + narrow
    for i in own_rows:
        out[i, 1:] = sure(_along(power[i, 1:]), _error(scatter[i, 1:], n))
    for j in own_columns:
        out[1:, j] = sure(_along(power[1:, j]), _error(scatter[1:, j], n))
    beside = np.maximum(out + level, 0.1 * level)
    out = np.where(np.abs(every - out) > limit * beside, every, out)
    out[0, 0] = every[0, 0] if every[0, 0] > 4 * scatter[0, 0] else white
    return out


def _singles(
    power: np.ndarray, n: int | float, level: np.ndarray, limit: float
) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies that stand out of those about them, of their row and of their column, and what these have:
    else the power of one wave would be counted in its shape, its row and its column besides."""
    seen = power / np.maximum(level, 1e-300) + 1  # of what it scatters by, which has peaks of its own
    about = ndimage.median_filter(
        ndimage.median_filter(seen, (1, _WIDE), mode="wrap"), (_WIDE, 1), mode="wrap"
    )
    for axis in (0, 1):
        about = np.maximum(about, median(seen, axis, keepdims=True))
    about = np.maximum(about / (stats.chi2.median(2 * n) / (2 * n)), 0.1)
    return (seen > (1 + limit) * about) | (seen < -limit), (about - 1) * level


def _error(scatter: np.ndarray, n: int | float) -> np.ndarray:
    """Standard error of a line that is smoothed."""
    return np.sqrt(ndimage.uniform_filter1d(scatter**2, _WIDE, mode="wrap") / (n * _WIDE))


def _narrow(line: np.ndarray, least: np.ndarray) -> np.ndarray:
    """What stands out of the broad shape of a line by more than `least`, and nothing else of it."""
    away = line - ndimage.median_filter(line, 2 * _WIDE + 1, mode="wrap")
    return np.where(np.abs(away) > least, away, 0.0)


def _along(line: np.ndarray) -> np.ndarray:
    """A line of a spectrum smoothed, single frequencies aside."""
    local = ndimage.median_filter(line, 9, mode="wrap")
    spread = robust_std(line - local, 0)
    return ndimage.uniform_filter1d(np.where(line - local > 6 * spread, local, line), _WIDE, mode="wrap")
