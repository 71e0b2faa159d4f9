"""What frames, recorded or drawn, look like under the baseline: by frequency, by distance and by level."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.lag_sums import LAGS, lag_sums
from cannoise_jax.signatures.line_sums import line_power

_LEVEL_BINS = 8
"""Bins of like signal."""


class Curves(NamedTuple):
    """What draws or recordings look like under the baseline.

    row_spectrum, column_spectrum: mean power of the means of rows and columns by cycles per frame; white
    noise: 1. covariance: correlation of a pixel with the one (dy, dx) away, `lag_sums.LAGS` in order.
    signal, variance: DN and DN^2, points of the photon-transfer curve.
    """

    row_spectrum: Float[np.ndarray, "f"]
    column_spectrum: Float[np.ndarray, "g"]
    covariance: Float[np.ndarray, "l"]
    signal: Float[np.ndarray, "p"]
    variance: Float[np.ndarray, "p"]


def curves(fields: tuple[Fields, ...]) -> Curves:
    """Spectra, covariances and photon-transfer points of residual fields."""
    spectra = {}
    for axis in ("row", "column"):
        size = fields[0].mean.shape[0 if axis == "row" else 1]
        total, number = np.zeros(size // 2 + 1), 0
        for f in fields:
            if len(f.contrasts) and f.mean.shape == fields[0].mean.shape:
                total += line_power(f, f.contrasts, axis)
                number += len(f.contrasts)
        spectra[axis] = total[1:] / max(number, 1)
    score, information = lag_sums(fields, "white")
    points = [point for f in fields for point in _levels(f)]
    signal, variance = np.array(points).T if points else (np.zeros(0), np.zeros(0))
    covariance = score / np.maximum(information, 1e-30)
    assert covariance.size == len(LAGS)
    return Curves(spectra["row"], spectra["column"], covariance, signal, variance)


def _levels(field: Fields) -> list[tuple[float, float]]:
    """Mean signal and mean temporal variance of pixels of like signal, DN."""
    if not len(field.contrasts) or not field.usable.any():
        return []
    chosen = field.usable
    signal = field.signal[chosen]
    variance = (field.contrasts**2).mean(0)[chosen] * field.sigma[chosen] ** 2
    if field.kind != "scene":
        return [(float(signal.mean()), float(variance.mean()))]
    edges = np.quantile(signal, np.linspace(0, 1, _LEVEL_BINS + 1)[1:-1])
    which = np.searchsorted(edges, signal)
    return [
        (float(signal[which == b].mean()), float(variance[which == b].mean()))
        for b in range(_LEVEL_BINS)
        if (which == b).any()
    ]
