"""How the moments of a static map scatter from one to the next, of which much is fixed.

Let a pixel have m fixed and noise of variance s. Of its Hermite polynomials the noise moves

    z^2 - 1:         4 m^2 s + 2 s^2
    z^3 - 3 z:       9 (m^2 - 1)^2 s + 18 (2 m^2 - 1) s^2 + 15 s^3
    z^4 - 6 z^2 + 3: 16 m^2 (m^2 - 3)^2 s + (96 m^2 (m^2 - 3) + 72 (m^2 - 1)^2) s^2
                     + (240 m^2 + 144 (m^2 - 1)) s^3 + 96 s^4

by in variance, which without anything fixed is 2, 6 and 24. In the light of a glow that is hundreds of times
as much.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from cannoise_jax.signatures import bank

_NEAR = 9
"""Pixels along a side over which noise and map are taken to be alike: of one contrast their noise is known to
a sixth."""


def moment_variance(
    static: Float[np.ndarray, "h w"], kept: Bool[np.ndarray, "h w"], contrasts: Float[np.ndarray, "n h w"]
) -> Float[np.ndarray, "k"]:
    """Variance of the moments of a static map as `bank.hermite` has them, the second of the map as it is, the
    others of it divided by its own root mean square. contrasts: of the frames that it is the mean of, zero
    where a pixel is set aside."""
    square = static.astype(float) ** 2
    noise: np.ndarray | float = 1.0  # of one frame nothing tells it
    if len(contrasts):
        noise = _nearby(np.mean(contrasts**2, 0, dtype=float), np.any(contrasts, 0) & kept)
    whole = _nearby(square, kept)
    m2 = square * np.maximum(1 - noise / np.maximum(whole, 1e-9), 0.0)
    own = max(float(square[kept].mean()), 1e-9)
    m, s = m2 / own, noise / own
    each = (
        4 * m2 * noise + 2 * noise**2,
        9 * (m - 1) ** 2 * s + 18 * (2 * m - 1) * s**2 + 15 * s**3,
        16 * m * (m - 3) ** 2 * s
        + (96 * m * (m - 3) + 72 * (m - 1) ** 2) * s**2
        + (240 * m + 144 * (m - 1)) * s**3
        + 96 * s**4,
    )
    return np.concatenate([bank.map_variance(np.maximum(v, 0.0) * kept, kept) for v in each])


def _nearby(values: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Mean of the pixels near by that are kept; that of all of them where there are none."""
    total, count = (ndimage.uniform_filter(v, _NEAR) for v in (values * kept, kept.astype(float)))
    every = float(values[kept].mean()) if kept.any() else 1.0
    return np.where(count > 0.5 / _NEAR**2, total / np.maximum(count, 1e-9), every)
