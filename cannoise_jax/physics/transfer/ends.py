"""The ends of the codes of a recording: where values pile up, and pixels that are there in every frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.recordings.packing import site

_AWAY = 8.0
"""Robust standard deviations of the pixels of a frame, and codes, that an end has to lie from their level for
a pixel that is always there to be stuck: one of a level near 0, or of light near white, may be ordinary."""
_MOST = 0.5
"""Share of the pixels of a channel up to which those at an end are stuck, or masked, and not its level."""


class Extremes(NamedTuple):
    """The lowest and the highest code of every pixel over all frames."""

    low: Float[np.ndarray, "H W"]
    high: Float[np.ndarray, "H W"]


def stuck_pixels(frame: Float[np.ndarray, "H W"], seen: Extremes, step: float) -> Bool[np.ndarray, "H W"]:
    """Pixels that in every frame are at the lowest code of their channel, or at the highest, far from the
    level of the others: defects and masked columns, of which no level is known. frame: any one of them."""
    out = np.zeros(frame.shape, bool)
    for c in range(4):
        low, high, values = site(seen.low, c), site(seen.high, c), site(frame, c)
        middle = float(median(values))
        room = _AWAY * (robust_std(values, middle) + step)
        for end, beyond in ((low.min(), middle - low.min()), (high.max(), high.max() - middle)):
            there = (low == end) & (high == end)
            if beyond > room and there.mean() <= _MOST:
                site(out, c)[...] |= there
    return out


def without_stuck(
    rows: Float[np.ndarray, "T H 2"], columns: Float[np.ndarray, "T 2 W"],
    frame: Float[np.ndarray, "H W"], stuck: Bool[np.ndarray, "H W"],
) -> tuple[Float[np.ndarray, "T H 2"], Float[np.ndarray, "T 2 W"]]:  # fmt: skip
    """Means of rows and columns without stuck pixels, whose values in every frame are those of `frame`; lines
    of nothing else have the mean of the others."""
    rows, columns = rows.copy(), columns.copy()
    for c in range(4):
        y, x = divmod(c, 2)
        held, values = site(stuck, c), np.where(site(stuck, c), site(frame, c), 0.0)
        rows[:, y::2, x] = _means_of_others(rows[:, y::2, x], held.sum(1), values.sum(1), held.shape[1])
        columns[:, y, x::2] = _means_of_others(columns[:, y, x::2], held.sum(0), values.sum(0), held.shape[0])
    return rows, columns


def _means_of_others(
    means: Float[np.ndarray, "T n"], number: np.ndarray, total: np.ndarray, count: int
) -> Float[np.ndarray, "T n"]:
    left = count - number
    out = (means * count - total) / np.maximum(left, 1)
    return np.where(left > 0, out, (out * left).sum(1, keepdims=True) / left.sum())


def rails(histogram: np.ndarray, step: float, white_level: float) -> tuple[float, float]:
    """Codes at which values pile up at the bottom and top of one channel's histogram, nan where none do.

    A pile-up: the end code holds at least 20 values and four times as many as any of the three codes next to
    it on the lattice of `step`, and of the three that occur, which a table may put far apart. The white level
    counts as the top whenever a value reaches it.
    """
    codes = np.flatnonzero(histogram)
    if not len(codes):
        return np.nan, np.nan

    def piled(end: int, direction: int) -> bool:
        near = end + direction * step * np.arange(1, 4)
        near = near[(near >= 0) & (near < len(histogram))].astype(int)
        near = np.concatenate([near, codes[::direction][1:4]])
        return histogram[end] >= 20 and histogram[end] > 4 * histogram[near].max(initial=0)

    low = float(codes[0]) if piled(codes[0], 1) else np.nan
    high = float(codes[-1]) if piled(codes[-1], -1) else np.nan
    if codes[-1] >= white_level:
        high = min(float(white_level), high) if np.isfinite(high) else float(white_level)
    return low, high


def lowest_share(histogram: np.ndarray, low: float, dead: int) -> float:
    """Share of the values at code 0, or at `low`; dead: values 0 of pixels that are never anything else."""
    end = 0 if np.isnan(low) else int(low)
    dead = dead if end == 0 else 0
    return float((histogram[end] - dead) / max(histogram.sum() - dead, 1))
