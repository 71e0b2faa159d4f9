"""The light of a flat: the smooth surface that lens and lamp make, and the shadows of dust in it.

A surface of degree 4 follows a lamp that leans; the fall-off of a lens (cos^4) at a signal of many electrons
leaves more than that, which would be read as sensitivities of rows, columns and pixels. So products of
orthonormal polynomials are added, two degrees at a time, as long as those of the next degrees hold more than
chance: judged against the scatter of the pixels themselves, and, for terms that vary along one axis only,
against the scatter of the means of rows or columns, so that a pattern of columns is not followed. Where any
are added, two degrees more are, for what one flat alone lets pass.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float
from scipy import special

from cannoise_jax.discovery.frames.contrasts import Stack, robust_mean
from cannoise_jax.discovery.frames.shadows import light_at
from cannoise_jax.physics.robust import local_median, robust_std
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.signatures.fields import legendre

START, STOP = 4, 16
"""Degree of the surface that is always fitted, and the highest one that is tried."""
_CHANCE = 1e-3
"""Chance with which a step is taken where the light has no more to follow: two terms more or less of
thousands of pixels matter little, so it is not small."""
_FAR = 6.0
"""Robust standard deviations from its neighbours beyond which a pixel counts as no more than that."""
_STEPS, _SMALL = 30, 1e-3
"""Of a fit beside dust: the most steps, and the share of what is left at first at which they end."""


def smooth_mean(stacked: Stack) -> Float[np.ndarray, "h w"]:
    """Mean of a flat without the pattern of the sensor, its smooth surface with the shadows in it, or of a
    dark (a constant per channel), DN."""
    if stacked.light is not None:
        return stacked.light
    if stacked.recording.kind != "flat":
        return surface_of(stacked)
    surface, shadow = light_of(stacked)
    return surface + (shadow * above_black(stacked, surface)).astype(np.float32)


def light_of(stacked: Stack) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """The smooth surface of a flat, DN, and what the shadows at `Stack.dust` add to its light as a share of
    it: negative where they are dark."""
    surface = surface_of(stacked, stacked.dust)
    if stacked.dust is None:
        return surface, np.zeros(surface.shape)
    return surface, light_at(relative(stacked, surface), stacked.dust)


def shades(stacks: Sequence[Stack]) -> dict[int, Float[np.ndarray, "h w"]]:
    """By number of the recording, what shadows add to the light of flats that hold some, as a share of it."""
    return {s.number: light_of(s)[1] for s in stacks if s.dust is not None and s.dust.any()}


def relative(stacked: Stack, surface: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """What of a flat is not its smooth surface, DN, as a share of its light."""
    return (without_lines(stacked) - surface) / above_black(stacked, surface)


def surface_of(stacked: Stack, dust: Bool[np.ndarray, "h w"] | None = None) -> Float[np.ndarray, "h w"]:
    """The mean as a surface per channel, of degree 4 or as the light of a flat needs; of a dark as a constant
    per channel; DN. dust: places that are left out, None: none."""
    mean = without_lines(stacked)
    size = mean.shape
    out = np.zeros(size, np.float32)
    degree = START if stacked.recording.kind == "flat" else 0
    for c, at in enumerate(SITES):
        if degree == 0:
            out[at] = robust_mean(mean[at])
            continue
        values = mean[at].astype(np.float64)
        clear = None if dust is None else ~dust[at]
        looked = np.ones(values.shape, bool) if clear is None else clear
        kept, terms = looked, legendre(size, degree, c)
        for _ in range(2):
            fitted = _least_squares(values, kept, *terms)
            rest = values - fitted
            kept, before = looked & (np.abs(rest) < 6 * robust_std(rest[looked], 0) + 1e-6), kept
            if np.array_equal(kept, before):
                break
        out[at] = fitted
        out[at] += beyond(values - out[at].astype(np.float64), clear=clear).astype(np.float32)
    return out


def _least_squares(values, kept, rows, columns) -> Float[np.ndarray, "h w"]:
    """Least squares of the `kept` values by products of polynomials of rows [h, d + 1] and columns [w, d + 1]
    up to a total degree d, at all places. All sums run over the rows first and over the columns then, which
    makes them a few products of matrices."""
    degree = rows.shape[1] - 1
    i, j = np.nonzero(np.add.outer(np.arange(degree + 1), np.arange(degree + 1)) <= degree)
    pairs = [(a[:, :, None] * a[:, None]).reshape(len(a), -1) for a in (rows, columns)]
    products = (pairs[0].T @ kept.astype(np.float64) @ pairs[1]).reshape((degree + 1,) * 4)
    normal = products[i[:, None], i, j[:, None], j]
    inner = np.zeros((degree + 1, degree + 1))
    told = rows.T @ np.where(kept, values, 0.0) @ columns
    inner[i, j] = np.linalg.lstsq(normal, told[i, j], rcond=None)[0]
    return rows @ inner @ columns.T


def above_black(stacked: Stack, surface: np.ndarray) -> Float[np.ndarray, "h w"]:
    """The light of a surface, DN, no less than one."""
    return np.maximum(surface - stacked.recording.black_map(), 1.0).astype(np.float64)


def without_lines(stacked: Stack) -> Float[np.ndarray, "h w"]:
    return stacked.mean if stacked.lines is None else stacked.mean - stacked.lines


def beyond(
    rest: Float[np.ndarray, "h w"],
    start: int = START,
    stop: int = STOP,
    clear: Bool[np.ndarray, "h w"] | None = None,
) -> Float[np.ndarray, "h w"]:
    """What polynomials of a higher degree than `start` add to a fit of degree `start` that leaves `rest` of a
    site of the mosaic; zeros where they hold no more than chance. Units of `rest`. clear: pixels that are
    looked at, None: all."""
    height, width = rest.shape
    stop = min(stop, height // 4, width // 4)
    spread = robust_std(rest if clear is None else rest[clear], 0)
    fitted = np.zeros(rest.shape)
    if spread == 0 or stop <= start:
        return fitted
    # What is fitted is smooth, so that the median of what it leaves is that of all less the fit.
    around = local_median(rest, 5, "edge")
    rows, columns = polynomials(height, stop), polynomials(width, stop)
    enough = False
    for degree in range(start, stop, 2):
        limited = around + np.clip(rest - around, -_FAR * spread, _FAR * spread)
        filled = limited if clear is None else np.where(clear, limited, fitted)
        if enough or not _needed(filled, rows, columns, degree, min(degree + 2, stop)):
            if enough or degree == start:
                break
            enough = True  # one step more: what one flat lets pass shows in several together
        # All degrees anew: the fit that left `rest` set aside what it could not follow.
        fitted = _fit(filled, rows, columns, min(degree + 2, stop), clear)
        spread = robust_std(rest - fitted if clear is None else (rest - fitted)[clear], 0)
    return fitted


@lru_cache(maxsize=64)
def polynomials(count: int, degree: int) -> Float[np.ndarray, "n k"]:
    """Orthonormal polynomials of degree 0 to `degree` at `count` even places."""
    at = np.linspace(-1, 1, count)
    return np.linalg.qr(np.polynomial.legendre.legvander(at, degree))[0]


def _fit(values, rows, columns, upto: int, clear: np.ndarray | None) -> Float[np.ndarray, "h w"]:
    """Least squares by products of a total degree up to `upto`, of the `clear` pixels alone (None: all)."""
    if clear is None:
        return _project(values, rows, columns, -1, upto)
    # What the fit leaves of the clear pixels is brought down by conjugate gradients (Hestenes and Stiefel,
    # 1952), from what the values already hold elsewhere: a few steps leave alone what only those places hold.
    fitted = _project(values, rows, columns, -1, upto)
    left = _project(np.where(clear, values - fitted, 0.0), rows, columns, -1, upto)
    direction, power = left, float(np.sum(left**2))
    least = _SMALL**2 * max(power, 1e-300)
    for _ in range(_STEPS):
        if power <= least:
            break
        seen = _project(np.where(clear, direction, 0.0), rows, columns, -1, upto)
        step = power / float(np.sum(direction * seen))
        fitted, left = fitted + step * direction, left - step * seen
        power, before = float(np.sum(left**2)), power
        direction = left + power / before * direction
    return fitted


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
    chances = [special.fdtrc(c.size, max(n, 1), np.mean(c**2) / max(v, 1e-300)) for c, v, n in tests]
    return bool(min(chances) < _CHANCE / len(chances))
