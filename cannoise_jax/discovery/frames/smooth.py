"""The light of a flat: the smooth surface that lens and lamp make, and the shadows of dust in it.

A surface of degree 4 follows a lamp that leans; the fall-off of a lens (cos^4) at a signal of many electrons
leaves more than that, which would be read as sensitivities of rows, columns and pixels. So products of
orthonormal polynomials are added, two degrees at a time, as long as those of the next degrees hold more than
chance: judged against the scatter of the pixels themselves, and, for terms that vary along one axis only,
against the scatter of the means of rows or columns, so that a pattern of columns is not followed. Where any
are added, two degrees more are, for what one flat alone lets pass.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy import ndimage, stats

from cannoise_jax.discovery.frames.contrasts import Stack, robust_mean
from cannoise_jax.discovery.frames.shadows import shadows
from cannoise_jax.physics.robust import robust_std
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.signatures.fields import channel_index, least_squares, surfaces

START, STOP = 4, 16
"""Degree of the surface that is always fitted, and the highest one that is tried."""
_CHANCE = 1e-3
"""Chance with which a step is taken where the light has no more to follow: two terms more or less of
thousands of pixels matter little, so it is not small."""
_AGAIN = 4
"""How often a surface is fitted anew beside shadows."""
_FEW = 0.002
"""Share of the frame below which they do not bend it."""
_FAR = 6.0
"""Robust standard deviations from its neighbours beyond which a pixel counts as no more than that."""


def smooth_mean(stacked: Stack) -> Float[np.ndarray, "h w"]:
    """Mean of a flat without the pattern of the sensor, its smooth surface with the shadows in it, or of a
    dark (a constant per channel), DN."""
    if stacked.recording.kind != "flat":
        return _surface(stacked, _without_lines(stacked))
    surface, shadow = light_of(stacked)
    return surface + (shadow * _above_black(stacked, surface)).astype(np.float32)


def light_of(stacked: Stack) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """The smooth surface of a flat, DN, and what shadows add to its light as a share of it, see `shadows`:
    negative where they are dark.

    A surface bends towards the shadows in it. Where there are any it is fitted again, with them filled by the
    last one, and they are looked for again."""
    mean = _without_lines(stacked)
    surface = _surface(stacked, mean)
    shadow = _shaded(stacked, mean, surface)
    for _ in range(_AGAIN):
        dark = shadow < 0
        if dark.mean() < _FEW:
            break
        for _ in range(2):
            surface = _surface(stacked, np.where(dark, surface, mean).astype(np.float32))
        shadow = _shaded(stacked, mean, surface)
    return surface, shadow


def _surface(stacked: Stack, mean: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """The mean as a surface per channel, of degree 4 or as the light of a flat needs; of a dark as a constant
    per channel; DN."""
    size = mean.shape
    channel = channel_index(size)
    out = np.zeros(size, np.float32)
    degree = START if stacked.recording.kind == "flat" else 0
    for c in range(4):
        chosen = channel == c
        if degree == 0:
            out[chosen] = robust_mean(mean[chosen])
            continue
        basis = surfaces(size, degree, c)
        values = mean[chosen].astype(np.float64)
        kept = np.ones(values.size, bool)
        for _ in range(2):
            beta = least_squares(basis[kept], values[kept])
            rest = values - np.einsum("nk,k->n", basis, beta)
            kept, before = np.abs(rest) < 6 * robust_std(rest, 0) + 1e-6, kept
            if np.array_equal(kept, before):
                break
        fitted = np.einsum("nk,k->n", basis, beta)
        at = SITES[c]
        out[chosen] = fitted
        out[at] += beyond(mean[at] - out[at].astype(np.float64)).astype(np.float32)
    return out


def _shaded(stacked: Stack, mean: np.ndarray, surface: np.ndarray) -> Float[np.ndarray, "h w"]:
    light = _above_black(stacked, surface)
    relative = (mean - surface) / light
    weight = np.zeros(light.shape)
    for at in SITES:
        weight[at] = 1 / max(robust_std(relative[at], 0), 1e-9) ** 2
    return shadows(relative, weight)


def _above_black(stacked: Stack, surface: np.ndarray) -> Float[np.ndarray, "h w"]:
    return np.maximum(surface - stacked.recording.black_map(), 1.0).astype(np.float64)


def _without_lines(stacked: Stack) -> Float[np.ndarray, "h w"]:
    return stacked.mean if stacked.lines is None else stacked.mean - stacked.lines


def beyond(rest: Float[np.ndarray, "h w"], start: int = START, stop: int = STOP) -> Float[np.ndarray, "h w"]:
    """What polynomials of a higher degree than `start` add to a fit of degree `start` that leaves `rest` of a
    site of the mosaic; zeros where they hold no more than chance. Units of `rest`."""
    height, width = rest.shape
    stop = min(stop, height // 4, width // 4)
    spread = robust_std(rest, 0)
    fitted = np.zeros(rest.shape)
    if spread == 0 or stop <= start:
        return fitted
    # What is fitted is smooth, so that the median of what it leaves is that of all less the fit.
    around = ndimage.median_filter(rest, 5, mode="nearest")
    rows, columns = polynomials(height, stop), polynomials(width, stop)
    enough = False
    for degree in range(start, stop, 2):
        limited = around + np.clip(rest - around, -_FAR * spread, _FAR * spread)
        if enough or not _needed(limited, rows, columns, degree, min(degree + 2, stop)):
            if enough or degree == start:
                break
            enough = True  # one step more: what one flat lets pass shows in several together
        # All degrees anew: the fit that left `rest` set aside what it could not follow.
        fitted = _project(limited, rows, columns, -1, min(degree + 2, stop))
        spread = robust_std(rest - fitted, 0)
    return fitted


@lru_cache(maxsize=64)
def polynomials(count: int, degree: int) -> Float[np.ndarray, "n k"]:
    """Orthonormal polynomials of degree 0 to `degree` at `count` even places."""
    at = np.linspace(-1, 1, count)
    return np.linalg.qr(np.polynomial.legendre.legvander(at, degree))[0]


def _project(values, rows, columns, above: int, upto: int) -> Float[np.ndarray, "h w"]:
    """The part of the values in products of a total degree in (above, upto]."""
    inner = rows.T @ values @ columns
    total = np.add.outer(np.arange(len(inner)), np.arange(inner.shape[1]))
    return rows @ np.where((total > above) & (total <= upto), inner, 0.0) @ columns.T


def _needed(values, rows, columns, above: int, upto: int) -> bool:
    """Whether terms of a total degree in (above, upto] hold more than the scatter of what they leave."""
    inner = rows.T @ values @ columns
    i, j = np.indices(inner.shape)
    new = (i + j > above) & (i + j <= upto)
    left = values - _project(values, rows, columns, -1, upto)
    tests = [(inner[new & (i > 0) & (j > 0)], float(np.mean(left**2)), left.size)]
    for lines, chosen in ((left.mean(1), new & (j == 0)), (left.mean(0), new & (i == 0))):
        number = left.size // lines.size
        tests.append((inner[chosen], number * float(np.mean(lines**2)), lines.size - upto - 1))
    chances = [stats.f.sf(np.mean(c**2) / max(v, 1e-300), c.size, max(n, 1)) for c, v, n in tests]
    return bool(min(chances) < _CHANCE / len(chances))
