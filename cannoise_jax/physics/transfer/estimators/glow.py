"""Glow of an amplifier or another warm part beside the pixels, from darks of two exposures.

What does not grow with the exposure is no glow, so one exposure does not show any: shading of the black level
looks the same. Regions that are read by amplifiers of unlike gain have unlike dark charge, in DN: where even
regions describe the dark better than a glow does, only what is left beside them is one. Where a plane does,
the dark current itself differs from side to side, as under a warm end, and nothing glows.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import optimize, stats

from cannoise_jax.physics.robust import local_median, median, robust_std
from cannoise_jax.physics.transfer.estimate import Estimate, Estimates, NotMeasurable
from cannoise_jax.physics.transfer.estimator import BY_CHANCE
from cannoise_jax.physics.transfer.estimators.charge import charge_map, log_estimate, long_and_short
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.quiet import coarse, step_of
from cannoise_jax.physics.transfer.views import less
from cannoise_jax.recordings.packing import site

_LONG = NotMeasurable("record darks of a long exposure, tens of seconds, beside short ones")
_GRID = 24
"""Cells along a side through whose means the glow is fitted; halves, thirds and quarters end between them."""
_FAR = 6.0
"""Robust standard deviations above its neighbours from which a pixel is hot: a glow is even there."""
_EQUAL = ((1, 3), (3, 1), (1, 4), (4, 1), (2, 4), (4, 2), (4, 4))
"""Rows and columns of equal regions that amplifiers read, beside two and two by two of any size."""


def amp_glow(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """e_per_s at the brightest point and length (in frame sides): least squares of G exp(-d/L) around a point
    on the frame's edge, on the longest dark less the shortest, in blocks."""
    found = _fitted_glow(statistics, baseline)
    if found is None:
        return _LONG
    if found.tilt:
        return NotMeasurable(
            f"dark charge changes evenly across the frame, by {found.tilt / found.seconds:.3g} e-/s: the "
            "dark current of one side is larger, and no place glows; a camera model has the mean of it",
            answered=True,
        )
    rate, length = float(np.exp(found.at[0])) / found.seconds, float(np.exp(found.at[1]))
    strength = dataclasses.replace(log_estimate(rate, found.errors[0]), chance=found.chance)
    return {"e_per_s": strength, "length": log_estimate(length, found.errors[1], found.lengths)}


def glow_map(statistics: Sequence[FrameStatistics], baseline) -> Float[np.ndarray, "H W"] | None:
    """exp(-d/L) around the point on the edge where the glow was found; None without suitable darks."""
    found = _fitted_glow(statistics, baseline)
    if found is None or found.tilt:
        return None
    height, width = statistics[0].recording.size
    y0, x0 = _edge_point(found.at[2], height, width)
    distance = np.hypot.outer(np.arange(height) - y0, np.arange(width) - x0) / max(height, width)
    return np.exp(-distance / np.exp(found.at[1]))


def without_glow(
    statistics: Sequence[FrameStatistics], baseline, estimates: Mapping[str, Estimate]
) -> list[FrameStatistics]:
    """The recordings less the charge of a glow, of all whose exposure is known."""
    shape = glow_map(statistics, baseline)
    if shape is None:
        return list(statistics)
    out = []
    for s in statistics:
        added = estimates["e_per_s"].value * (s.recording.exposure_s or 0.0) * shape
        for c in range(4):
            site(added, c)[...] *= baseline.gain[c]
        shot = float(np.mean(baseline.gain)) * added
        out.append(less(s, added, shot=shot if s.shot is None else s.shot + shot))
    return out


class _Glow(NamedTuple):
    """Log peak charge, log length, place on the edge and level of a glow, their errors, the lengths that can
    be told, the seconds it took, and the chance with which an even dark shows one as good. tilt: change of
    the charge across the frame, e-, where a plane describes it better; 0 where it does not."""

    at: np.ndarray
    errors: np.ndarray
    lengths: tuple[float, float]
    seconds: float
    chance: float
    tilt: float


