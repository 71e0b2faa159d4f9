"""A bank of low-order statistics of standardised noise fields, each unit (a contrast between frames, or a
static map) by itself.

Energies are taken in an orthonormal basis: the field is cut into its four parity bands (2 x 2 Haar), and each
band into the tensor product of Haar wavelets of rows and of columns. Every dyadic block, whole rows and
columns, half rows, banks of columns and the whole frame are in it, each for even and odd rows and columns
together and against each other; under white noise every energy is independent of all others. Products of
neighbours are taken once whole rows and columns are out, so that row noise is no correlation of neighbours.
Masked pixels are zero in the fields; `kept` is the share of the others.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import fft

_CELL = 16
"""Pixels of which a side is cropped to a multiple, so that a parity band can be halved three times and
more."""


class Scale(NamedTuple):
    """One group of coefficients along one axis: `length` pixels of a block that is weighed against its
    neighbour; `whole`: the mean along the axis; `degrees`: of freedom."""

    length: int
    whole: bool
    degrees: int


@lru_cache(maxsize=32)
def scales(side: int) -> tuple[Scale, ...]:
    """The scales along an axis of `side` pixels of one parity band, finest first, the whole axis last."""
    out, n = [], side
    while n % 2 == 0:
        n //= 2
        out.append(Scale(2 * side // n // 2, False, n))
    if n > 1:
        out.append(Scale(2 * side // n, False, n - 1))
    return (*out, Scale(2 * side, True, 1))


def cropped_side(side: int) -> int:
    """The side that the bank looks at: a multiple of 16 pixels, of 2 where there are fewer."""
    return side - side % (_CELL if side >= 4 * _CELL else 2)


def _haar(values: Float[np.ndarray, "... n"]) -> list[Float[np.ndarray, "... m"]]:
    """Orthonormal Haar coefficients along the last axis, one array per scale of `scales`."""
    side, out, root = values.shape[-1], [], np.float32(np.sqrt(0.5))
    rest = values
    while rest.shape[-1] % 2 == 0:
        even, odd = rest[..., 0::2], rest[..., 1::2]
        out.append((even - odd) * root)
        rest = (even + odd) * root
    mean = rest.mean(-1, keepdims=True)
    if rest.shape[-1] > 1:
        out.append(rest - mean)
    out.append(mean * np.float32(np.sqrt(rest.shape[-1])))
    assert len(out) == len(scales(side))
    return out


def parity_bands(field: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "4 a b"]:
    """Both parities together, odd against even columns, odd against even rows, and the checkerboard,
    orthonormal; the field cropped to `cropped_side`."""
    h, w = (cropped_side(n) for n in field.shape)
    f = field[:h, :w]
    a, b, c, d = f[0::2, 0::2], f[0::2, 1::2], f[1::2, 0::2], f[1::2, 1::2]
    half = np.float32(0.5)
    return np.stack([(a + b + c + d), (a - b + c - d), (a + b - c - d), (a - b - c + d)]) * half


def energies(field: Float[np.ndarray, "h w"], kept: float = 1.0) -> Float[np.ndarray, "4 i j"]:
    """Mean square of the coefficients of every band at row scale i and column scale j; 1 for white noise."""
    sums = _each_scale(field, lambda part, i, j: np.einsum("bij,bij->b", part, part, dtype=np.float64))
    return sums / (counts(field.shape) * kept)


_SOFT = 0.05
"""Of the mean square, added to squares before their logarithm is taken: codes make zeros."""
_FEW, _AREA = 4, 64
"""Coefficients of a field, and pixels of a block, below which nothing or single pixels are told of."""


@lru_cache(maxsize=32)
def told(size: tuple[int, int]) -> Bool[np.ndarray, "4 i j"]:
    """Which energies `sparsity` is told of: enough coefficients, of blocks that no single pixel makes."""
    count = counts(size)
    return (count >= _FEW) & (count * _AREA <= count.sum())


def sparsity(
    field: Float[np.ndarray, "h w"], mean_square: Float[np.ndarray, "4 i j"], kept: float = 1.0
) -> Float[np.ndarray, "4 i j"]:
    """Mean logarithm of the squares of the coefficients of `energies`, each in units of `mean_square`: less
    than of any normal noise of that mean square where a structure is strong in few places. 0 where it is not
    `told`."""
    unit = np.maximum(mean_square * kept, 1e-9).astype(np.float32)
    asked = told(field.shape)

    def typical(part, i, j):
        if not asked[0, i, j]:
            return np.zeros(4)
        square = part * part / unit[:, i, j, None, None]
        square += np.float32(_SOFT)
        return np.log(square, out=square).mean((1, 2), dtype=np.float64)

    return _each_scale(field, typical)


@lru_cache(maxsize=1)
def sparsity_variance() -> float:
    """Of one coefficient of white noise in `sparsity` about its own mean square, to first order that of
    log(x^2 + s) - b x^2, where b is what the logarithm changes with the unit."""
    at = np.linspace(-8, 8, 16001)
    weight = np.exp(-(at**2) / 2) / np.exp(-(at**2) / 2).sum()
    square = at**2 + _SOFT
    slope = float(weight @ (at**2 / square))
    values = np.log(square) - slope * at**2
    return float(weight @ values**2 - (weight @ values) ** 2)


def _each_scale(field: np.ndarray, of: Callable[[np.ndarray, int, int], np.ndarray]) -> np.ndarray:
    """A number for each band of the coefficients at each row and column scale."""
    bands = parity_bands(field)
    rows, columns = scales(bands.shape[1]), scales(bands.shape[2])
    out = np.zeros((4, len(rows), len(columns)))
    for j, along in enumerate(_haar(bands)):
        for i, part in enumerate(_haar(np.swapaxes(along, 1, 2))):
            out[:, i, j] = of(part, i, j)
    return out


@lru_cache(maxsize=32)
def counts(size: tuple[int, int]) -> Float[np.ndarray, "4 i j"]:
    """Degrees of freedom of every energy."""
    h, w = (cropped_side(n) // 2 for n in size)
    rows, columns = ([s.degrees for s in scales(n)] for n in (h, w))
    out = np.broadcast_to(np.outer(rows, columns).astype(float), (4, len(rows), len(columns)))
    return out


def without_lines(field: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """The field without the means of rows and of columns, those of even and odd pixels by themselves."""
    out = field.copy()
    for y in (0, 1):
        for x in (0, 1):
            part = out[y::2, x::2]
            part -= part.mean(1, keepdims=True)
            part -= part.mean(0, keepdims=True)
    return out


REACH = (16, 64)
"""Rows down and columns across, up to which products of pixels are taken."""
NEAR = (4, 8)
"""Up to which they are told by the parity of the pixels as well."""


@lru_cache(maxsize=4)
def lags(reach: tuple[int, int] = REACH) -> np.ndarray:
    """Every lag (dy, dx) of a half plane within reach, `int[n, 2]`."""
    every = [
        (dy, dx) for dy in range(reach[0] + 1) for dx in range(-reach[1], reach[1] + 1) if dy > 0 or dx > 0
    ]
    return np.array(every)


def products(
    field: Float[np.ndarray, "h w"], kept: float = 1.0, other: np.ndarray | None = None
) -> Float[np.ndarray, "4 n"]:
    """Mean product of pixels at every lag of `lags()`, by the parity of the first pixel (0,0), (0,1), (1,0),
    (1,1); of `field` with `other` where given."""
    h, w = (n - n % 2 for n in field.shape)
    second = field if other is None else other
    size = [fft.next_fast_len(n // 2 + r // 2 + 1, real=True) for n, r in zip((h, w), REACH, strict=True)]

    def spectra(f):
        return [fft.rfft2(f[y:h:2, x:w:2], size) for y in (0, 1) for x in (0, 1)]

    one = spectra(field)
    two = one if other is None else spectra(second)
    at = lags()
    out = np.empty((4, len(at)))
    for p in range(4):
        start = np.array(divmod(p, 2))
        moved = at + start
        parity, step = moved % 2, moved // 2
        for q in range(4):
            mine = (parity[:, 0] * 2 + parity[:, 1]) == q
            if not mine.any():
                continue
            table = fft.irfft2(np.conj(one[p]) * two[q], size)
            out[p, mine] = table[step[mine, 0] % size[0], step[mine, 1] % size[1]]
    pairs = np.maximum((h - at[:, 0]) * (w - np.abs(at[:, 1])) / 4, 1)
    return out / (pairs * kept)


def product_statistics(table: Float[np.ndarray, "4 n"]) -> tuple[np.ndarray, np.ndarray]:
    """The table of `products` as near-orthogonal statistics: the mean over parities at every lag, and three
    differences between parities (columns, rows, checkerboard) at the `NEAR` lags."""
    near = near_lags()
    a, b, c, d = table[:, near] / 4
    return table.mean(0), np.concatenate([a - b + c - d, a + b - c - d, a - b - c + d])


@lru_cache(maxsize=1)
def near_lags() -> np.ndarray:
    """Which of `lags()` are within `NEAR`."""
    at = lags()
    return np.flatnonzero((at[:, 0] <= NEAR[0]) & (np.abs(at[:, 1]) <= NEAR[1]))


def power(field: Float[np.ndarray, "h w"], kept: float = 1.0) -> Float[np.ndarray, "h v"]:
    """Periodogram over a half plane of frequencies, 1 for white noise."""
    transformed = fft.rfft2(field)
    return (transformed.real**2 + transformed.imag**2) / np.float32(field.size * kept)


_ORDERS = 3
"""Cosines along either side by which a statistic may change over the frame: level, slope and bow."""


@lru_cache(maxsize=8)
def smooth(size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Cosines along rows and columns, orders 0 to 2, each of mean square 1."""
    out = []
    for n in size:
        at = (np.arange(n) + 0.5) / n
        out.append(np.stack([np.ones(n)] + [np.sqrt(2) * np.cos(np.pi * k * at) for k in range(1, _ORDERS)]))
    return out[0].astype(np.float32), out[1].astype(np.float32)


