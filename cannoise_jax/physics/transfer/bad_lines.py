"""Columns and rows, or long parts of them, that lie far from their neighbours: hot ones, and such that lose
charge.

Every CCD has some. They are defects, as hot pixels are, and none of a population of lines that differ. What
is said here of columns holds for rows, which are columns of the frame turned over.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.recordings.metadata import chunks
from cannoise_jax.recordings.packing import site

_BLOCK = 8
"""Rows of one mosaic site whose median tells the level of a column there: dust and hot pixels leave it."""
_ABOUT = 9
"""Columns of one site whose median is the level about one: as wide as what shading leaves alike."""
_FAR = 12.0
"""Robust standard deviations of all columns: of a normal law none lies as far out, nor does one of any camera
that was tried."""
_EDGE = 0.5
"""Of how far a column lies from both sides, by which these differ at most: at the edge of a shadow, or of a
part without light, they differ by more."""
_LEAST_BLOCKS, _LEAST_PART = 3, 0.25
"""Length of a defect, in blocks, and of the height: that of dust is less."""
_WIDEST = 2
"""Columns of one site beside each other: a broader one is another part of the sensor, or a shadow."""
_MOST = 0.03
"""Share of the pixels beyond which they are no few outliers."""
_DEAD = 0.2
"""Of the light about it, up to which a column does not answer: pixels that are dead are told as such."""


class BadLines(NamedTuple):
    """Pixels of bad columns and of bad rows."""

    columns: Bool[np.ndarray, "H W"]
    rows: Bool[np.ndarray, "H W"]

    @property
    def pixels(self) -> Bool[np.ndarray, "H W"]:
        return self.columns | self.rows


def bad_lines(
    mean: Float[np.ndarray, "H W"],
    least: float,
    black: Float[np.ndarray, "4"] | None,
    stuck: Bool[np.ndarray, "H W"],
) -> BadLines | None:
    """Bad columns and rows in an average of frames, without stuck pixels; None where there are none. least:
    temporal noise of a usual pixel, or a code, DN: a line that lies less far from its neighbours moves
    nothing. black: level of a flat, whose dead lines are left."""
    turned = None if black is None else black[[0, 2, 1, 3]]  # channels of the frame turned over
    columns, rows = (
        found & ~stuck if (found & ~stuck).mean() <= _MOST else np.zeros(mean.shape, bool)
        for found in (_columns(mean, least, black), _columns(mean.T, least, turned).T)
    )
    return BadLines(columns, rows) if (columns | rows).any() else None


def _columns(
    mean: Float[np.ndarray, "H W"], least: float, black: Float[np.ndarray, "4"] | None
) -> Bool[np.ndarray, "H W"]:
    out = np.zeros(mean.shape, bool)
    for c in range(4):
        values = site(mean, c)
        height, width = values.shape
        count = height // _BLOCK
        if count < _LEAST_BLOCKS or width < 2 * _ABOUT:
            continue
        edges = np.linspace(0, height, count + 1).astype(int)
        level = np.stack([median(values[a:b], axis=0) for a, b in zip(edges[:-1], edges[1:], strict=True)])
        left, right = _beside(level)
        about = (left + right) / 2
        apart = level - about
        odd = np.abs(apart) > max(_FAR * robust_std(apart, 0.0), least)
        odd &= np.abs(left - right) < _EDGE * np.abs(apart)
        if black is not None:
            odd &= level - black[c] > _DEAD * (about - black[c])
        odd &= ~ndimage.binary_opening(odd, np.ones((1, _WIDEST + 1), bool))
        long = max(_LEAST_BLOCKS, int(np.ceil(_LEAST_PART * count)))
        odd = ndimage.binary_opening(odd, np.ones((long, 1), bool))
        if odd.any():
            odd = ndimage.binary_dilation(odd, np.ones((3, 1), bool))  # a part of the next block is bad too
            site(out, c)[...] = np.repeat(odd, np.diff(edges), axis=0)
    return out


def _beside(level: Float[np.ndarray, "h w"]) -> tuple[np.ndarray, np.ndarray]:
    """The medians of the columns to the left and to the right of each; beyond the first and the last ones a
    straight line through those inside stands."""
    half, width = _ABOUT // 2, level.shape[1]
    of_four = median(np.lib.stride_tricks.sliding_window_view(level, half, axis=1), axis=-1)
    left, right = np.empty(level.shape), np.empty(level.shape)
    left[:, half:], right[:, : width - half] = of_four[:, : width - half], of_four[:, 1:]
    left[:, :half] = 2 * right[:, :half] - of_four[:, half + 1 : 2 * half + 1]
    right[:, width - half :] = 2 * left[:, width - half :] - of_four[:, -2 * half - 1 : -half - 1]
    return left, right


def line_means_without(
    frames: Any, out: Bool[np.ndarray, "H W"], chunk_bytes: int
) -> tuple[Float[np.ndarray, "T H 2"], Float[np.ndarray, "T 2 W"]]:
    """Means of the rows and of the columns of every frame, as `FrameStatistics` has them, without some
    pixels; lines of nothing else have the mean of the others."""
    rows, columns, weight = [], [], (~out).astype(np.float64)
    across = np.stack([weight[:, p::2].sum(-1) for p in (0, 1)], -1)
    down = np.stack([weight[p::2].sum(0) for p in (0, 1)])
    for part in chunks(frames, chunk_bytes):
        values = part.astype(np.float64) * weight
        rows.append(np.stack([values[..., p::2].sum(-1) for p in (0, 1)], -1) / np.maximum(across, 1))
        columns.append(np.stack([values[:, p::2].sum(1) for p in (0, 1)], 1) / np.maximum(down, 1))
    of_rows, of_columns = np.concatenate(rows), np.concatenate(columns)
    for c in range(4):
        y, x = divmod(c, 2)
        of_rows[:, y::2, x] = _filled(of_rows[:, y::2, x], across[y::2, x])
        of_columns[:, y, x::2] = _filled(of_columns[:, y, x::2], down[y, x::2])
    return of_rows, of_columns


def _filled(means: Float[np.ndarray, "T n"], counts: Float[np.ndarray, "n"]) -> Float[np.ndarray, "T n"]:
    usual = (means * counts).sum(1, keepdims=True) / max(float(counts.sum()), 1.0)
    return np.where(counts > 0, means, usual)


class BadLine(NamedTuple):
    """A bad column or row, or a part of it, counted from 1, and how far it lies from its neighbours, DN and
    as a share of what those have."""

    line: int
    part: tuple[int, int]
    apart: float
    ratio: float


def told(mean: Float[np.ndarray, "H W"], bad: Bool[np.ndarray, "H W"], black: float) -> tuple[BadLine, ...]:
    """What bad columns are like in an average of frames, from left to right."""
    found = []
    for x in np.flatnonzero(bad.any(0)):
        rows = np.flatnonzero(bad[:, x])
        beside = [v for k in range(2, _ABOUT, 2) for v in (x - k, x + k) if 0 <= v < mean.shape[1]]
        others = [mean[rows, v] for v in beside if not bad[rows, v].any()]
        usual = float(median(others)) if others else float(median(mean))
        own = float(median(mean[rows, x]))
        ratio = (own - black) / max(usual - black, 1e-9)
        found.append(BadLine(int(x) + 1, (int(rows[0]) + 1, int(rows[-1]) + 1), own - usual, ratio))
    return tuple(found)
