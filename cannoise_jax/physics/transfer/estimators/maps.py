"""What differs from pixel to pixel: fixed offsets, sensitivities and read noise, from repeated frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from cannoise_jax.physics.robust import robust_std
from cannoise_jax.physics.transfer.estimate import (
    Estimate,
    Estimates,
    NotMeasurable,
    heavy_dof,
    normal_estimate,
    root,
    variance_difference,
)
from cannoise_jax.physics.transfer.estimators.charge import grown
from cannoise_jax.physics.transfer.estimators.dark_map import HOT, DarkMap
from cannoise_jax.physics.transfer.estimators.light_alone import LightAlone, light_alone
from cannoise_jax.physics.transfer.estimators.own_charge import expected_logs, halves_of, holds_charge
from cannoise_jax.physics.transfer.estimators.pick import (
    brightest_flat,
    darkest,
    no_flat,
    odd_by_charge,
    pooled_variance,
    repeated_darks,
    steady_pixels,
)
from cannoise_jax.physics.transfer.frames import FrameStatistics, of_variance
from cannoise_jax.physics.transfer.quiet import coarse, pattern_below_a_code, unseen_offsets
from cannoise_jax.physics.transfer.regions import uneven_noise
from cannoise_jax.physics.transfer.response import response_of
from cannoise_jax.physics.transfer.spatial import correlation_loss, shading
from cannoise_jax.physics.transfer.views import pixel_variance
from cannoise_jax.recordings.packing import green_sites, site
from cannoise_jax.recordings.recording import DARK

_FEWEST = 16
"""Pixels of a channel that say anything of a spread over pixels."""
_NARROWEST = 8
"""Columns: the mean of a row of two pixels of a colour takes all that tells one from the other."""
_COLUMNS = 16
"""Smooth shading alone takes ten of them."""
_NO_PIXELS = NotMeasurable("nearly all pixels jump or are warm: record shorter darks, or a larger frame")


class Pattern(NamedTuple):
    """A fixed pattern by pixels and columns.

    pixels: with channel, row and column means taken out. columns: means per row parity. keep: which pixels
    count. noise: temporal variance that the average of frames still holds. smooth: degree of the shading
    taken out. light: smooth light of a flat, 1 on average. lines: the row and column means, at every pixel.
    """

    pixels: Float[np.ndarray, "H W"]
    columns: Float[np.ndarray, "2 W"]
    keep: Bool[np.ndarray, "H W"]
    noise: float
    noise_dof: float
    smooth: int = 0
    light: Float[np.ndarray, "H W"] | float = 1.0
    lines: Float[np.ndarray, "H W"] | float = 0.0


def offset_pattern(
    dark: FrameStatistics, grown: tuple[Float[np.ndarray, "H W"], float] | None = None
) -> Pattern:
    """The fixed offsets of a dark, DN. Pixels more than six robust standard deviations out do not count: they
    are hot, and have a mechanism of their own. grown: see `charge.grown`, which is taken out."""
    variance, dof = pooled_variance(dark)
    keep = steady_pixels(dark)
    added, noise = (0.0, 1.0) if grown is None else grown
    mean = dark.mean - added
    offsets, _ = _split(mean, keep)
    keep &= np.abs(offsets) < HOT * robust_std(offsets[keep], 0)
    pixels, columns = _split(mean, keep)
    lines = line_part(mean, pixels, keep)
    return Pattern(pixels, columns, keep, noise * variance / dark.recording.count, dof, lines=lines)


def response_pattern(flat: FrameStatistics, dark: DarkMap | None) -> Pattern:
    """The fixed relative sensitivities of a flat less its dark; smooth shading is taken out, and pixels that
    answer oddly do not count (`transfer.response`)."""
    relative, light = np.empty(flat.mean.shape), np.empty(flat.mean.shape)
    keep = steady_pixels(flat) if dark is None else steady_pixels(flat) & dark.keep
    noise, dof, degree = 0.0, 0.0, 0
    light_dn = flat.mean - flat.recording.black_map() - (0.0 if dark is None else dark.offsets)
    if flat.recording.cfa == "MONO":  # of one colour, whose next pixels are nearer than those of a site
        keep &= ~response_of(light_dn / float(np.mean(flat.level)), keep).shadow
    for c in range(4):
        level = flat.level[c]
        found = response_of(site(light_dn, c) / level, site(keep, c))
        scale = float(np.sqrt(found.square))
        site(relative, c)[...] = found.pattern / scale
        site(light, c)[...] = found.light / scale
        site(keep, c)[...] = found.keep
        degree = max(degree, found.degree)
        # Of the level of the average: under a light that drifts the variance is that of a lower one.
        variance = (pixel_variance(flat, c) / site(of_variance(flat), c))[found.keep]
        left = float(variance.mean()) / flat.recording.count + (0.0 if dark is None else dark.noise(c))
        noise += left / (level * scale) ** 2 / 4
        dof += variance.size * flat.dof
    pixels, columns = _split(relative, keep)
    return Pattern(pixels, columns, keep, noise, dof, degree, light, line_part(relative, pixels, keep))


def dsnu(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """sigma_dn of the pixels' fixed offsets, row and column patterns apart."""
    dark = darkest(statistics)
    if dark is None:
        return repeated_darks(statistics)
    if hidden := pattern_below_a_code(dark):
        return NotMeasurable(hidden)
    return {"sigma_dn": root(pixel_part(offset_pattern(dark, grown(statistics, baseline, dark))))}


