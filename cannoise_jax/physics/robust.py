"""What a few far values do not move: the spread of values, and the median of what lies around each."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

OF_MEDIAN = 1.4826
"""Standard deviation of a normal law in units of the median of the distances from its centre: one over its
quantile of 3/4, 0.6745."""
NOISE_OF_MEDIAN = 1.57
"""Variance of a median of normal values over that of their mean: pi / 2 of many."""
_PIXELS = 1 << 14
"""Pixels that are worked on at once: so many, of all values held, stay near the processor."""


def median(values: Any, axis: int | None = None, *, keepdims: bool = False) -> Any:
    """Median along an axis (None: of all values), bit for bit that of `numpy.median`, which takes five to
    nine times as long: NumPy has vector instructions to order values about one place, and its median asks
    for several. Of what is no number, or of none, it is NumPy's own. axis: one, not several."""
    values = np.asarray(values)
    if not values.size or values.dtype.kind not in "fiu":
        return np.median(values, axis, keepdims=keepdims)
    along = values.reshape(-1) if axis is None else np.moveaxis(values, axis, -1)
    middle, odd = divmod(along.shape[-1], 2)
    ordered = np.partition(along, middle, -1)
    pair = [ordered[..., middle]] if odd else [ordered[..., :middle].max(-1), ordered[..., middle]]
    out = np.mean(pair, axis=0)
    if values.dtype.kind == "f":  # what is not a number is ordered last, and makes the median none
        out = np.where(np.isnan(ordered[..., middle:].max(-1)), out.dtype.type(np.nan), out)[()]
    if not keepdims:
        return out
    return np.expand_dims(out, tuple(range(values.ndim)) if axis is None else axis)


def robust_std(values: Float[np.ndarray, "..."], centre: float | None = None) -> float:
    """Standard deviation of the bulk of `values`, in their units, from the median of their distances to
    `centre`, by default to their own median."""
    return OF_MEDIAN * float(median(np.abs(values - (median(values) if centre is None else centre))))


def local_median(
    values: Float[np.ndarray, "h w"], size: int, mode: str = "symmetric"
) -> Float[np.ndarray, "h w"]:
    """Median of the `size` x `size` values around every one, odd and at least 3. mode: what lies beyond
    the edges, as numpy.pad has it.

    Of n values the median is left over when of any n // 2 + 2 of them the least and the largest are put
    aside, one of the others takes their place, and so on: neither of the two can be it. Done with whole rows
    at a time that is some hundred minima and maxima of arrays, several times faster than ordering the values
    around every pixel.
    """
    padded = np.pad(values, size // 2, mode=mode)  # type: ignore[call-overload]
    height, width = values.shape
    out = np.empty_like(values)
    rows = max(_PIXELS // max(width, 1), 1)
    for start in range(0, height, rows):
        part = out[start : start + rows]
        number = len(part)
        around = (
            padded[start + i : start + i + number, j : j + width] for i in range(size) for j in range(size)
        )
        part[...] = _median(list(around))
    return out


def _median(values: list[np.ndarray]) -> np.ndarray:
    """The median of an odd number of arrays, place by place."""
    held = len(values) // 2 + 2
    kept, others = [v.copy() for v in values[:held]], values[held:]
    spare = np.empty_like(kept[0])
    for other in others:
        _to_the_ends(kept, spare)
        spare, kept = kept[0], kept[1:]  # of what is put aside one array is written anew
        kept[-1][...] = other
    _to_the_ends(kept, spare)
    return kept[1]


def _to_the_ends(values: list[np.ndarray], spare: np.ndarray) -> None:
    """Orders the arrays in place so that the first has the least and the last the largest value."""

    def order(a: np.ndarray, b: np.ndarray) -> None:
        np.minimum(a, b, out=spare)
        np.maximum(a, b, out=b)
        a[...] = spare

    number = len(values)
    for n in range(number // 2):
        order(values[n], values[number - 1 - n])
    for n in range(1, (number + 1) // 2):
        order(values[0], values[n])
    for n in range(number // 2, number - 1):
        order(values[n], values[-1])