MOMENTS = tuple(f"{y},{x}" for y in range(_ORDERS) for x in range(_ORDERS)) + (
    "odd against even columns",
    "odd against even rows",
    "checkerboard",
)
"""Where the moments are taken: cosines of order y, x over the frame, then differences between parities."""


def maps(values: Float[np.ndarray, "h w"], kept: Float[np.ndarray, "h w"] | float) -> np.ndarray:
    """Means of a field over the frame times each of `MOMENTS`."""
    rows, columns = smooth(values.shape)
    share = float(np.mean(kept))
    table = np.einsum("ai,ij,bj->ab", rows, values, columns, optimize=True) / (values.size * share)
    h, w = (n - n % 2 for n in values.shape)
    a, b, c, d = (float(values[y:h:2, x:w:2].mean()) / share for y in (0, 1) for x in (0, 1))
    return np.concatenate([table.ravel(), [(a - b + c - d) / 4, (a + b - c - d) / 4, (a - b - c + d) / 4]])


def map_variance(values: Float[np.ndarray, "h w"], kept: Float[np.ndarray, "h w"] | float) -> np.ndarray:
    """Variance of `maps` of a field whose pixels are independent, of these variances."""
    rows, columns = smooth(values.shape)
    pixels = values.size * float(np.mean(kept))
    table = np.einsum("ai,ij,bj->ab", rows**2, values, columns**2, optimize=True)
    return np.concatenate([table.ravel(), np.full(3, values.sum())]) / pixels**2


def hermite(z: Float[np.ndarray, "h w"], kept: np.ndarray) -> Float[np.ndarray, "3 k"]:
    """Second, third and fourth Hermite polynomial of the values (excess of variance, skewness, kurtosis),
    as `maps`; masked pixels count nothing."""
    square = z * z
    return np.stack(
        [
            maps((square - 1) * kept, kept),
            maps((square - 3) * z * kept, kept),
            maps(((square - 6) * square + 3) * kept, kept),
        ]
    )
