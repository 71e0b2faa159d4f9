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

from cannoise_jax.physics.transfer.estimate import Estimate, heavy_dof, variance_difference

SHADING_DEGREE = 4
"""Of the polynomial surface that stands for smooth shading, 15 terms."""
_GRID = 16
"""Cells along a side through whose means the shading is fitted: 256, for 15 terms."""


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


def temporal_mean_square(means: Float[np.ndarray, "T n"]) -> tuple[float, float]:
    """Temporal mean square of row (or column) means over frames, and its degrees of freedom.

    What a frame does as a whole is taken out. Neighbours may be correlated, and values heavy-tailed: both
    reduce the degrees of freedom.
    """
    frames, count = means.shape
    rest = means - means.mean(0)
    rest = rest - rest.mean(1, keepdims=True)
    plain = (frames - 1) * (count - 1)
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
    pattern: Float[np.ndarray, "h w"], keep: Bool[np.ndarray, "h w"], temporal: TemporalParts
) -> Split:
    """Fixed-pattern variances of an average of frames, whose mean may be anything.

    keep: the pixels to use; the others are filled with their row and column means, and not counted.
    """
    height, width = pattern.shape
    centre = pattern[keep].mean() if keep.any() else 0.0
    offsets = np.where(keep, pattern - centre, 0.0)
    in_row, in_column = (np.maximum(keep.sum(axis, keepdims=True), 1) for axis in (1, 0))
    rows, columns = offsets.sum(1, keepdims=True) / in_row, offsets.sum(0, keepdims=True) / in_column
    rest = np.where(keep, pattern - centre - rows - columns, 0.0)
    interaction = float(np.sum(rest**2) / max(keep.sum() - height - width + 1, 1))
    frames = temporal.frames
    inner_dof = heavy_dof(rest[keep], keep.sum() - height - width + 1)
    pixel = variance_difference(interaction, inner_dof, temporal.pixel / frames, temporal.pixel_dof)

    def part(means: np.ndarray, count: int, across: np.ndarray, whole: float, dof: float) -> Estimate:
        # Row means hold the fixed row pattern, temporal row noise / T, and the pixels' fixed pattern / W.
        frozen = max(interaction - temporal.pixel / frames, 0.0) * float(np.mean(1 / across))
        first_dof = heavy_dof(means, count - 1) / correlation_loss(means.reshape(1, -1))
        return variance_difference(
            means.var(ddof=1), max(first_dof, 2.0), whole / frames + frozen, max(dof, 2.0)
        )

    row = part(rows.ravel(), height, in_row, temporal.row_mean, temporal.row_dof)
    column = part(columns.ravel(), width, in_column, temporal.column_mean, temporal.column_dof)
    return Split(total_of(row, column, pixel), row, column, pixel)


def total_of(*parts: Estimate) -> Estimate:
    """The sum of independent estimates; the sides of their intervals add in square."""
    value = sum(p.value for p in parts)
    low, high = (float(np.sqrt(sum((p.ci90[side] - p.value) ** 2 for p in parts))) for side in (0, 1))
    return Estimate(value, float(np.sqrt(sum(p.stderr**2 for p in parts))), (value - low, value + high))


def shading(pattern: Float[np.ndarray, "h w"], degree: int = SHADING_DEGREE) -> Float[np.ndarray, "h w"]:
    """The smooth part of a flat field: a polynomial surface fitted to the means of a grid of blocks."""
    height, width = pattern.shape
    y_edges = np.linspace(0, height, min(_GRID, height // 2) + 1).astype(int)
    x_edges = np.linspace(0, width, min(_GRID, width // 2) + 1).astype(int)
    sums = np.add.reduceat(np.add.reduceat(pattern, y_edges[:-1], 0), x_edges[:-1], 1)
    means = sums / np.outer(np.diff(y_edges), np.diff(x_edges))

    def basis(y: np.ndarray, x: np.ndarray) -> np.ndarray:
        powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
        return np.stack([np.multiply.outer(y**i, x**j) for i, j in powers], -1)

    y, x = (np.linspace(-1, 1, n) for n in (height, width))
    middle_y = np.array([y[a:b].mean() for a, b in zip(y_edges[:-1], y_edges[1:], strict=True)])
    middle_x = np.array([x[a:b].mean() for a, b in zip(x_edges[:-1], x_edges[1:], strict=True)])
    design = basis(middle_y, middle_x)
    weights, *_ = np.linalg.lstsq(design.reshape(-1, design.shape[-1]), means.ravel(), rcond=None)
    return basis(y, x) @ weights
