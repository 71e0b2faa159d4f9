"""How sure the mean of what cells of the mosaic show is, whatever patterns they are in."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

_BANDS, _CELLS = 16, 4
"""Bands of rows, and of columns, whose scatter says how sure the mean of cells is, and of how many cells at
least."""


def scatter(cells: Float[np.ndarray, "h w"]) -> tuple[float, float]:
    """Variance of the sum of cells by the scatter of bands of rows and of columns, of both together so that
    neither rows nor columns of their own are taken for noise, and its degrees of freedom. What neighbouring
    bands share, as pixels at the edge between them are in the greens of both, adds to it."""
    each, free = [], []
    for axis, length in enumerate(cells.shape):
        bands = max(min(_BANDS, length // _CELLS), 1)
        away = np.array([band.sum() for band in np.array_split(cells, bands, axis)])
        away -= away.mean()
        alike = 2 * max(float(away[1:] @ away[:-1]), 0.0)
        free.append(bands - 1)
        each.append((float(away @ away) + alike) * bands / (bands - 1) if bands > 1 else np.inf)
    total = sum(each)
    if not np.isfinite(total):
        return np.inf, 0.0
    return total, total**2 / max(sum(v**2 / n for v, n in zip(each, free, strict=True)), 1e-300)
