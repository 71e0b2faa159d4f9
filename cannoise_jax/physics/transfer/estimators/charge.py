"""Charge that is not light: dark current and hot pixels, from darks of known exposure."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.dark import RECORD, dark_currents, dark_series
from cannoise_jax.physics.transfer.dark_pixels import FAR, MOST_HOT, PixelLaw, above_level, law_of
from cannoise_jax.physics.transfer.estimate import Z90, Estimate, Estimates, NotMeasurable
from cannoise_jax.physics.transfer.estimator import BY_CHANCE
from cannoise_jax.physics.transfer.estimators.full_pixels import as_unfilled, charge_fills
from cannoise_jax.physics.transfer.estimators.pick import darks_by_exposure
from cannoise_jax.physics.transfer.fit import cut_and_loss, robust_mean_square
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.quiet import coarse, step_of
from cannoise_jax.physics.transfer.views import usual_variance
from cannoise_jax.recordings.packing import site

_SERIES = NotMeasurable(RECORD)
_LONG = NotMeasurable("record darks of a long exposure, tens of seconds, beside short ones")
_NOT_APART = NotMeasurable("hot pixels are not told from the healthy ones: record a longer dark")
_NOISE_DOUBT = 0.05
"""Relative error granted to the noise that is taken out of the spread of pixels, besides chance."""
_LAW_DOUBT = 0.03
"""Relative error granted to a spread of currents for where the tail of ordinary pixels is taken to end."""
_SHORT = 0.5
"""Of the longest exposure, up to which a dark is short beside it: the charge of half the time is left."""
_OF_A_JUMP = 1.5
"""Standard deviations of its jumps up to which the mean of a pixel lies above its lower level: that of one in
its upper level for two frames of three is 1.4."""
_SURE = 3.3
"""Standard errors from which on the spread of pixels counts."""


def dark_current(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """e_per_s, of the pixels that are not hot, from the growth of their mean with exposure; from that of the
    variance where the two disagree (see `transfer.dark`). Channels are averaged. variation, of the same
    pixels, where the longest dark less the shortest shows one beyond its noise."""
    if baseline is None:
        return _SERIES
    darks = darks_by_exposure(statistics)
    found = currents(statistics, baseline)
    # All channels together tell more of few hot pixels than each by itself, and none counts twice.
    known = found is not None and (found.law.shape or found.law.fraction)
    apart = (found.out, not found.law.shape) if found is not None and known else None
    series = dark_series(darks, range(4), baseline.gain, apart)
    if isinstance(series, NotMeasurable):
        return series
    by_mean, by_variance, agree, _ = dark_currents(series, baseline.gain_error)
    rate = by_mean if agree else by_variance
    return {"e_per_s": rate} | _variation(found, rate)


class Currents(NamedTuple):
    """Charge of every pixel beyond the mean of ordinary ones, in the longest dark less the shortest, e-, its
    law, the pixels that are hot or full, the variance of the noise, e-^2, and the seconds between. spread:
    variance over ordinary pixels beyond that noise, and its error."""

    charge: Float[np.ndarray, "H W"]
    law: PixelLaw
    out: Bool[np.ndarray, "H W"]
    noise: float
    seconds: float
    spread: float
    error: float

    @property
    def differ(self) -> bool:
        """Whether ordinary pixels have currents of their own."""
        return self.spread > _SURE * self.error


def currents(statistics: Sequence[FrameStatistics], baseline) -> Currents | None:
    """None without two repeated darks, one much shorter than the other."""
    pair = long_and_short(statistics)
    if pair is None or pair[1] is None or baseline is None or pair[0].clipped.all():
        return None
    long, short, seconds = pair
    charge, law, untold = _charge_and_law(long, short, baseline)
    if untold is not None:  # what no hot pixels hold belongs to the others
        law = law._replace(fraction=0.0)
    out = long.clipped | law.is_hot(charge)
    if out.all():
        return None
    every, noises = charge_map(long, short, baseline)
    noises = noises[~out]
    noise, total = _usual_noise(long, short, baseline), law.variance
    error = total * np.sqrt(2 / noises.size)
    if law.shape:  # noise beside the currents bends the law: their own scatter says more of the tail
        squares = (charge[~out] - charge[~out].mean()) ** 2
        noise, total = float(np.mean(noises)), float(np.mean(squares))
        error = np.std(squares) / np.sqrt(squares.size)
    error = float(np.hypot(error, _NOISE_DOUBT * noise))
    # What is smooth is told from a glow by now, and else the pixels' own.
    return Currents(every - every[~out].mean(), law, out, noise, seconds, total - noise, error)


def _variation(found: Currents | None, rate: Estimate) -> dict[str, Estimate]:
    """Standard deviation of the dark currents of ordinary pixels over their mean; empty where none shows,
    or no mean to be compared with."""
    if found is None or not found.differ or not (rate.value > 0 and rate.significant):
        return {}
    value = float(np.sqrt(found.spread)) / rate.value / found.seconds
    parts = found.error / found.spread / 2, rate.stderr / rate.value, _LAW_DOUBT
    return {"variation": log_estimate(value, float(np.linalg.norm(parts)))}


def grown(
    statistics: Sequence[FrameStatistics], baseline, dark: FrameStatistics
) -> tuple[Float[np.ndarray, "H W"], float] | None:
    """What dark currents that differ add to the pixels of a dark beyond their mean, DN, and the variance of
    noise that the dark less that holds over that of the dark. None where they do not differ."""
    found, pair = currents(statistics, baseline), long_and_short(statistics)
    seconds = dark.recording.exposure_s
    if found is None or not found.differ or pair is None or pair[1] is None or seconds is None:
        return None
    long = pair[0]
    share = seconds / found.seconds
    added = np.where(long.clipped, 0.0, found.charge) * share
    for c in range(4):
        site(added, c)[...] *= baseline.gain[c]
    left = 0.0
    of_dark, of_long, of_short = (s.recording for s in (dark, long, pair[1]))
    for s in {id(s.recording): s for s in (dark, long, pair[1])}.values():
        own = s.recording
        part = float(own is of_dark) - share * float(own is of_long) + share * float(own is of_short)
        left += part**2 * _noise_of_mean(s, baseline)
    return added, left / _noise_of_mean(dark, baseline)


def _noise_of_mean(s: FrameStatistics, baseline) -> float:
    """Variance of the mean of the frames, DN^2."""
    variance = float(np.mean(np.square(baseline.read_noise)))
    return (variance if s.variance is None else float(median(s.variance))) / s.recording.count


def hot_pixels(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """e_per_s (mean over the hot pixels) and fraction: maximum likelihood of a mixture of ordinary pixels and
    hot ones with exponential heights (`transfer.dark_pixels`), on the longest dark less the shortest.

    Heat only adds: where no more pixels lie far above the median than below, none is hot. Of pixels that are
    full in every dark but the shortest it is known that they are hot, and at least as much as fills them.
    """
    pair = long_and_short(statistics)
    if pair is None or baseline is None:
        return _LONG
    long, short, seconds = pair
    if long.clipped.all():
        return NotMeasurable("every pixel of the longest dark is cut off: record a shorter one")
    _, law, untold = _charge_and_law(long, short, baseline)
    if untold is not None or law.errors is None:
        return untold or _NOT_APART
    # Twice the gain of two parameters is a chi-squared of two degrees of freedom by chance.
    rate = dataclasses.replace(
        log_estimate(law.height / seconds, law.errors[1]), chance=float(np.exp(-law.nats))
    )
    within = (0.0, MOST_HOT)
    # Of the logarithm, as few pixels as there are.
    slope = 1 - law.fraction / MOST_HOT
    return {"e_per_s": rate, "fraction": log_estimate(law.fraction, law.errors[0] * slope, within)}


def hot_map(
    statistics: Sequence[FrameStatistics], baseline, e_per_s: float, fraction: float
) -> Float[np.ndarray, "H W"] | None:
    """Heights, in units of their mean, of the pixels that are more likely hot than ordinary; 0 elsewhere."""
    pair = long_and_short(statistics)
    if pair is None or baseline is None:
        return None
    long, short, seconds = pair
    charge, law, _ = _charge_and_law(long, short, baseline)
    law = law._replace(height=e_per_s * seconds, fraction=fraction)
    # Hot pixels have the mean current of the others as well.
    return np.where(law.is_hot(charge), np.maximum(charge - law.mean, 0.0) / law.height, 0.0)


def _charge_and_law(
    long: FrameStatistics, short: FrameStatistics | None, baseline
) -> tuple[Float[np.ndarray, "H W"], PixelLaw, NotMeasurable | None]:
    """Charge of every pixel beyond what a glow shares out, e-, its law, and why that tells no hot pixels.
    Pixels that jump, whose level that is rather than charge, count as ordinary."""
    charge, _ = charge_map(long, short, baseline)
    charge = above_level(charge)
    charge = np.where(_jumps(long, charge, baseline), median(charge), charge)
    if short is None:  # one exposure does not tell offsets of columns and rows from charge
        for axis in (0, 1):
            charge = charge - median(charge, axis=axis, keepdims=True) + median(charge)
    # Means of pixels jump by codes where frames are coarse.
    least = 0.5 * step_of(long) / float(np.mean(baseline.gain)) if coarse(long) else 0.0
    full = charge[charge_fills(long, short)]
    values = charge[~long.clipped]
    top = float(median(full) - median(values)) if full.size else 0.0
    noise = float(np.sqrt(_usual_noise(long, short, baseline)))
    law = law_of(
        values, noise=noise, shot=1 / long.recording.count, least=least, full=full.size, ceiling=max(top, 0.0)
    )
    return charge, law, _no_hot_ones(values, law, full.size)


def _no_hot_ones(values: Float[np.ndarray, "n"], law: PixelLaw, full: int) -> NotMeasurable | None:
    """Why no hot pixels are told, beside those that are full."""
    above = full + int(np.sum(law.is_hot(values) if law.shape else values > law.middle + FAR * law.scale))
    if above - full < 10 or (law.shape and not law.fraction):
        return NotMeasurable("fewer than ten hot pixels: record a longer dark, or a larger frame")
    below = int(np.sum(values < law.middle - FAR * law.width))
    if stats.binom.sf(above - 1, above + below, 0.5) > BY_CHANCE:
        return NotMeasurable(
            "as many pixels lie far below the median as above, and hot ones lie above: record a longer dark"
        )
    return _NOT_APART if law.errors is None else None


def _usual_noise(long: FrameStatistics, short: FrameStatistics | None, baseline) -> float:
    """Variance of the noise of the charge of a usual pixel, e-^2, by the median over the pixels."""
    found = 0.0
    for s in (long,) if short is None else (long, short):
        for c in range(4):
            read = baseline.read_noise[c] ** 2
            usual = read if s.variance is None else usual_variance(s, c)
            found += usual / baseline.gain[c] ** 2 / s.recording.count / 4
    return found


def _jumps(long: FrameStatistics, charge: Float[np.ndarray, "H W"], baseline) -> Bool[np.ndarray, "H W"]:
    """Pixels that change from frame to frame by more than the shot noise of their charge, and by as much as
    they lie above the others: they jump between the level of those and a higher one."""
    out = np.zeros(charge.shape, bool)
    if long.variance is None:
        return out
    cut, _ = cut_and_loss(long.dof)
    for c in range(4):
        variance, gain = site(long.variance, c), baseline.gain[c]
        above = gain * (site(charge, c) - float(median(charge)))
        expected = robust_mean_square(variance, long.dof)[0] + gain * np.maximum(above, 0.0)
        excess = np.sqrt(np.maximum(variance - expected, 0.0))
        site(out, c)[...] = (variance > cut * expected) & (above < _OF_A_JUMP * excess)
    return out


def log_estimate(value: float, error: float, within: tuple[float, float] = (0.0, np.inf)) -> Estimate:
    """A positive value, within some bounds, whose logarithm has a Gaussian error. Where that error exceeds
    one the value may be zero, which no logarithm reaches: its own error is then taken as Gaussian."""
    stderr = value * float(error)
    ends = value + Z90 * stderr * np.array([-1, 1])
    if error <= 1:
        ends = value * np.exp(Z90 * error * np.array([-1, 1]))
    low, high = np.clip(ends, *within)
    return Estimate(value, stderr, (float(low), float(high)))


def long_and_short(
    statistics: Sequence[FrameStatistics],
) -> tuple[FrameStatistics, FrameStatistics | None, float] | None:
    """The longest dark, the shortest if it is of at most half its exposure, and the seconds between. Pixels
    that are full in the longest are those of shorter ones (`as_unfilled`)."""
    darks = darks_by_exposure(statistics)
    if not darks:
        return None
    long, short = darks[-1], darks[0]
    long_s, short_s = long.recording.exposure_s or 0.0, short.recording.exposure_s or 0.0
    if long_s <= 0:
        return None
    if short_s > _SHORT * long_s:
        return long, None, long_s
    return as_unfilled(long, short, darks), short, long_s - short_s


def charge_map(
    long: FrameStatistics, short: FrameStatistics | None, baseline
) -> tuple[Float[np.ndarray, "H W"], Float[np.ndarray, "H W"]]:
    """Electrons that the long dark has more than the short one (or than black), and their variance."""
    charge, variance = np.empty(long.mean.shape), np.zeros(long.mean.shape)
    for c in range(4):
        base = baseline.black_level[c] if short is None else site(short.mean, c)
        site(charge, c)[...] = (site(long.mean, c) - base) / baseline.gain[c]
        for s in (long,) if short is None else (long, short):
            noise = baseline.read_noise[c] ** 2 if s.variance is None else site(s.variance, c)
            site(variance, c)[...] += noise / baseline.gain[c] ** 2 / s.recording.count
    return charge, variance