def prnu(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """sigma of the pixels' relative sensitivity, from a flat less what the darks show at its exposure."""
    flat = brightest_flat(statistics)
    if flat is None:
        return no_flat(statistics)
    alone = light_alone(statistics, flat)
    if isinstance(alone, NotMeasurable):
        return alone
    pixels = pixel_part(response_pattern(alone.flat, alone.dark))
    return {"sigma": root(pixels.of_which(_unseen(statistics, alone)))}


def column_gain(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """sigma of the columns' relative gain, from a flat: variance of column means less the pixels' share."""
    flat = brightest_flat(statistics)
    if flat is None:
        return no_flat(statistics)
    if flat.recording.size[1] < _COLUMNS:
        return NotMeasurable(f"record frames of at least {_COLUMNS} columns")
    alone = light_alone(statistics, flat)
    if isinstance(alone, NotMeasurable):
        return alone
    columns = column_part(response_pattern(alone.flat, alone.dark))
    return {"sigma": root(columns.of_which(_unseen(statistics, alone)))}


def _unseen(statistics: Sequence[FrameStatistics], alone: LightAlone) -> float:
    """Relative variance of offsets in a flat that no dark shows, or whose rounding is as large."""
    flat, dark = alone.flat, alone.dark
    unseen = unseen_offsets([s for s in statistics if s.recording.kind in DARK])
    unseen = max(unseen, 0.0 if dark is None else max(map(dark.rounding, range(4))))
    return unseen * float(np.mean(1 / np.square(flat.level)))


def pixel_read_noise_map(
    statistics: Sequence[FrameStatistics], baseline=None, without: Bool[np.ndarray, "H W"] | None = None
) -> Estimates:
    """spread (std over mean) of the pixels' read noise, from what the log variances of two halves of the
    frames have in common: cov(ln v1, ln v2) = 4 w^2 for log-normal read noise, whatever the shape of the
    noise, for the halves share nothing but the pixel. What pixels of a line share is no part of it, nor is
    the shot noise of dark charge that they hold (`own_charge`), by which those that lie higher are noisier.

    without: pixels to leave out, as those that are known for telegraph pixels. Warm pixels, whose own charge
    explains their noise, are left out as well.
    """
    dark = darkest(statistics)
    if dark is None or dark.recording.count < 4:
        return repeated_darks(statistics, 4)
    if dark.recording.size[1] < _NARROWEST:
        return NotMeasurable(f"record frames of at least {_NARROWEST} columns")
    if why := uneven_noise(dark) or coarse(dark):
        return NotMeasurable(why)
    rounding = dark.code_step**2 / 12
    pairs = halves_of(dark)
    least = max(rounding, 1e-6) / 4
    charged = baseline is not None and holds_charge(dark, pairs)
    products, shots, means = [], [], []
    odd = dark.clipped | odd_by_charge(dark, None if baseline is None else baseline.gain)
    for c in range(4):
        keep = ~site(odd if without is None else odd | without, c)
        if keep.sum() < _FEWEST:
            return _NO_PIXELS
        means.append(float(pixel_variance(dark, c)[keep].mean()))
        logs = [
            [_within_lines(np.log(np.maximum(site(h.variance, c), least)), keep) for h in p] for p in pairs
        ]
        # Every way to halve the frames measures the same; their mean is a little surer than one alone.
        products.append(sum(a * b for a, b in logs) / len(logs))
        if charged:
            gain = float(baseline.gain[c])
            shot_logs = [
                [_within_lines(expected_logs(site(h.mean, c), keep, means[-1], gain), keep) for h in p]
                for p in pairs
            ]
            both = [a * n + b * m for (a, b), (m, n) in zip(logs, shot_logs, strict=True)]
            shots.append(sum(both) / (2 * len(both)))
    values = np.concatenate(products)
    if charged:
        values = values - np.concatenate(shots)
    square = normal_estimate(float(values.mean()), float(values.std() / np.sqrt(values.size)))
    width = root(square.scaled(0.25))
    row, mean = 1 / (dark.recording.size[1] // 2), float(np.mean(means))
    own = max((mean - rounding) / (1 - row), 0.1 * mean)
    # Rounding, and the row mean taken out, add the same to the variances of all pixels.
    shared = (row * own + rounding) / (1 - 2 * row) / own
    grid = np.linspace(0.0, 2.0, 401)
    seen = _narrowed(grid, shared)
    rising = slice(0, int(np.argmax(seen)) + 1)  # beyond, most pixels have no more than what is shared
    grid, seen = grid[rising], seen[rising]
    spread = np.sqrt(np.expm1(grid**2))
    value, low, high = (float(np.interp(w, seen, spread)) for w in (width.value, *width.ci90))
    slope = float(np.interp(width.value, seen, np.gradient(spread, seen)))
    return {"spread": Estimate(value, width.stderr * slope, (low, high), width.chance)}


def _within_lines(values: Float[np.ndarray, "h w"], keep: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "n"]:
    """Those that are kept, less the means of their channel, row and column, with the variance that they have
    without."""
    values = np.where(keep, values - values[keep].mean(), 0.0)
    for axis in (0, 1):
        counts = np.maximum(keep.sum(axis, keepdims=True), 1)
        values -= np.where(keep, values.sum(axis, keepdims=True) / counts, 0.0)
    lines = np.count_nonzero(keep.any(0)) + np.count_nonzero(keep.any(1)) - 1
    return values[keep] * np.sqrt(keep.sum() / max(keep.sum() - lines, 1))


_POINTS, _WEIGHTS = np.polynomial.hermite_e.hermegauss(80)


def _narrowed(widths: Float[np.ndarray, "n"], shared: float) -> Float[np.ndarray, "n"]:
    """Half the standard deviation of ln(v + shared) over pixels of log-normal read noise: v has mean 1, ln v
    the standard deviation 2 width."""
    weights = _WEIGHTS / _WEIGHTS.sum()
    logs = np.log(np.exp(2 * widths[:, None] * (_POINTS - widths[:, None])) + shared)
    return np.sqrt((logs - (logs @ weights)[:, None]) ** 2 @ weights) / 2


def green_imbalance(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """sigma: half of the relative difference of the two greens, that beside red less that beside blue."""
    flat = brightest_flat(statistics)
    if flat is None:
        return no_flat(statistics)
    greens = green_sites(flat.recording.cfa)
    if not greens:
        return NotMeasurable("the sensor has no colours, so no two greens", answered=True)
    first, second = greens
    black = np.asarray(flat.recording.black_level)
    signal = np.empty(flat.mean.shape)
    for c in range(4):
        site(signal, c)[...] = site(flat.mean, c) - black[c]
    # Against the four of the other green around each, so that light that leans does not tell them apart.
    around = (signal[:-2, :-2] + signal[:-2, 2:] + signal[2:, :-2] + signal[2:, 2:]) / 4
    own, other = np.full(signal.shape, np.nan), np.full(signal.shape, np.nan)
    own[1:-1, 1:-1], other[1:-1, 1:-1] = signal[1:-1, 1:-1], around
    ratios = [float(np.nanmean(site(own, c)) / np.nanmean(site(other, c))) for c in (first, second)]
    ratio = np.log(ratios[0] / ratios[1]) / 2
    spread = 0.0
    for c in (first, second):
        gains = (site(flat.mean, c) - black[c]) / flat.level[c]
        spread += float(np.var(gains - shading(gains).surface)) / gains.size
    return {"sigma": normal_estimate(float(np.tanh(ratio / 2)), float(np.sqrt(spread)) / 2)}


def _split(values: Float[np.ndarray, "H W"], keep: Bool[np.ndarray, "H W"]) -> tuple[np.ndarray, np.ndarray]:
    """Pixels without channel, row and column means, and column means per row parity, channel means out."""
    pixels = np.where(keep, values, 0.0)
    columns = np.zeros((2, values.shape[1]))
    for c in range(4):
        part, inside = site(pixels, c), site(keep, c)
        counts = [np.maximum(inside.sum(axis, keepdims=True), 1) for axis in (0, 1)]
        part -= np.where(inside, part.sum() / max(inside.sum(), 1), 0.0)
        column = part.sum(0, keepdims=True) / counts[0]
        row = part.sum(1, keepdims=True) / counts[1]
        columns[c // 2, c % 2 :: 2] = column[0]
        part -= np.where(inside, row + column, 0.0)
    return pixels, columns


def line_part(
    values: Float[np.ndarray, "H W"], pixels: Float[np.ndarray, "H W"], keep: Bool[np.ndarray, "H W"]
) -> Float[np.ndarray, "H W"]:
    """The row and column means that `pixels` are left without, channel means out; zero where not kept."""
    lines = np.where(keep, values - pixels, 0.0)
    for c in range(4):
        part, inside = site(lines, c), site(keep, c)
        part -= np.where(inside, part.sum() / max(inside.sum(), 1), 0.0)
    return lines


def white_lines(values: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """The row and column means of numbers of which each is its pixel's own."""
    keep = np.ones(values.shape, bool)
    return line_part(values, _split(values, keep)[0], keep)


def pixel_part(pattern: Pattern) -> Estimate:
    """Variance of the pixels' own fixed pattern."""
    height, width = pattern.pixels.shape
    inside = pattern.pixels[pattern.keep]
    count = max(inside.size - 2 * (height + width) + 4, 1)
    square = float(np.sum(inside**2)) / count
    return variance_difference(square, heavy_dof(inside, count), pattern.noise, pattern.noise_dof)


def column_part(pattern: Pattern) -> Estimate:
    """Variance of the fixed pattern of columns, both row parities of a column together."""
    told = pattern.keep.any(0)  # a column of dead pixels has no gain
    means = pattern.columns.mean(0)[told]
    height, width = pattern.pixels.shape
    inside = pattern.pixels[pattern.keep]
    share = float(np.sum(inside**2)) / max(inside.size - 2 * (height + width) + 4, 1) / height
    # Channel means, and the smooth shading of a flat, have been taken out of both sets of columns.
    count = max(means.size - 2 * (pattern.smooth + 1), 1)
    dof = max(heavy_dof(means, count) / correlation_loss(means[None]), 2.0)
    return variance_difference(float(np.sum(means**2)) / count, dof, share, inside.size)
