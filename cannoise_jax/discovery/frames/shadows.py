"""What a flat shows of dust: dark discs and rings, spread over many pixels, at a few places.

They are in the light that falls on the sensor, as the fall-off of the lens is, and change when the camera is
cleaned or the lens is. Left in the pattern they would be taken for the sensitivities of pixels.

The flat divided by its smooth surface is taken apart by an isotropic wavelet transform without decimation
(starlet: Starck and Murtagh, Astronomical Image and Data Analysis, 2006, section 2.3): B3 splines of 2, 4, 8,
16 pixels, details that add up to the image. What pixels do each by themselves lies in the finest details,
which are left out; a texture of the whole frame has the same scatter everywhere. Pixels scatter more where a
lens leaves them dim, and details more at the edges, where pixels count twice as they are mirrored: all is
looked at in units of the scatter at its place. Kept is what stands out: patches with a peak of `_PEAK` robust
standard deviations of their scale and all around it beyond `_EDGE`, unless they reach through a good part of
the frame or are as thin as a piece of a line. At those places all that is coarse counts as light.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from cannoise_jax.physics.robust import local_median, median, robust_std

_PEAK, _EDGE = 5.0, 3.0
"""Robust standard deviations of a scale that a patch has at its peak, and all around it: of normal values one
in 3.5 million lies beyond the first on its side, and one in 740 beyond the second."""
_ROUNDS = 5
"""A deep shadow hides its own edges: what the first round leaves of it is looked at again."""
_SPAN = 0.4
"""Share of the frame along a side from which on a patch is no shadow of a few."""
_THIN = 4.0
"""Length over width from which on a patch is a piece of a line."""
_FAR = 3.0
"""Robust standard deviations from those around it beyond which a pixel counts as no more than that: a bright
or dead pixel is no shadow."""
_LONE = 20.0
"""And beyond which its neighbours count as no more than what is around them either."""
_SCALES = 6
"""Details of 2 to 32 pixels are looked at, those of which four go into half a side of the frame."""
_AROUND = 3
"""Pixels by which a shadow goes on beyond where it stands out."""
_FAR_FROM_EDGES = 256
"""Twice the pixels from an edge from which on no detail reaches it."""
_B3 = (1 / 16, 1 / 4, 3 / 8, 1 / 4, 1 / 16)
"""The cubic B-spline at whole places, by which the starlet smooths."""


def shadows(relative: Float[np.ndarray, "h w"], weight: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """The part of a flat's `relative` residual from its smooth surface that is spread over many pixels at a
    few places; zeros where nothing stands out. weight: inverse variance of the pixels, of any scale."""
    total = _smooth(weight, 1)
    root = np.sqrt(total / np.mean(total))  # in even light it is one
    return _shadows(relative * root, weight, total) / root


def _shadows(
    relative: Float[np.ndarray, "h w"], weight: Float[np.ndarray, "h w"], total: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w"]:
    """Of a residual of one scatter everywhere. total: the smoothed weight."""
    fitted = np.zeros(relative.shape)
    scales = [2**n for n in range(1, _SCALES) if 4 * 2**n < min(relative.shape) / 2]
    if not np.ptp(relative) or not scales:
        return fitted
    limited = _limited(relative)
    seen, edges = {}, _at_edges(relative.shape, tuple(scales))
    level = _smooth(weight * limited, 1) / total
    for scale in scales:
        seen[scale], level = level, _smooth(level, scale)
    parts = {scale: np.zeros(relative.shape) for scale in scales}
    for _ in range(_ROUNDS):
        coarse = _smooth(weight * (limited - fitted), 1) / total
        # Lines are others' to tell, and their pieces are no patches.
        coarse -= median(coarse, 1, keepdims=True)
        coarse -= median(coarse, 0, keepdims=True)
        any_found = False
        for scale in scales:
            smoother = _smooth(coarse, scale)
            found = _standing_out((coarse - smoother) / edges[scale]) * edges[scale]
            any_found |= bool(found.any())
            parts[scale] += found
            coarse = smoother
        if not any_found:
            break
        fitted = np.zeros(relative.shape)
        for scale in reversed(scales):
            # Some scales without the others draw a halo: no shadow goes beyond what is seen of it.
            sure = robust_std(seen[scale], 0)
            low, high = np.minimum(seen[scale], 0) - sure, np.maximum(seen[scale], 0) + sure
            fitted = np.clip(fitted + parts[scale], low, high)
            fitted[np.abs(fitted) <= sure] = 0.0
    return fitted


def places(found: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Where the light is that of shadows that were `found`, with the little that goes on around them."""
    return ndimage.binary_dilation(found != 0, iterations=_AROUND)


