"""Fixed patterns of one channel by rows, columns and pixels: the split of EMVA 1288 release 4.0.

The standard takes from the variance of row means only what white temporal noise leaves in them. Temporal row
noise leaves far more (its variance over the number of frames), which would pass for a fixed row pattern, so
it is measured from the frames and taken out as well; the same for columns.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.polynomial import legendre
from scipy import stats

from cannoise_jax.physics.transfer.estimate import Estimate, heavy_dof, variance_difference

SHADING_DEGREES = (4, 6, 8)
"""Of the polynomial surface that stands for smooth shading, 15, 28 or 45 terms: the lowest that the next does
not surely improve on. A lens that leaves a quarter of the light in the corners needs 6: with 4 what is left
of it adds 30 % to a pattern of 0.6 %."""
_GRID = 16
"""Cells along a side through whose means the shading is fitted: 256."""
_BY_CHANCE = 1e-3
"""Chance of as much improvement by noise alone, below which a surface of more terms is taken."""


class Split(NamedTuple):
    """Spatial variances: of the whole pattern and of its row, column and pixel parts (total is their sum)."""

    total: Estimate
    row: Estimate
    column: Estimate
    pixel: Estimate


@dataclass(frozen=True)
class TemporalParts:
    """Temporal variances over frames: of a pixel, and of the row and column means as they were recorded
    (whatever whole rows or columns do, plus the share that white noise leaves), with degrees of freedom."""

    pixel: float
    pixel_dof: float
    row_mean: float
    row_dof: float
    column_mean: float
    column_dof: float
    frames: int


def temporal_mean_square(
    means: Float[np.ndarray, "T n"], turns: int = 1, degree: int = 0
) -> tuple[float, float]:
    """Temporal mean square of row (or column) means over frames, and its degrees of freedom. degree: of the
    polynomials of each frame that are no part of it, as of a light that leans to another side.

    What a frame does as a whole is taken out, and with turns = 2 what its even and its odd lines do: lines
    across them that are read apart leave their mean there. Neighbours may be correlated, and values
    heavy-tailed: both reduce the degrees of freedom.
    """
    frames, count = means.shape
    rest = means - means.mean(0)
    for k in range(turns):
        rest[:, k::turns] -= rest[:, k::turns].mean(1, keepdims=True)
    degree = min(degree, count - turns - 1)
    if degree > 0:
        smooth = np.linalg.qr(legendre.legvander(np.linspace(-1, 1, count), degree))[0][:, 1:]
        rest -= rest @ smooth @ smooth.T
    plain = (frames - 1) * (count - turns - degree)
    square = float(np.sum(rest**2) / plain)
    if square <= 0:
        return 0.0, float(plain)
    return square, heavy_dof(rest, plain) / correlation_loss(rest)


def correlation_loss(rest: Float[np.ndarray, "T n"], lags: int = 8) -> float:
    """1 + 2 sum of squared autocorrelations along the last axis: by how much correlation thins out degrees
    of freedom of a mean square. Lags whose correlation is within its noise do not count."""
    power = np.mean(rest**2)
    if power <= 0:
        return 1.0
    loss = 1.0
    for lag in range(1, min(lags, rest.shape[1] - 2) + 1):
        rho = np.mean(rest[:, :-lag] * rest[:, lag:]) / power
        error = 1 / np.sqrt(rest[:, lag:].size)
        loss += 2 * max(rho**2 - 4 * error**2, 0.0)
    return float(loss)


def spatial_split(
    pattern: Float[np.ndarray, "h w"],
    keep: Bool[np.ndarray, "h w"],
    temporal: TemporalParts,
    turns: int = 1,
) -> Split:
    """Fixed-pattern variances of an average of frames, whose mean may be anything.

    keep: the pixels to use; the others are filled with their row and column means, and not counted, nor are
    lines of nothing else. turns: of columns (and rows) that have row (and column) means of their own, which
    are not the pixels'.
    """
    centre = pattern[keep].mean() if keep.any() else 0.0
    offsets = np.where(keep, pattern - centre, 0.0)
    in_row, in_column = (keep.sum(axis, keepdims=True) for axis in (1, 0))
    rows = offsets.sum(1, keepdims=True) / np.maximum(in_row, 1)
    columns = offsets.sum(0, keepdims=True) / np.maximum(in_column, 1)
    rest = np.where(keep, pattern - centre - rows - columns, 0.0)
    for k in range(turns if turns > 1 else 0):
        for axis, part in ((1, np.s_[:, k::turns]), (0, np.s_[k::turns])):
            number = np.maximum(keep[part].sum(axis, keepdims=True), 1)
            rest[part] -= np.where(keep[part], rest[part].sum(axis, keepdims=True) / number, 0.0)
    lines = turns * int((in_row > 0).sum() + (in_column > 0).sum())
    inner = max(int(keep.sum()) - lines + turns**2, 1)
    interaction = float(np.sum(rest**2) / inner)
    frames = temporal.frames
    inner_dof = heavy_dof(rest[keep], inner)
    pixel = variance_difference(interaction, inner_dof, temporal.pixel / frames, temporal.pixel_dof)

    def of_lines(means: np.ndarray, across: np.ndarray, whole: float, dof: float) -> Estimate:
        # Row means hold the fixed row pattern, temporal row noise / T, and the pixels' fixed pattern / W.
        means, across = (means[across > 0], across[across > 0]) if (across > 0).sum() > 1 else (means, across)
        frozen = max(interaction - temporal.pixel / frames, 0.0) * float(np.mean(1 / np.maximum(across, 1)))
        first_dof = heavy_dof(means, means.size - 1) / correlation_loss(means.reshape(1, -1))
        return variance_difference(
            means.var(ddof=1), max(first_dof, 2.0), whole / frames + frozen, max(dof, 2.0)
        )

    row = of_lines(rows, in_row, temporal.row_mean, temporal.row_dof)
    column = of_lines(columns, in_column, temporal.column_mean, temporal.column_dof)
    return Split(total_of(row, column, pixel), row, column, pixel)


def total_of(*parts: Estimate) -> Estimate:
    """The sum of independent estimates; the sides of their intervals add in square."""
    value = sum(p.value for p in parts)
    low, high = (float(np.sqrt(sum((p.ci90[side] - p.value) ** 2 for p in parts))) for side in (0, 1))
    return Estimate(value, float(np.sqrt(sum(p.stderr**2 for p in parts))), (value - low, value + high))


class Shading(NamedTuple):
    """The smooth part of a flat field, and the degree of its polynomial surface."""

    surface: Float[np.ndarray, "h w"]
    degree: int


def shading(pattern: Float[np.ndarray, "h w"], keep: Bool[np.ndarray, "h w"] | None = None) -> Shading:
    """A polynomial surface fitted to the means of a grid of blocks. keep: the pixels that count; by default
    all."""
    used = np.ones(pattern.shape, bool) if keep is None else keep
    edges = [np.linspace(0, n, min(_GRID, n // 2) + 1).astype(int) for n in pattern.shape]

    def blocks(values: np.ndarray) -> np.ndarray:
        return np.add.reduceat(np.add.reduceat(values, edges[0][:-1], 0), edges[1][:-1], 1).ravel()

    counts = blocks(used.astype(np.float64))
    means = blocks(np.where(used, pattern, 0.0)) / np.maximum(counts, 1)
    weight = np.sqrt(counts)
    every = [legendre.legvander(np.linspace(-1, 1, n), SHADING_DEGREES[-1]) for n in pattern.shape]
    y, x = (np.add.reduceat(v, e[:-1], 0) / np.diff(e)[:, None] for v, e in zip(every, edges, strict=True))

    def fitted(degree: int) -> tuple[np.ndarray, float]:
        terms = _terms(degree)
        design = np.stack([np.outer(y[:, i], x[:, j]).ravel() for i, j in terms], -1) * weight[:, None]
        found, *_ = np.linalg.lstsq(design, means * weight, rcond=None)
        return found, float(np.sum((means * weight - design @ found) ** 2))

    degree, cells = SHADING_DEGREES[0], int(np.sum(counts > 0))
    found, rest = fitted(degree)
    for higher in SHADING_DEGREES[1:]:
        more, left = len(_terms(higher)) - len(_terms(degree)), cells - len(_terms(higher))
        if left < len(_terms(higher)):
            break
        better, smaller = fitted(higher)
        if stats.f.sf((rest - smaller) / more / max(smaller / left, 1e-30), more, left) > _BY_CHANCE:
            break
        degree, found, rest = higher, better, smaller
    grid = np.zeros((degree + 1, degree + 1))
    for (i, j), value in zip(_terms(degree), found, strict=True):
        grid[i, j] = value
    return Shading(every[0][:, : degree + 1] @ grid @ every[1][:, : degree + 1].T, degree)


def _terms(degree: int) -> list[tuple[int, int]]:
    """Degrees down and across of the terms of a surface."""
    return [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
