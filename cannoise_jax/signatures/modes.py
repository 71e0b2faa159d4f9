"""Fourier modes of rows and of the scan through the unpacked mosaic, and the shape of 1/f^a noise in them."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import fft

from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.line_sums import line_sums


def row_modes(field: Fields, scaling: str) -> tuple[np.ndarray, float]:
    """Summed power of the row offsets per mode of the rows [H/2], mean 1, and the information per mode."""
    sums = line_sums(field, field.contrasts, "row", scaling)
    scaled = sums.score / np.sqrt(np.maximum(sums.information, 1e-30))
    power = np.abs(fft.rfft(scaled, axis=1))[:, 1:] ** 2 / scaled.shape[1]
    # The mean that was taken out is missing in the variance of the sums, but in none of these modes.
    left = 1 - 1 / scaled.shape[1]
    return left * power.sum(0), float(np.mean(sums.information)) / left


def raster_modes(field: Fields) -> tuple[np.ndarray, float]:
    """Summed power of the raster scans of all contrasts [N/2], mean 1, and the information per mode."""
    w = even_rows(field.weight)
    power = np.zeros(w.size // 2)
    for contrast in field.contrasts:
        x = (contrast * w).ravel()
        # By the scan's own power: heavy tails add to all frequencies alike.
        own = max(float(np.sum(x.astype(np.float64) ** 2)), 1e-30)
        power += np.abs(fft.rfft(x - x.mean())[1 : power.size + 1]) ** 2 / own
    return power, float(np.mean(field.weight.astype(np.float64) ** 2))


def even_rows(weight: np.ndarray) -> np.ndarray:
    """Weights with a mean square of 1 in every row: slow noise then keeps to its modes in a scan through
    scenes too, as it does in the sums of rows, and both can be compared."""
    w = weight.astype(np.float32)
    root = np.sqrt(np.mean(w**2, axis=1, keepdims=True))
    return w / np.where(root > 0, root, 1)


def mode_weights(size: int) -> np.ndarray:
    """Complex degrees of freedom of the modes 1..size/2 of `size` values: the last one of an even number is
    real. Left out, a strong effect would seem to be worth less here than to a white pattern of all lines."""
    weights = np.ones(size // 2)
    if size % 2 == 0:
        weights[-1] = 0.5
    return weights


def banded(values: np.ndarray) -> np.ndarray:
    """Sums of values [..., n] by frequency over bands in which a slope hardly changes."""
    return np.add.reduceat(values, _bands(values.shape[-1]), axis=-1)


@lru_cache(maxsize=8)
def _bands(number: int) -> np.ndarray:
    """First mode of every band: single modes, then bands of a thirtieth of their frequency."""
    edges = np.unique(np.geomspace(1, number + 1, int(30 * np.log(number + 1))).astype(int))
    return edges[edges <= number] - 1


def slope_shape(size: int, exponent: float) -> np.ndarray:
    """Power of the modes 1..size/2 of `size` values, 1 on average."""
    shape = (np.arange(1, size // 2 + 1) / size) ** -exponent
    return shape / np.average(shape, weights=mode_weights(size))