def light_at(relative: Float[np.ndarray, "h w"], where: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """What of a flat's `relative` residual is light at the places of shadows, zeros elsewhere: all that is
    coarser than 4 pixels, and of finer details those that stand out from the frame's. Thresholds alone would
    leave a part of each shadow that is everywhere of one sign."""
    fine = _smooth(_limited(relative), 1)
    coarse = _smooth(fine, 2)
    detail = fine - coarse
    standing_out = np.abs(detail) > _EDGE * robust_std(detail[~where], 0)
    return np.where(where, coarse + np.where(standing_out, detail, 0.0), 0.0)


def _limited(relative: np.ndarray) -> Float[np.ndarray, "h w"]:
    """With pixels that are far from those around them brought near, and with those beside the furthest, from
    which charge comes or stays away: four neighbours of a dead pixel, darker by a few per cent, are a cross.
    """
    around = local_median(relative, 5, "edge")
    away = relative - around
    spread = robust_std(away, 0)
    beside = ndimage.binary_dilation(np.abs(away) > _LONE * spread, np.ones((3, 3)))
    return around + np.where(beside, 0.0, np.clip(away, -_FAR * spread, _FAR * spread))


def _smooth(values: np.ndarray, apart: int) -> Float[np.ndarray, "h w"]:
    """Means by the B3 spline with its five points `apart` pixels, edges mirrored."""
    return _down(_down(values, apart).T, apart).T


def _down(values: np.ndarray, apart: int) -> Float[np.ndarray, "h w"]:
    """The same along columns alone."""
    padded, size = np.pad(values, [(2 * apart, 2 * apart), (0, 0)], mode="symmetric"), len(values)
    out = _B3[2] * padded[2 * apart : 2 * apart + size]
    for k in (0, 1):  # the spline is even
        far = (4 - k) * apart
        out += _B3[k] * (padded[k * apart : k * apart + size] + padded[far : far + size])
    return out


@lru_cache(maxsize=1)
def _at_edges(size: tuple[int, int], scales: tuple[int, ...]) -> dict[int, Float[np.ndarray, "h w"]]:
    """By how much more than in the middle of the frame the details of white noise scatter, by scale."""
    down, across = (_squares(n, scales) for n in size)
    out = {}
    for scale, a, b in zip(scales, down, across, strict=True):
        # Both the values and their smoothed ones are products of what is done down and across.
        power = np.einsum("s,sy,sx->yx", np.array([1.0, -2.0, 1.0]), a, b)
        out[scale] = np.sqrt(power / power[size[0] // 2, size[1] // 2])
    return out


def _squares(count: int, scales: tuple[int, ...]) -> list[Float[np.ndarray, "3 n"]]:
    """Along so many pixels, for every scale: mean square of white noise smoothed up to it, of that times what
    it is smoothed to, and of the latter."""
    few = min(count, _FAR_FROM_EDGES)
    noise, out = _down(np.eye(few), 1), []
    for scale in scales:
        smoother = _down(noise, scale)
        found = np.stack(
            [np.sum(x * y, 1) for x, y in ((noise, noise), (noise, smoother), (smoother, smoother))]
        )
        middle = np.repeat(found[:, few // 2 : few // 2 + 1], count - few, 1)
        out.append(np.concatenate([found[:, : few // 2], middle, found[:, few // 2 :]], 1))
        noise = smoother
    return out


def _standing_out(detail: np.ndarray) -> Float[np.ndarray, "h w"]:
    """The patches of the details of one scale that are no chance, zeros elsewhere."""
    away = np.abs(detail)
    spread = robust_std(detail, 0)
    patches, number = ndimage.label(away > _EDGE * spread)
    places, kept = ndimage.find_objects(patches), np.zeros(number + 1, bool)
    for n in np.unique(patches[away > _PEAK * spread]).tolist():
        sides = [s.stop - s.start for s in places[n - 1]]
        small = all(side <= _SPAN * size for side, size in zip(sides, detail.shape, strict=True))
        # A quarter and a ring have wide bounds; a piece of a column is as thin as the spline.
        kept[n] = small and max(sides) < _THIN * min(sides)
    return np.where(kept[patches], detail, 0.0)
