"""Charge that is not light: dark current and hot pixels, from darks of known exposure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import optimize, special, stats

from cannoise_jax.physics.transfer.dark import RECORD, Series, dark_currents, dark_series
from cannoise_jax.physics.transfer.estimate import Z90, Estimate, Estimates, NotMeasurable
from cannoise_jax.physics.transfer.estimator import BY_CHANCE
from cannoise_jax.physics.transfer.estimators.pick import darks_by_exposure
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.quiet import coarse, step_of
from cannoise_jax.recordings.packing import site

_SERIES = NotMeasurable(RECORD)
_LONG = NotMeasurable("record darks of a long exposure, tens of seconds, beside short ones")
_FAR = 6.0
"""Spreads of the healthy pixels beyond which a pixel is not one of them."""
_FLAT = 1e12
"""Ratio of curvatures beyond which a likelihood is flat along a parameter."""


def dark_current(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """e_per_s, from the growth of the mean with exposure; from that of the variance where the two disagree
    (see `transfer.dark`). Channels are averaged."""
    if baseline is None:
        return _SERIES
    darks = darks_by_exposure(statistics)
    channels = []
    for c in range(4):
        series = dark_series(darks, c, baseline.gain[c])
        if isinstance(series, NotMeasurable):
            return series
        channels.append(series)
    pooled = Series(*(np.mean([getattr(s, name) for s in channels], 0) for name in Series._fields))
    by_mean, by_variance, agree, _ = dark_currents(pooled, baseline.gain_error)
    return {"e_per_s": by_mean if agree else by_variance}


def hot_pixels(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """e_per_s (mean over the hot pixels) and fraction: maximum likelihood of a mixture of healthy pixels and
    hot ones with exponential heights, on the longest dark less the shortest.

    The spread of the healthy ones, fixed pattern included, is taken from the quartiles. Heat only adds: what
    lies far below the median has another cause, which is taken to reach as far above it (a Laplace tail);
    where no more pixels lie far above than below, none is hot. Of pixels that are full it is known that they
    are hot, and at least as much as fills them.
    """
    pair = _long_and_short(statistics)
    if pair is None or baseline is None:
        return _LONG
    long, short, seconds = pair
    if long.clipped.all():
        return NotMeasurable("every pixel of the longest dark is cut off: record a shorter one")
    charge, sigma = _above_healthy(long, short, baseline)
    values = charge[~long.clipped].ravel()
    tail, below = values[values > _FAR * sigma], -values[values < -_FAR * sigma]
    full = charge[long.clipped & (long.mean > long.recording.white_level / 2)]
    ceiling = float(np.median(full)) if full.size else 0.0
    if len(tail) < 10:
        return NotMeasurable("fewer than ten hot pixels: record a longer dark, or a larger frame")
    above = len(tail) + full.size
    if stats.binom.sf(above - 1, above + len(below), 0.5) > BY_CHANCE:
        return NotMeasurable(
            "as many pixels lie far below the median as above, and hot ones lie above: record a longer dark"
        )
    others = _Healthy.of(values, sigma)
    if not others.share:
        values = values[values > -8 * sigma]

    healthy = others.density(values)

    def negative(p: np.ndarray) -> float:
        fraction, mean = special.expit(p[0]), np.exp(p[1])
        hot = 0.5 / mean * _exponential_tail(values, sigma, mean)
        seen = float(np.sum(np.log((1 - fraction) * healthy + fraction * hot + 1e-300)))
        return -seen - full.size * (np.log(fraction + 1e-300) - ceiling / mean)

    hot_share = max(above - len(below), 1) / (len(values) + full.size)
    start = np.array([special.logit(min(1.2 * hot_share, 0.4)), np.log(np.r_[tail, full].mean())])
    fit = optimize.minimize(negative, start, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-3})
    errors = fit_errors(hessian(negative, fit.x, np.array([0.05, 0.05])))
    if errors is None:
        return NotMeasurable("hot pixels are not told from the healthy ones: record a longer dark")
    fraction = float(special.expit(fit.x[0]))
    ends = special.expit(fit.x[0] + Z90 * errors[0] * np.array([-1, 1]))
    return {
        "e_per_s": log_estimate(float(np.exp(fit.x[1])) / seconds, float(errors[1])),
        "fraction": Estimate(
            fraction, float(errors[0]) * fraction * (1 - fraction), (float(ends[0]), float(ends[1]))
        ),
    }


def hot_map(
    statistics: Sequence[FrameStatistics], baseline, e_per_s: float, fraction: float
) -> Float[np.ndarray, "H W"] | None:
    """Heights, in units of their mean, of the pixels that are more likely hot than healthy; 0 elsewhere."""
    pair = _long_and_short(statistics)
    if pair is None or baseline is None:
        return None
    long, short, seconds = pair
    charge, sigma = _above_healthy(long, short, baseline)
    mean = e_per_s * seconds
    healthy = _Healthy.of(charge[~long.clipped], sigma).density(charge)
    hot = 0.5 / mean * _exponential_tail(charge, sigma, mean)
    likely = (fraction * hot > (1 - fraction) * healthy) & (charge > 0)
    return np.where(likely, charge / mean, 0.0)


class _Healthy(NamedTuple):
    """Charge of the healthy pixels: a Gaussian, and a share of Laplace tails of a reach, e-, where some lie
    far below the median."""

    sigma: float
    share: float
    reach: float

    @staticmethod
    def of(charge: np.ndarray, sigma: float) -> _Healthy:
        """From the pixels far below the median; fewer than ten, whose law is unknown, count as none."""
        below = -charge[charge < -_FAR * sigma]
        if len(below) < 10:
            return _Healthy(sigma, 0.0, sigma)
        reach = float(np.mean(below)) - _FAR * sigma
        share = 2 * len(below) / charge.size * np.exp(min(_FAR * sigma / reach, 50.0))
        return _Healthy(sigma, min(float(share), 0.5), reach)

    def density(self, charge: np.ndarray) -> np.ndarray:
        """Per electron."""
        middle = np.exp(-0.5 * np.minimum((charge / self.sigma) ** 2, 700)) / np.sqrt(2 * np.pi) / self.sigma
        tails = np.exp(-np.minimum(np.abs(charge) / self.reach, 700)) / (2 * self.reach)
        return (1 - self.share) * middle + self.share * tails


def _above_healthy(
    long: FrameStatistics, short: FrameStatistics | None, baseline
) -> tuple[Float[np.ndarray, "H W"], float]:
    """Charge above the median pixel, e-, and the spread of the healthy pixels, from the quartiles."""
    charge, _ = charge_map(long, short, baseline)
    low, middle, high = np.percentile(charge[~long.clipped], (25, 50, 75))
    sigma = float(high - low) / 1.349
    if coarse(long):  # means of pixels jump by codes
        sigma = max(sigma, 0.5 * step_of(long) / float(np.mean(baseline.gain)))
    return charge - middle, sigma


def hessian(
    function: Callable[[np.ndarray], float], at: np.ndarray, step: np.ndarray
) -> Float[np.ndarray, "n n"]:
    """Second derivatives by central differences."""
    count = len(at)
    out = np.empty((count, count))
    unit = np.diag(step)
    for i in range(count):
        for j in range(i, count):
            corners = [
                a * b * function(at + a * unit[i] + b * unit[j]) for a in (1, -1) for b in (1, -1)
            ]  # fmt: skip
            out[i, j] = out[j, i] = sum(corners) / (4 * step[i] * step[j])
    return out


def fit_errors(curvature: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n"] | None:
    """Standard errors of parameters, from the second derivatives of minus the log-likelihood; None where it
    does not depend on one of them."""
    if not np.isfinite(curvature).all() or np.linalg.cond(curvature) > _FLAT:
        return None
    return np.sqrt(np.abs(np.diag(np.linalg.inv(curvature))))


def log_estimate(value: float, error: float, within: tuple[float, float] = (0.0, np.inf)) -> Estimate:
    """A positive value, within some bounds, whose logarithm has a Gaussian error. Where that error exceeds
    one the value may be zero, which no logarithm reaches: its own error is then taken as Gaussian."""
    stderr = value * float(error)
    ends = value + Z90 * stderr * np.array([-1, 1])
    if error <= 1:
        ends = value * np.exp(Z90 * error * np.array([-1, 1]))
    low, high = np.clip(ends, *within)
    return Estimate(value, stderr, (float(low), float(high)))


def _exponential_tail(x: np.ndarray, sigma: float, mean: float) -> np.ndarray:
    """2 mean times the density of an exponential of a given mean plus a Gaussian, without overflow."""
    argument = (sigma / mean - x / sigma) / np.sqrt(2)
    safe = np.maximum(argument, -25.0)
    bulk = np.exp(-0.5 * (x / sigma) ** 2) * special.erfcx(safe)
    return np.where(argument > -25.0, bulk, 2 * np.exp(0.5 * (sigma / mean) ** 2 - x / mean))


def _long_and_short(
    statistics: Sequence[FrameStatistics],
) -> tuple[FrameStatistics, FrameStatistics | None, float] | None:
    """The longest dark, one of at most a tenth of its exposure if there is one, and the seconds between."""
    darks = darks_by_exposure(statistics)
    if not darks:
        return None
    long, short = darks[-1], darks[0]
    long_s, short_s = long.recording.exposure_s or 0.0, short.recording.exposure_s or 0.0
    if long_s <= 0:
        return None
    return (long, short, long_s - short_s) if short_s <= 0.1 * long_s else (long, None, long_s)


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
