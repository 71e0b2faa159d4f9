"""Dark current of one channel, from the mean and from the variance of darks of several exposures.

The mean is what EMVA 1288 asks for, but many cameras subtract the dark signal of shielded pixels on the chip,
which leaves the mean flat or falling. The shot noise of the charge cannot be subtracted, so the growth of the
temporal variance gives the dark current all the same: slope / K^2. Where the two disagree the mean is not to
be used.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

from cannoise_jax.physics.core.rounding import mean_bias, variance_bias
from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.physics.transfer.black import mean_error
from cannoise_jax.physics.transfer.dark_pixels import FAR, above_level, law_of
from cannoise_jax.physics.transfer.estimate import Z90, Estimate, NotMeasurable, normal_estimate
from cannoise_jax.physics.transfer.fit import robust_mean_square
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.quiet import coarse, dither
from cannoise_jax.physics.transfer.views import pixel_variance, usual_variance
from cannoise_jax.recordings.packing import site

RECORD = (
    "record darks at three or more exposure times, the longest some tens of seconds, 2 frames each or more"
)
_UNLIKE = 3.0
"""Times the pattern of the shortest dark from which that of the longest is the spread of dark currents."""
_ALIKE = 0.25
"""Of the dark current by the variance, by which that by the mean is off where the black level is clamped, or
light leaks in: a response that bends takes less."""
_NOISE_FLOOR = 0.02  # relative error granted to every mean square besides its statistical one
_KNOWN = 8.0
"""Degrees of freedom that the known errors of the values are worth beside the scatter about a line: three
exposures leave one, and an interval from that alone is of any width. By Monte Carlo of three to six
exposures intervals then hold the truth in 92 to 93 % of the draws, and 84 to 86 % where the levels wander by
as much again."""
_RISES = 10.0
"""Standard errors from which the mean of darks surely rises."""
_SCATTERED = 0.05
"""Chance of so much scatter by the known errors below which scatter alone tells."""


class Series(NamedTuple):
    """Darks of one channel, or of several on average, over exposure time: mean (e- above any constant) and
    temporal variance (e-^2), and the errors of both, that of the variance without `_NOISE_FLOOR`."""

    seconds: Float[np.ndarray, "n"]
    mean: Float[np.ndarray, "n"]
    mean_error: Float[np.ndarray, "n"]
    variance: Float[np.ndarray, "n"]
    error: Float[np.ndarray, "n"]


def dark_series(
    darks: Sequence[FrameStatistics], channels: Sequence[int], gains: Sequence[float],
    apart: tuple[Bool[np.ndarray, "H W"], bool] | None = None,
) -> Series | NotMeasurable:  # fmt: skip
    """Repeated darks of known exposure, in electrons, averaged over some channels.

    Pixels that clip, or that are hot in the longest dark, are left out (`transfer.dark_pixels`). apart: which
    these are of all pixels, and whether the dark currents of the others are alike; None: each channel by
    itself tells. gains: DN/e- of the channels.
    """
    series = sorted(
        (s for s in darks if s.variance is not None and s.recording.exposure_s is not None),
        key=lambda s: s.recording.exposure_s or 0.0,
    )
    repeated = {s.recording.exposure_s for s in series}
    if len(repeated) < 3:
        single = {s.recording.exposure_s for s in darks} - repeated - {None}
        return NotMeasurable(_second(single) if len(repeated) + len(single) > 2 else RECORD)
    kept = []
    for c, gain in zip(channels, gains, strict=True):
        if apart is None:
            keep, alike = _ordinary(series[0], series[-1], c, gain)
        else:
            keep, alike = ~site(apart[0], c), apart[1]
        for s in series:
            keep &= ~site(s.clipped, c)
        if not keep.any():
            return NotMeasurable("every pixel of the darks is cut off or hot: record shorter ones")
        kept.append(_Kept(c, gain, keep, alike))
    return Series(*np.array([_at(s, kept) for s in series], np.float64).T)


class _Kept(NamedTuple):
    """The pixels of a channel that count, and whether their dark currents are alike. gain: DN/e-."""

    channel: int
    gain: float
    pixels: Bool[np.ndarray, "h w"]
    alike: bool


def _at(s: FrameStatistics, kept: Sequence[_Kept]) -> tuple[float, float, float, float, float]:
    """One dark as `Series` has it. The noise of the channels is independent; what moves all of a frame, and
    what rounding hides, is common to them."""
    means, squares, errors, rounded = [], [], [], []
    for one in kept:
        value, count = _mean_variance(s, one.channel, one.pixels, one.alike)
        means.append(float(site(s.mean, one.channel)[one.pixels].mean()) / one.gain)
        squares.append(value / one.gain**2)
        errors.append(squares[-1] * np.sqrt(2 / (count * s.dof)))
        seen, step = dither(s, one.channel), s.code_step / one.gain
        rounded.append((step * mean_bias(seen), step**2 * variance_bias(seen)))
    of_mean, of_variance = np.mean(rounded, 0)
    doubt = mean_error(s, [one.channel for one in kept]) / np.mean([one.gain for one in kept])
    error = np.linalg.norm(errors) / len(kept)
    return (
        s.recording.exposure_s or 0.0, float(np.mean(means)), float(np.hypot(doubt, of_mean)),
        float(np.mean(squares)), float(np.hypot(error, of_variance)),
    )  # fmt: skip


def _mean_variance(
    s: FrameStatistics, channel: int, keep: Bool[np.ndarray, "h w"], alike: bool
) -> tuple[float, int]:
    """Temporal variance of the pixels to keep, DN^2, and of how many. Where their dark currents are alike,
    the loud ones among them have another cause."""
    variance = pixel_variance(s, channel)
    if s.shot is not None:
        # Scaled, so that the scatter of a variance stays what its frames make it.
        shot = site(s.shot, channel)
        base = max(float(median(variance - shot)), s.code_step**2 / 12)
        variance = variance * base / (base + shot)
    if alike:
        value, kept = robust_mean_square(variance[keep], s.dof)
        return value, int(kept.sum())
    calm = keep if s.hits is None else keep & ~site(s.hits.pixels, channel)
    return float(variance[calm].mean()), int(calm.sum())


def _ordinary(
    shortest: FrameStatistics, longest: FrameStatistics, channel: int, gain: float
) -> tuple[Bool[np.ndarray, "h w"], bool]:
    """Pixels of a channel that are not hot, and whether the dark currents of these are alike. Hot: beyond six
    spreads of a normal law, or where all currents have a longer tail than that, what stands out from it."""
    grown = above_level(site(longest.mean, channel) - site(shortest.mean, channel))
    seen = ~site(longest.clipped, channel)
    if not seen.any():
        return seen, True
    noise = sum(usual_variance(s, channel) / s.recording.count for s in (shortest, longest))
    law = law_of(
        grown[seen], noise=float(np.sqrt(noise)), shot=gain / longest.recording.count,
        least=0.5 * longest.code_step if coarse(longest) else 0.0,
    )  # fmt: skip
    if law.shape:
        return ~law.is_hot(grown) & ~law.far_above(grown), False
    mean = site(longest.mean, channel)
    middle = float(median(mean))
    return mean < middle + FAR * robust_std(mean, middle), True


def unlike_charge(darks: Sequence[FrameStatistics], channel: int) -> str:
    """How the fixed pattern of a channel's ordinary pixels grows from the shortest dark to the longest, where
    their dark currents differ; empty where they do not."""
    known = [s for s in darks if s.variance is not None and s.recording.exposure_s is not None]
    ends = [pick(known, key=lambda s: s.recording.exposure_s or 0.0) for pick in (min, max)]
    patterns = []
    for s in ends:
        noise = usual_variance(s, channel) / s.recording.count
        mean = site(s.mean, channel)
        patterns.append(max(robust_std(mean, float(median(mean))) ** 2 - noise, noise) ** 0.5)
    if patterns[1] < _UNLIKE * patterns[0]:
        return ""
    said = [f"{p:.3g} DN at {s.recording.exposure_s:g} s" for p, s in zip(patterns, ends, strict=True)]
    return (
        f"the fixed pattern grows from {said[0]} to {said[1]}: dark currents differ from pixel to pixel, or "
        "light of the electronics adds to them"
    )


def _second(seconds: Collection[float | None]) -> str:
    times = ", ".join(f"{s:g}" for s in sorted(s for s in seconds if s is not None))
    return f"record a second dark of {times} s: three exposure times need 2 frames each or more"


def dark_currents(series: Series, gain_error: float = 0.0) -> tuple[Estimate, Estimate, bool, str]:
    """Dark current by mean and by variance, e-/s per pixel, whether they agree, and a note that says so.

    gain_error: relative standard error of the gain that made electrons of DN; the mean is divided by the
    gain, the variance by its square.
    """
    even = np.ones(len(series.seconds))
    by_mean, first = _slope(series.seconds, series.mean, even, series.mean_error, gain_error)
    doubt = np.hypot(series.error, _NOISE_FLOOR * series.variance)
    by_variance, second = _slope(
        series.seconds, series.variance, 1 / doubt, series.error, 2 * gain_error, doubt
    )
    apart = by_mean.value - by_variance.value
    error = float(np.hypot(first, second))
    if abs(apart) < 3 * error:
        return by_mean, by_variance, True, "agrees with the variance"
    if abs(apart) < _ALIKE * abs(by_variance.value):
        share = 100 * abs(apart / by_variance.value)
        return by_mean, by_variance, True, f"{share:.0f} % {'above' if apart > 0 else 'below'} the variance's"
    note = "disagrees with the variance: black is clamped on the chip, so the mean cannot be used"
    if by_mean.value > _RISES * error:
        ratio = by_variance.value / by_mean.value
        note = (
            "disagrees with the variance: a part of it is subtracted on the chip, so that the mean cannot be "
            f"used, or the darks have {ratio:.2g} times the gain of the flats"
        )
    if apart > 0:
        note = "exceeds what the variance allows: black level rising with exposure"
        if by_variance.value > _RISES * second:
            ratio = by_variance.value / by_mean.value
            note += f", or the darks have {ratio:.2g} times the gain of the flats"
    return by_mean, by_variance, False, note


def _slope(
    times: np.ndarray, values: np.ndarray, weight: np.ndarray, errors: np.ndarray, relative: float,
    doubt: np.ndarray | None = None,
) -> tuple[Estimate, float]:  # fmt: skip
    """Weighted straight line; the error of its slope comes from the scatter about the line and from the known
    errors of the values, pooled unless the scatter is surely larger, and from the relative error of the unit
    of the values. Few points may lie on a line by luck: against a slope of zero, and in the error that is
    returned beside it, all that is in doubt about the values counts too. doubt: that; None: their errors."""
    design = np.stack([np.ones_like(times), times], -1) * weight[:, None]
    solve = np.linalg.pinv(design) * weight
    offset, slope = solve @ values
    rest = (values - offset - slope * times) * weight
    dof = len(times) - 2
    scatter = float(np.linalg.inv(design.T @ design)[1, 1] * (rest @ rest) / dof)
    known = float(np.sum((solve[1] * errors) ** 2))
    square, sure = scatter, float(dof)
    if dof * scatter <= stats.chi2.isf(_SCATTERED, dof) * known:
        square, sure = (_KNOWN * known + dof * scatter) / (_KNOWN + dof), _KNOWN + dof
    line = normal_estimate(float(slope), float(np.sqrt(square)), sure)
    half = float(np.hypot(line.ci90[1] - line.value, Z90 * relative * line.value))
    error = float(np.hypot(line.stderr, relative * line.value))
    all_known = float(np.sqrt(np.sum((solve[1] * (errors if doubt is None else doubt)) ** 2)))
    chance = normal_estimate(line.value, max(line.stderr, all_known)).by_chance
    found = Estimate(line.value, error, (line.value - half, line.value + half), chance)
    return found, max(error, all_known)
