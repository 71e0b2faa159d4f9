"""Rows or columns that have a read noise of their own each, from repeated darks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.estimate import Estimate, Estimates, NotMeasurable, normal_estimate, root
from cannoise_jax.physics.transfer.estimators.pick import darkest, odd_by_charge, repeated_darks
from cannoise_jax.physics.transfer.frames import FrameStatistics, steady_frames
from cannoise_jax.physics.transfer.noise_of_lines import (
    LEAST_SHARE,
    Line,
    Loudness,
    Squares,
    loudness,
    within_lines,
)
from cannoise_jax.physics.transfer.quiet import coarse
from cannoise_jax.physics.transfer.views import pixel_variance
from cannoise_jax.recordings.packing import SITES, site


def row_read_noise_map(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """spread (std over mean) of the rows' read noise."""
    return _spread(statistics, baseline, "row")


def column_read_noise_map(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """spread (std over mean) of the columns' read noise."""
    return _spread(statistics, baseline, "column")


def _spread(statistics: Sequence[FrameStatistics], baseline, axis: Line) -> Estimates:
    """From what the noise power of lines differs by beyond that of pieces of them, see `noise_of_lines`;
    what varies smoothly over the lines is no part of it."""
    dark = darkest(statistics)
    if dark is None or dark.recording.count < 4:
        return repeated_darks(statistics, 4)
    if why := coarse(dark):
        return NotMeasurable(why)
    found = lines_of(dark, axis, None if baseline is None else baseline.gain)
    if found is None:
        return NotMeasurable("record larger frames: too few lines, or pixels in them")
    mean = float(np.mean([pixel_variance(dark, c).mean() for c in range(4)]))
    share = max(1 - dark.code_step**2 / 12 / mean, LEAST_SHARE)
    # A logarithm of the noise power is twice that of the noise, of which read noise is a share.
    scale = 1 / (2 * share)
    square = float(np.sum(found.logs**2)) / found.freedom - found.error
    width = root(normal_estimate(square, found.doubt).scaled(scale**2))
    value, *ends = (float(np.sqrt(np.expm1(w**2))) for w in (width.value, *width.ci90))
    return {"spread": Estimate(value, width.stderr, (ends[0], ends[1]), float(np.exp(found.chance)))}


def lines_of(dark: FrameStatistics, axis: Line, gain=None) -> Loudness | None:
    """How loud the lines of a repeated dark are; None where too little tells."""
    usable = ~(dark.clipped | odd_by_charge(dark, gain))
    sigma = np.ones(usable.shape)
    for c in range(4):
        site(sigma, c)[...] = np.sqrt(max(float(median(pixel_variance(dark, c))), 1e-12))
    count, size = dark.recording.count, usable.shape
    total, sums, squares = np.zeros(size), np.zeros((2, *size)), np.zeros((2, *size))
    for at, frame in enumerate(steady_frames(dark)):
        values = ((frame - dark.mean) / sigma * usable)[None]
        for where in SITES:
            values[:, *where] = within_lines(values[:, *where], usable[where], axis)
        half = int(2 * at >= count)
        total += values[0] ** 2
        sums[half] += values[0]
        squares[half] += values[0] ** 2
    counts = ((count + 1) // 2, count // 2)
    halves = [Squares(squares[k] - sums[k] ** 2 / max(n, 1), n - 1) for k, n in enumerate(counts)]
    return loudness(Squares(total, count - 1), (halves[0], halves[1]), usable, axis)
