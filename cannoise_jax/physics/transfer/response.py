"""The relative sensitivities of the pixels of a flat, beside its smooth light."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from cannoise_jax.physics.robust import robust_std
from cannoise_jax.physics.transfer.spatial import shading

ODD = 6.0
"""Robust standard deviations from which a pixel answers light oddly: of a normal law one pixel in 5e8 lies as
far out. Dead pixels, and those under dirt, are no spread of sensitivities."""


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


def response_of(gains: Float[np.ndarray, "h w"], keep: Bool[np.ndarray, "h w"]) -> Response:
    """The response of a channel from its relative signal. keep: pixels that may be used."""
    first = shading(gains, keep)
    apart = gains - first.surface
    # Whole rows and columns that differ are a pattern of their own.
    for axis in (1, 0):
        count = np.maximum(keep.sum(axis, keepdims=True), 1)
        apart = apart - np.where(keep, apart, 0.0).sum(axis, keepdims=True) / count
    used = keep
    if keep.any():
        used = keep & (np.abs(apart) < ODD * max(robust_std(apart[keep], 0.0), 1e-9))
    light, degree = shading(gains, used) if used.any() else first
    square = float(np.mean(light[used] ** 2)) if used.any() else 1.0
    return Response(gains - light, light, used, degree, square)
