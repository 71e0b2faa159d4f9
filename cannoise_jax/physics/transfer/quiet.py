"""Temporal noise of darks that are quieter than a code, told from what rounding leaves of it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cannoise_jax.physics.core.rounding import COARSE, before_rounding, level_and_spread
from cannoise_jax.physics.transfer.estimate import Estimate, normal_estimate
from cannoise_jax.physics.transfer.fit import robust_mean_square
from cannoise_jax.physics.transfer.frames import FrameStatistics, pixel_variance
from cannoise_jax.physics.transfer.rails import is_cut_off
from cannoise_jax.recordings.packing import site


class QuietNoise(NamedTuple):
    """read: temporal noise before rounding, DN. square: the temporal variance of what is stored, DN^2."""

    read: Estimate
    square: float


def noise_below_a_code(dark: FrameStatistics, step: float, c: int) -> QuietNoise | None:
    """The noise of darks that are quieter than about a code, None of others: what rounds to their variance at
    the levels of these pixels; that variance less step^2 / 12 is something else."""
    if dark.variance is None or is_cut_off(dark, c):
        return None
    square, stderr = mean_square_of(dark, c)
    if not 0 < square < (COARSE**2 + 1 / 12) * step**2:
        return None
    level, spread = level_and_spread(site(dark.mean, c), square, dark.recording.count, step)
    read, low, high = (
        before_rounding(level, max(v, 1e-6 * step**2), step, spread)[1]
        for v in (square, square - stderr, square + stderr)
    )
    return QuietNoise(normal_estimate(read, 0.5 * abs(high - low)), square)


def mean_square_of(dark: FrameStatistics, c: int) -> tuple[float, float]:
    """Temporal variance of one channel, DN^2, and its error."""
    variance = pixel_variance(dark, c)
    square, keep = robust_mean_square(variance, dark.dof)
    return square, float(variance[keep].std() / np.sqrt(keep.sum()))


def hidden_in_a_code(dark: FrameStatistics, step: float, c: int) -> bool:
    """Whether most values are at one code, above 0, and the others at most at the next: noise of less than a
    code, which looks like values that pile up there."""
    if dark.variance is None or not is_cut_off(dark, c) or dark.low[c] <= 0:
        return False
    return bool(np.quantile(pixel_variance(dark, c), 0.99) < step**2)
