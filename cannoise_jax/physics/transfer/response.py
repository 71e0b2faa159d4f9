"""The relative sensitivities of the pixels of a flat, beside its smooth light."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from cannoise_jax.physics.robust import robust_std
from cannoise_jax.physics.transfer.shadows import in_shadow
from cannoise_jax.physics.transfer.spatial import shading

ODD = 6.0
"""Robust standard deviations from which a pixel answers light oddly: of a normal law one pixel in 5e8 lies as
far out. Dead pixels, and those under dirt, are no spread of sensitivities."""
DEAD = 0.2
"""Of the light about it, up to which a pixel does not answer: dirt that covers one whole leaves more, for
light comes past it at an angle."""
CLEAR = 6.0
"""Robust standard deviations over the pixels of an average of frames that they have to lie above that."""
_ROUNDS = 8
"""Of the surface that stands for the light, without what bent the one before."""


class Response(NamedTuple):
    """Sensitivities of one channel, relative to its mean light.

    pattern: less the light; light: smooth, 1 on average. keep: pixels that answer as the others do. degree:
    of the surface that stands for the light. square: mean of the squared light over those pixels: the spread
    of sensitivities is that of the pattern over its root, for where there is less light a pixel shows less.
    """

    pattern: Float[np.ndarray, "h w"]
    light: Float[np.ndarray, "h w"]
    keep: Bool[np.ndarray, "h w"]
    degree: int
    square: float
    shadow: Bool[np.ndarray, "h w"]


def response_of(gains: Float[np.ndarray, "h w"], keep: Bool[np.ndarray, "h w"]) -> Response:
    """The response of a channel from its relative signal. keep: pixels that may be used."""
    light, degree = shading(gains, keep)
    used, shadow, before = keep, np.zeros(keep.shape, bool), None
    for _ in range(_ROUNDS if keep.any() else 0):
        apart = gains - light
        shadow = in_shadow(apart, light, keep)
        # A whole line of dead pixels would pass for one that differs, and the lines across it for darker.
        dead = keep & _dead(apart, light, keep)
        live = keep & ~dead
        # Whole rows and columns that differ are a pattern of their own.
        for axis in (1, 0):
            count = np.maximum(live.sum(axis, keepdims=True), 1)
            apart = apart - np.where(live, apart, 0.0).sum(axis, keepdims=True) / count
        used = live & ~shadow & (np.abs(apart) < ODD * max(robust_std(apart[live], 0.0), 1e-9))
        if not used.any():
            break
        light, degree = shading(gains, used)
        odd = shadow | dead
        if not odd.any() or (before is not None and np.array_equal(odd, before)):
            break
        before = odd
    square = float(np.mean(light[used] ** 2)) if used.any() else 1.0
    return Response(gains - light, light, used, degree, square, shadow)


def _dead(
    apart: Float[np.ndarray, "h w"], light: Float[np.ndarray, "h w"], keep: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Pixels that do not answer light; none where noise makes as dark ones."""
    if CLEAR * robust_std(apart[keep], 0.0) > 1 - DEAD:
        return np.zeros(keep.shape, bool)
    return apart < (DEAD - 1) * light
