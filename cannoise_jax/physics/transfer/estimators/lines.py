"""Offsets that whole rows, columns and frames share: temporal and fixed, from repeated darks.

Row means of frame t hold: fixed row pattern + temporal row noise + (pixel noise)/W. Their mean square over
frames gives the temporal part, that of their average over frames the fixed part, each less what the smaller
structures leave in it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.transfer.estimate import (
    Estimate,
    Estimates,
    NotMeasurable,
    heavy_dof,
    root,
    variance_difference,
)
from cannoise_jax.physics.transfer.estimator import BY_CHANCE, Placed
from cannoise_jax.physics.transfer.estimators.pick import (
    column_offsets,
    darkest,
    mean_variance,
    pooled_variance,
    repeated_darks,
    row_offsets,
    steady_pixels,
    without_step,
)
from cannoise_jax.physics.transfer.estimators.waves import Wave, strongest_wave
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.quiet import pattern_below_a_code
from cannoise_jax.physics.transfer.spatial import correlation_loss, temporal_mean_square
from cannoise_jax.physics.transfer.views import left_in_lines
from cannoise_jax.recordings.packing import SITES

_MOST_ROWS = 8  # read together
_PERIODS = 3.0
"""Of a wave in a frame, at least: rows that lean from top to bottom, or bend, are no wave."""
_LEFT = 0.05
"""Of what rows share, up to which a wave that leaves no more is all of it."""


def row_noise(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """sigma_dn of temporal row noise: mean square of row means over frames less the pixels' share. Rows that
    are read together count once, see `row_groups`."""
    return _temporal(statistics, axis=0)


def row_groups(dark: FrameStatistics) -> tuple[int, int] | None:
    """Rows that are read together, as (how many, how many of the first lie before the frame); None: each by
    itself.

    Next rows of one group are then nearly the same, those of two groups not alike at all; the arrangement
    that parts the two best is taken, where it parts them by six standard errors.
    """
    rest = row_offsets(dark)
    rest = rest - rest.mean(0)
    frames, height = rest.shape
    if frames < 2 or height < 16:
        return None
    alike = (rest[:, 1:] * rest[:, :-1]).mean(0) / np.mean(rest**2)  # of a row and the next
    best, found = 0.0, None
    for count in range(2, _MOST_ROWS + 1):
        for phase in range(count):
            within = (np.arange(height - 1) + phase) % count != count - 1
            inside, across = alike[within].mean(), alike[~within].mean()
            error = np.sqrt((1 / within.sum() + 1 / (~within).sum()) / (frames - 1))
            parted = inside - across
            if parted > max(best, 6 * error) and inside > 0.5 and abs(across) < max(0.25 * inside, 3 * error):
                best, found = parted, (count, phase)
    return found


def wave_of_rows(dark: FrameStatistics) -> Wave | None:
    """The sinusoid that holds nearly all that rows share in a frame beyond the noise of their pixels, DN;
    None where none does. Each row has one value of it, so it is no wave of the scan."""
    rows = row_offsets(dark)
    frames, height = rows.shape
    if frames < 2 or height < 16:
        return None
    wave = strongest_wave(rows)
    white = mean_variance(dark)[0] * left_in_lines(dark, 0) * (frames - 1) * (height - 1)
    shared = float(np.sum((rows - rows.mean(0)) ** 2)) - white
    alone = wave.left - white < _LEFT * shared and wave.frequency.value * height >= _PERIODS
    return wave if alone and wave.amplitude.by_chance < BY_CHANCE else None


def column_noise(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """sigma_dn of temporal column noise."""
    return _temporal(statistics, axis=1)


def row_fpn(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """sigma_dn of the fixed row pattern."""
    return _fixed(statistics, axis=0)


def column_fpn(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """sigma_dn of the fixed column pattern."""
    return _fixed(statistics, axis=1)


def offset_drift(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """sigma_dn of the frame offsets: variance of frame means less what rows (and pixels) leave in them."""
    dark = darkest(statistics)
    if dark is None:
        return repeated_darks(statistics)
    frames = dark.frame_means.mean(1)
    rows, dof = temporal_mean_square(dark.row_means.mean(-1))
    # Correlated rows average out more slowly: their mean keeps (1 + 2 sum rho) times the white share.
    share = rows * _long_run(row_offsets(dark)) / dark.recording.size[0]
    drift = variance_difference(frames.var(ddof=1), len(frames) - 1, share, dof)
    return {"sigma_dn": root(drift)}


def placed_rows(estimates: Mapping[str, Estimate], dark: FrameStatistics) -> Placed | None:
    """Row noise at its place in the grammar, where it is one wave, rows are read together, or even and odd
    columns apart."""
    if (wave := wave_of_rows(dark)) is not None:
        found = {"amplitude_dn": wave.amplitude, "frequency": wave.frequency}
        point = Point("readout", "signal", "row", "redrawn", spectrum="sinusoid")
        return Placed(found, "(one wave along the rows, its phase new in every frame)", point)
    groups, apart = row_groups(dark), columns_apart(dark)
    if groups is None and not apart:
        return None
    count, phase = groups or (1, 0)
    said = [f"{count} rows at a time"] if groups else []
    said += ["even and odd columns apart"] if apart else []
    # The mean of a row holds half of the variance of two that have nothing in common.
    sigma = estimates["sigma_dn"].scaled(2**0.5 if apart else 1.0)
    point = Point(
        "readout", "signal", "row", "redrawn", group=count, phase=phase, interleave=2 if apart else 1
    )
    return Placed({"sigma_dn": sigma}, f"({', '.join(said)})", point)


def odd_even_row_noise(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """sigma_dn by which even and odd columns of a row part: mean square of half their difference over frames
    less the pixels' share."""
    dark = darkest(statistics)
    if dark is None:
        return repeated_darks(statistics)
    square, dof = temporal_mean_square((dark.row_means[..., 0] - dark.row_means[..., 1]) / 2)
    pixel, pixel_dof = mean_variance(dark)
    return {"sigma_dn": root(variance_difference(square, dof, pixel * left_in_lines(dark, 0), pixel_dof))}


