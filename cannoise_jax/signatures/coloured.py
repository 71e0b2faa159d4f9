"""Maps of pixels whose neighbours are alike, or unlike: drawn from what is known of them.

Masks of a sensor are stepped, lenses and charge reach over to the next pixel: a map of sensitivities is
seldom white. Its estimate is, but for white noise, as coloured as itself. A draw that fills in what the
estimate leaves open with white values is whiter than the camera.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import fft

_REACH = 3
"""Pixels to the side and down to which neighbours are looked at."""
_SURE = 5.0
"""Standard errors from which on a correlation counts: of 24 lags by chance one in 70,000 maps."""
_LEAST = 0.05
"""Share of the variance that every frequency keeps."""
OUTLYING = 4.0
"""Standard deviations from which on a pixel says nothing of those beside it: it is cut off where correlations
are measured."""


def spectrum_of(
    estimate: Float[np.ndarray, "h w"], noise: float, variance: float
) -> Float[np.ndarray, "h v"] | None:
    """Power over frequency (`rfft2`) of a map of this variance, by the correlations of its estimate, which
    has white noise of variance `noise` beside it; None for a map that is white, or alike in cells of 2 x 2
    only."""
    total = variance + noise
    limit = OUTLYING * np.sqrt(total)
    values = np.clip(estimate, -limit, limit)
    values = values - values.mean()
    h, w = values.shape
    error = float(np.mean(values**2)) / np.sqrt(values.size)
    if _in_cells(values, 2 * _SURE * error):
        return None
    lags = {}
    for dy in range(_REACH + 1):
        for dx in range(-_REACH if dy else 1, _REACH + 1):
            a = values[: h - dy, max(0, -dx) : w - max(0, dx)]
            b = values[dy:, max(0, dx) : w + min(0, dx)]
            shared = float(np.mean(a * b))
            if abs(shared) > _SURE * error:
                lags[dy, dx] = shared
    if not lags:
        return None
    y, x = np.meshgrid(fft.fftfreq(h), fft.rfftfreq(w), indexing="ij")
    power = np.full(y.shape, float(variance))
    for (dy, dx), shared in lags.items():
        power += 2 * shared * np.cos(2 * np.pi * (dy * y + dx * x))
    return np.maximum(power, _LEAST * variance)


def _in_cells(values: Float[np.ndarray, "h w"], limit: float) -> bool:
    """Whether neighbours within a cell of 2 x 2 are more alike than those across its border."""
    for turned in (values, values.T):
        products = turned[:, :-1] * turned[:, 1:]
        if abs(float(products[:, ::2].mean() - products[:, 1::2].mean())) > limit:
            return True
    return False


def draw_coloured(
    estimate: Float[np.ndarray, "h w"],
    noise: float,
    power: Float[np.ndarray, "h v"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "h w"]:
    """A draw of a map of this spectrum from what its estimate tells of it: Wiener's, and the doubt that it
    leaves drawn anew."""
    size = estimate.shape
    mean = fft.irfft2(power / (power + noise) * fft.rfft2(estimate), size)
    doubt = np.sqrt(power * noise / (power + noise)) * fft.rfft2(rng.standard_normal(size))
    return mean + fft.irfft2(doubt, size)