def _fitted_glow(statistics: Sequence[FrameStatistics], baseline) -> _Glow | None:
    pair = long_and_short(statistics)
    if baseline is None or pair is None or pair[1] is None:
        return None
    long, short, seconds = pair
    charge, variance = charge_map(long, short, baseline)
    if coarse(long):  # pixels that never change code are no surer than a code
        variance = np.maximum(variance, (step_of(long) / float(np.mean(baseline.gain))) ** 2 / 12)
    height, width = charge.shape
    means, sigma, y, x, least_length = _cells(charge, variance, _even(charge, variance))
    side = max(height, width)

    def shape(p: np.ndarray) -> np.ndarray:
        y0, x0 = _edge_point(p[2], height, width)
        return np.exp(p[0] - np.hypot.outer(y - y0, x - x0) / side / np.exp(p[1]))

    def cost(p: np.ndarray) -> np.ndarray:
        return ((p[3] + shape(p) - means) / sigma).ravel()

    # Shorter than half a cell it is a spot, and of more than two frames a level: of any strength.
    lengths = least_length, 2.0
    top = np.unravel_index(np.argmax(means), means.shape)
    peak = max(float(means[top] - median(means)), 1e-6)
    starts = [
        np.array([np.log(peak), np.log(length), around, float(median(means))])
        for around in np.arange(0.05, 4, 0.2) for length in (max(0.1, lengths[0]), 0.4)
    ]  # fmt: skip
    best = min(starts, key=lambda p: float(np.sum(cost(p) ** 2)))
    open_ended = [np.inf, np.inf]
    bounds = [-np.inf, np.log(lengths[0]), -np.inf, -np.inf], [np.inf, np.log(lengths[1]), *open_ended]
    scale = [0.3, 0.3, 0.1, float(sigma.mean())]
    fit = optimize.least_squares(cost, best, x_scale=scale, bounds=bounds)
    free, square = len(best), 2 * fit.cost
    regions, apart = _regions(means, sigma)
    if apart + regions.max() * np.log(means.size) < square + (free - 1) * np.log(means.size):

        def beside(p: np.ndarray) -> np.ndarray:
            rest = means - p[3] - shape(p)
            return ((rest - _levels(rest, sigma, regions)) / sigma).ravel()

        # Beside regions the level is theirs: it stays where it is.
        bounds[0][3], bounds[1][3] = best[3] - 1e-9, best[3] + 1e-9
        # Charge that regions have taken up is found again only from a small one.
        starts = [np.array([p[0] + less, *p[1:3], best[3]]) for p in starts for less in (0.0, -3.0)]
        least = min(starts, key=lambda p: float(np.sum(beside(p) ** 2)))
        fit = optimize.least_squares(beside, least, x_scale=scale, bounds=bounds)
        square, free = 2 * fit.cost, free + int(regions.max())
        without = apart
    else:
        even = np.sum(means / sigma**2) / np.sum(1 / sigma**2)
        without = float(np.sum(((means - even) / sigma) ** 2))
    tilt = _tilt(means, sigma, square + (free - 1) * np.log(means.size))
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac)
    excess = max(1.0, square / max(means.size - free, 1))
    gain = (without - square) / excess
    places = 2 * sum(means.shape)  # blocks along the edge at which a glow may sit
    chance = min(places * float(stats.chi2.sf(gain, 2)), 1.0)
    return _Glow(fit.x, np.sqrt(np.diag(covariance * excess)), lengths, seconds, chance, tilt)


class _Cells(NamedTuple):
    """Mean charge of cells and its error, e-, their places, in pixels, and half of the largest in frame
    sides."""

    means: Float[np.ndarray, "r c"]
    sigma: Float[np.ndarray, "r c"]
    y: Float[np.ndarray, "r"]
    x: Float[np.ndarray, "c"]
    half: float