def beside_rows_apart(parted: Mapping[str, Estimate], place: Point, dark: FrameStatistics) -> bool:
    """Whether row noise whose even and odd columns have nothing in common makes them part."""
    return place.over == "row" and place.interleave == 2


def columns_apart(dark: FrameStatistics) -> bool:
    """Whether even and odd columns of a row have row offsets of their own: both as strong, and not alike."""
    rest = dark.row_means - dark.row_means.mean(0)
    rest = rest - rest.mean(1, keepdims=True)
    frames, height, _ = rest.shape
    even, odd = rest[..., 0], rest[..., 1]
    alike = float(np.mean(even * odd) / np.sqrt(np.mean(even**2) * np.mean(odd**2)))
    variance, _ = mean_variance(dark)
    white = 2 * variance * left_in_lines(dark, 0)
    shares = [float(np.mean(r**2)) * frames / (frames - 1) / white for r in (even, odd)]
    return min(shares) > 2 and max(shares) < 2 * min(shares) and abs(alike) < max(0.1, 3 / np.sqrt(rest.size))


def _temporal(statistics: Sequence[FrameStatistics], axis: int) -> Estimates:
    dark = darkest(statistics)
    return repeated_darks(statistics) if dark is None else {"sigma_dn": line_noise(dark, axis)}


def line_noise(dark: FrameStatistics, axis: int) -> Estimate:
    """Temporal noise that whole rows (axis 0) or columns (axis 1) of repeated frames share, DN."""
    means = dark.row_means.mean(-1) if axis == 0 else dark.column_means.mean(1)
    square, dof = temporal_mean_square(means, turns=2)
    groups = row_groups(dark) if axis == 0 else None
    if groups is not None:  # the likeness that thins them out is not that of a stationary sequence
        dof = min(dof, (len(means) - 1) * (means.shape[1] // groups[0]))
    pixel, pixel_dof = mean_variance(dark)
    white = pixel * left_in_lines(dark, axis)
    return root(variance_difference(square, dof, white, pixel_dof))


def _fixed(statistics: Sequence[FrameStatistics], axis: int) -> Estimates:
    dark = darkest(statistics)
    if dark is None:
        return repeated_darks(statistics)
    if hidden := pattern_below_a_code(dark):
        return NotMeasurable(hidden)
    offsets = row_offsets(dark) if axis == 0 else column_offsets(dark)
    frames, count = offsets.shape
    temporal, dof = temporal_mean_square(offsets)
    pixel, _ = pooled_variance(dark)
    # Hot pixels are no offset of their line: neither they nor their noise counts.
    keep = steady_pixels(dark)
    temporal = max(temporal - max(mean_variance(dark)[0] - pixel, 0.0) * left_in_lines(dark, axis), 0.0)
    rest = np.where(keep, dark.mean, 0.0)
    for c in range(4):
        part, kept = rest[SITES[c]], keep[SITES[c]]
        part -= np.where(kept, part.sum() / max(kept.sum(), 1), 0.0)
    number = np.maximum(keep.sum(1 - axis), 1)
    average = rest.sum(1 - axis) / number
    # The pixels' own fixed pattern also leaves something in the average of a line.
    left = np.where(keep, rest - np.expand_dims(average, 1 - axis), 0.0)
    frozen = max(float(np.sum(left**2) / number.sum()) - pixel / frames, 0.0) * float(np.mean(1 / number))
    taken = 1
    if axis == 1:  # a step in the middle is that of two amplifiers
        average, taken = without_step(average), 2
    square = average.var(ddof=taken)
    fixed_dof = max(heavy_dof(average, count - taken) / correlation_loss(average[None]), 2.0)
    return {"sigma_dn": root(variance_difference(square, fixed_dof, temporal / frames + frozen, dof))}


def _long_run(rest: Float[np.ndarray, "T n"], lags: int = 16) -> float:
    """1 + 2 sum of autocorrelations along a line, at least one tenth; insignificant lags do not count."""
    rest = rest - rest.mean(0)
    power = np.mean(rest**2)
    if power <= 0:
        return 1.0
    total = 1.0
    for lag in range(1, min(lags, rest.shape[1] // 4) + 1):
        rho = float(np.mean(rest[:, :-lag] * rest[:, lag:]) / power)
        if abs(rho) > 4 / np.sqrt(rest[:, lag:].size):
            total += 2 * rho
    return max(total, 0.1)
