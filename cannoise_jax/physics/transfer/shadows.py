"""Shadows of dust in flats: places where all pixels together get less light than those around.

They are of the light and of the glass, and no spread of sensitivities, however alike they are in every flat.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from cannoise_jax.physics.robust import robust_std

_SIDE = 5
"""Pixels of a channel along a side that are judged together, so that single pixels make no shadow."""
_FAR, _SKIRT = 6.0, 2.0
"""Robust standard deviations of such means below the light from which one is a shadow, and down to which the
places beside it belong to it: patterns that fill the frame have none so far out."""
_DEEP = 0.02
"""Share of the light that it lacks at least: surfaces that stand for the light are good to less."""
_SINGLE = 4.0
"""Robust standard deviations of the pixels, or twice `_DEEP`, at which each counts at most: dead pixels are
no shadow, however little light they show."""
_CAPPED = 0.8
"""Of what single pixels count for at most, from which on a mean is far out as well: many shadows bend the
surface that stands for the light, so that all means lie far from it, and none by six of their spreads."""
_MOST = 0.3
"""Share of the frame up to which shadows are; more is uneven light."""


def in_shadow(
    apart: Float[np.ndarray, "h w"], light: Float[np.ndarray, "h w"], keep: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Pixels of a channel in shadows. apart: relative signal less its smooth light; keep: pixels that
    count."""
    none = np.zeros(apart.shape, bool)
    if min(apart.shape) < 4 * _SIDE or not keep.any():
        return none
    share = ndimage.uniform_filter(keep.astype(np.float64), _SIDE)
    lacking = np.where(keep, apart / np.maximum(light, 1e-3), 0.0)
    room = max(_SINGLE * robust_std(lacking[keep], 0.0), 2 * _DEEP)
    lacking = np.clip(lacking, -room, room)
    means = ndimage.uniform_filter(lacking, _SIDE) / np.maximum(share, 1e-3)
    means = np.where(share > 0.5, means, 0.0)
    spread = max(robust_std(means[share > 0.5], 0.0) if (share > 0.5).any() else 0.0, 1e-9)
    places, _ = ndimage.label(means < -_SKIRT * spread)
    deep = np.unique(places[means < -max(min(_FAR * spread, _CAPPED * room), _DEEP)])
    found = np.isin(places, deep[deep > 0])
    return found if found.mean() <= _MOST else none
