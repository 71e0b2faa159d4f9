"""What is read off the statistics of one recording: single channels, lines, all sites together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.fit import median_quotient, robust_mean_square
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.recordings.packing import ALL, site
from cannoise_jax.recordings.recording import PerChannel, Recording


def pixel_variance(s: FrameStatistics, channel: int) -> Float[np.ndarray, "h w"]:
    """Temporal variance of the pixels of one channel. Raises ValueError for a single frame."""
    if s.variance is None:
        raise ValueError("one frame has no temporal variance: at least two are needed")
    return site(s.variance, channel)


def usual_variance(s: FrameStatistics, channel: int) -> float:
    """Temporal variance of a usual pixel of one channel, DN^2, by the median."""
    return float(median(pixel_variance(s, channel))) / median_quotient(s.dof)


def dark_shot(s: FrameStatistics, channel: int) -> float:
    """Variance of one channel by dark charge that is taken out of the means of a flat, DN^2."""
    return 0.0 if s.dark_shot is None else s.dark_shot[channel]


def with_all_sites(s: FrameStatistics) -> FrameStatistics:
    """The statistics with one more channel, `ALL`: the pixels of the four sites together."""
    own: dict[str, Any] = {
        "frame_means": np.concatenate([s.frame_means, s.frame_means.mean(1, keepdims=True)], 1),
        "level": (*s.level, float(np.mean(s.level))),
        # A code at which one site piles up is an end of all.
        "low": (*s.low, _end(s.low, min)),
        "high": (*s.high, _end(s.high, max)),
        "lowest": (*s.lowest, float(np.mean(s.lowest))),
        "rounded": None if s.rounded is None else tuple((*v, float(np.mean(v))) for v in s.rounded),
        "dark_shot": None if s.dark_shot is None else (*s.dark_shot, float(np.mean(s.dark_shot))),
    }
    return replace(s, **own)


def _end(codes: PerChannel, pick: Callable[[list[float]], float]) -> float:
    known = [c for c in codes if np.isfinite(c)]
    return pick(known) if known else float("nan")


def less(s: FrameStatistics, added: Float[np.ndarray, "H W"], **stated: Any) -> FrameStatistics:
    """The statistics without charge that every frame holds, DN; the recording keeps it, and all keep its shot
    noise. stated: where that is said, by field."""
    rows = np.stack([added[:, p::2].mean(1) for p in (0, 1)], -1)
    columns = np.stack([added[p::2].mean(0) for p in (0, 1)])
    means = np.array([float(site(added, c).mean()) for c in range(4)])
    if len(s.level) > 4:  # of all sites together, see `with_all_sites`
        means = np.append(means, means.mean())
    own: dict[str, Any] = {
        "mean": s.mean - added,
        "frame_means": s.frame_means - means,
        "row_means": s.row_means - rows,
        "column_means": s.column_means - columns,
        "level": tuple(float(v) for v in np.asarray(s.level) - means),
    }
    return replace(s, **own, **stated)


def line_means(s: FrameStatistics, channel: int) -> tuple[Float[np.ndarray, "T h"], Float[np.ndarray, "T w"]]:
    """Means of the rows and of the columns of one channel in every frame."""
    if channel == ALL:
        return s.row_means.mean(-1), s.column_means.mean(1)
    return s.row_means[:, channel // 2 :: 2, channel % 2], s.column_means[:, channel // 2, channel % 2 :: 2]


def unlike_sites(s: FrameStatistics, channel: int) -> Float[np.ndarray, "h w"]:
    """The usual variance of the pixels of each mosaic site over that of all sites: of `ALL`, rows or columns
    may take turns in noise; of one site 1."""
    out = np.ones(site(s.mean, channel).shape)
    if channel == ALL:
        middles = np.array([float(median(pixel_variance(s, c))) for c in range(4)])
        for c, middle in enumerate(middles):
            site(out, c)[...] = middle / max(float(middles.mean()), 1e-12)
    return out


def quiet_mean_square(
    s: FrameStatistics, channel: int, rounding: float = 0.0
) -> tuple[float, Bool[np.ndarray, "h w"]]:
    """Mean temporal variance of one channel by the outlier rule, DN^2, and the pixels kept; of `ALL` each
    mosaic site by itself. rounding: see `fit.robust_mean_square`."""
    if channel != ALL:
        return robust_mean_square(pixel_variance(s, channel), s.dof, rounding=rounding)
    squares, keep = [], np.zeros(s.mean.shape, bool)
    for c in range(4):
        square, site(keep, c)[...] = robust_mean_square(pixel_variance(s, c), s.dof, rounding=rounding)
        squares.append(square)
    return float(np.mean(squares)), keep


def quiet_pixels(s: FrameStatistics, channel: int, rounding: float = 0.0) -> Bool[np.ndarray, "h w"]:
    """Pixels of a repeated dark that the outlier rule keeps."""
    return quiet_mean_square(s, channel, rounding)[1]


def black_of(recording: Recording, channel: int) -> float:
    """The black level that a recording states for one channel, DN."""
    return float(np.mean(recording.black_level)) if channel == ALL else recording.black_level[channel]


def not_stuck(s: FrameStatistics) -> Bool[np.ndarray, "H W"]:
    """Pixels that are not stuck."""
    return np.ones(s.mean.shape, bool) if s.stuck is None else ~s.stuck


def unspoilt(s: FrameStatistics) -> Bool[np.ndarray, "H W"]:
    """Pixels that tell whether a flat reaches the ends of the codes: neither stuck nor left out for spots."""
    return not_stuck(s) if s.spots is None else not_stuck(s) & ~s.spots


def at_an_end(s: FrameStatistics) -> Bool[np.ndarray, "H W"]:
    """Stuck pixels without those of bad lines, which are at no end of the codes."""
    return ~not_stuck(s) if s.bad is None else ~not_stuck(s) & ~s.bad.pixels


def left_in_lines(s: FrameStatistics, axis: int) -> float:
    """Of the variance of white noise, what the mean of a row (axis 0) or column (axis 1) holds, over all of
    them: one over its pixels that are not stuck, 0 of lines that have none."""
    if s.stuck is None:
        return 1 / s.mean.shape[1 - axis]
    counts = (~s.stuck).sum(1 - axis)
    return float(np.mean(np.where(counts > 0, 1 / np.maximum(counts, 1), 0.0)))