def _even(charge: Float[np.ndarray, "H W"], variance: Float[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """The pixels that do not stand out of those beside them, by more than the shot noise of what all hold."""
    around = local_median(charge.astype(np.float32), 3)
    rest = charge - around
    spread = max(robust_std(rest, 0.0) ** 2, float(np.mean(variance)))
    return rest**2 <= _FAR**2 * (spread + np.maximum(around - median(around), 0.0))


def _cells(
    charge: Float[np.ndarray, "H W"], variance: Float[np.ndarray, "H W"], keep: Bool[np.ndarray, "H W"]
) -> _Cells:
    rows, columns = (np.linspace(0, n, min(_GRID, n // 2) + 1).astype(int) for n in charge.shape)
    pixels, sums, spread = (
        np.add.reduceat(np.add.reduceat(v * keep, rows[:-1], 0), columns[:-1], 1)
        for v in (np.ones(charge.shape), charge, variance)
    )
    pixels = np.maximum(pixels, 1.0)
    y, x = (0.5 * (edges[:-1] + edges[1:] - 1) for edges in (rows, columns))
    half = 0.5 * max(np.diff(rows).max(), np.diff(columns).max()) / max(charge.shape)
    return _Cells(sums / pixels, np.sqrt(spread) / pixels, y, x, float(half))


def _regions(
    means: Float[np.ndarray, "r c"], sigma: Float[np.ndarray, "r c"]
) -> tuple[Int[np.ndarray, "r c"], float]:
    """The regions of cells, numbered from 0, that describe a map best when each is even, by the criterion of
    Schwarz, and what is left of it, in squares of its errors."""
    rows, columns = means.shape
    row, column = (np.arange(n) for n in means.shape)
    borders = [(y, x) for y in range(rows) for x in range(columns) if y or x]
    cuts = [(row >= y if y else 0 * row, column >= x if x else 0 * column) for y, x in borders]
    cuts += [(row * down // rows, column * across // columns) for down, across in _EQUAL]
    best, found, left = np.inf, np.zeros(means.shape, int), np.inf
    for down, across in cuts:
        regions = np.add.outer(down * (int(across.max()) + 1), across).astype(int)
        square = float(np.sum(((means - _levels(means, sigma, regions)) / sigma) ** 2))
        criterion = square + regions.max() * np.log(means.size)
        if criterion < best:
            best, found, left = criterion, regions, square
    return found, left


def _tilt(means: Float[np.ndarray, "r c"], sigma: Float[np.ndarray, "r c"], other: float) -> float:
    """How much a plane through a map changes across the frame, where it describes it better than something
    else does, and surely better than an even level; else 0. other: criterion of Schwarz of that."""
    y, x = np.meshgrid(*((np.arange(n) + 0.5) / n for n in means.shape), indexing="ij")
    design = np.stack([np.ones(means.size), y.ravel(), x.ravel()], -1) / sigma.reshape(-1, 1)
    aim = (means / sigma).ravel()
    found = np.linalg.lstsq(design, aim, rcond=None)[0]
    square = float(np.sum((aim - design @ found) ** 2))
    excess = max(1.0, square / max(means.size - 3, 1))
    even = float(np.sum(means / sigma**2) / np.sum(1 / sigma**2))
    gain = float(np.sum(((means - even) / sigma) ** 2)) - square
    sure = gain / excess > stats.chi2.isf(BY_CHANCE, 2)
    better = square + 2 * np.log(means.size) < other
    return float(np.hypot(found[1], found[2])) if sure and better else 0.0


def _levels(
    means: Float[np.ndarray, "r c"], sigma: Float[np.ndarray, "r c"], regions: Int[np.ndarray, "r c"]
) -> Float[np.ndarray, "r c"]:
    """The weighted mean of the region that every cell is in."""
    weight = (1 / sigma**2).ravel()
    # Of few cells some regions are empty.
    total = np.maximum(np.bincount(regions.ravel(), weight), 1e-300)
    own = np.bincount(regions.ravel(), weight * means.ravel()) / total
    return own[regions]


def _edge_point(around: float, height: int, width: int) -> tuple[float, float]:
    """The point on the frame's edge at `around` in [0, 4): top, right, bottom, left."""
    side, share = int(np.floor(around)) % 4, around - np.floor(around)
    down, across = share * (height - 1), share * (width - 1)
    return [(0.0, across), (down, width - 1.0), (height - 1.0, width - 1 - across), (height - 1 - down, 0.0)][
        side
    ]
