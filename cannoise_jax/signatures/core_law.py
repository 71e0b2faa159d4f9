"""The law of the levels of most pixels, from which a few hot ones stand out.

Without a dark current of their own pixels differ by noise, which is normal. Dark currents that differ from
pixel to pixel do not: impurities make them gamma- or log-normally distributed, with a tail towards the warm
side that no pixel is out of. Both are fitted to the levels below the median, which hot pixels do not move, as
a law of mean 0 and standard deviation 1 with this skewness; which of them holds is told by the likelihood of
all levels, hot pixels beside it.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import optimize, signal, stats

from cannoise_jax.signatures.rare import CENTRES, HEATS, log_ratio_of, table_of

NORMAL, GAMMA, LOGNORMAL = "normal", "gamma", "log-normal"
_BELOW = (0.02, 0.2, 0.5)
"""Quantiles that tell the skewness: one hot pixel in a hundred moves it by 0.04."""
_SKEWS = np.linspace(0.02, 2.5, 125)
"""Skewnesses that are told apart, from next to none to beyond that of exponential currents, 2."""
_SURE = 3.0
"""Standard errors from which on levels count as skewed."""
_ERROR = 9.0
"""Standard error of the skewness times the root of the number of levels: 8.4 to 9.2 of 5,000 to 50,000 normal
ones."""
_OPEN = (1.0, 2.0, 3.0, 4.0)
"""Standard errors by which the skewness may be more than the lower half has it: where hits were taken out, or
noise moves whole rows, gamma-distributed currents of variation 0.25 had 1 to 4 less."""
_INNER = {GAMMA: tuple(0.5 * 1.3 ** np.arange(9)), LOGNORMAL: tuple(0.5 * 1.3 ** np.arange(17))}
"""Skewnesses of currents beside normal values from which on the likeliest is looked for. Gamma-distributed
ones vary by half of it, up to twice their mean; of log-normal ones the logarithm varies by up to 1.5."""
_NORMAL = (0.0003, 0.001, 0.003, 0.01, 0.03, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8)
"""Shares of the variance that the normal values may have."""
_REFINED = 40
"""Laws tried on the way from the best of these to the likeliest."""
_BULK, _TAKEN = 0.98, 4
"""Share of the levels, the lowest, that tell such laws, and how many of these are looked at further."""
_SMALL = 1e-13
"""Density below which a sum that is worked out by transforms is rounding."""
_STEP, _LAST = 0.01, 60.0
_GRID = np.arange(-8.0, _LAST, _STEP)
"""Where densities are worked out, standard deviations; beyond, a sum falls as the exponential part does."""
_LEAST, _BELOW_ALL = -700.0, -12.0
"""Least logarithm of a density, and that of levels below the law's own least, where noise puts a few."""


class Core(NamedTuple):
    """The law of the levels of pixels that are not hot, in standard deviations of their noise: centre and
    spread, and of what is left the law and its skewness, beside normal values that have a share of the
    variance."""

    spread: float = 1.0
    centre: float = 0.0
    law: str = NORMAL
    skew: float = 0.0
    normal: float = 0.0

    def standard(self, u: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """The levels with this law's mean at 0 and its standard deviation 1."""
        return (u - self.centre) / self.spread

    def log_density(self, u: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Of standard levels."""
        least = np.where((u < 0) & (self.law != NORMAL), _BELOW_ALL, _LEAST)
        return np.maximum(_of(self.law, self.skew, self.normal).logpdf(u), least)

    def far(self, chance: float) -> float:
        """The standard level that so few pixels lie beyond."""
        return float(_of(self.law, self.skew, self.normal).isf(chance))

    def log_ratio(
        self, u: Float[np.ndarray, "*n"], mean: Float[np.ndarray, "*n"] | float
    ) -> Float[np.ndarray, "*n"]:
        """Log density of a standard level plus an exponential one of this mean over the level's alone; of
        levels that are not normal, of the median of the means."""
        if self.law == NORMAL:
            return log_ratio_of(u, mean)
        return np.maximum(self.log_sum(u, float(np.median(mean))) - self.log_density(u), -50)

    def log_sum(self, u: Float[np.ndarray, "*n"], mean: float) -> Float[np.ndarray, "*n"]:
        """Log density of a standard level plus an exponential one of this mean."""
        if self.law == NORMAL:
            return log_ratio_of(u, mean) + stats.norm.logpdf(u)
        sums, _ = _added(self.law, self.skew, self.normal, mean)
        return np.interp(u, _GRID, sums) - np.maximum(u - _GRID[-1], 0.0) / mean

    def table(self) -> np.ndarray | None:
        """What `log_mixture` needs of levels that are not normal."""
        return None if self.law == NORMAL else _table(self.law, self.skew, self.normal)

    def height(self, u: Float[np.ndarray, "*n"], mean: float) -> Float[np.ndarray, "*n"]:
        """Mean of the exponential part of a standard level."""
        if self.law == NORMAL:
            inner = u - 1 / mean
            return inner + np.exp(stats.norm.logpdf(inner) - stats.norm.logcdf(inner))
        _, heights = _added(self.law, self.skew, self.normal, mean)
        return np.interp(u, _GRID, heights) + np.maximum(u - _GRID[-1], 0.0)


@lru_cache(maxsize=16)
def _table(law: str, skew: float, normal: float) -> np.ndarray:
    core = Core(law=law, skew=skew, normal=normal)
    return table_of([core.log_ratio(CENTRES, float(mean)) for mean in HEATS])


def skewed(u: Float[np.ndarray, "n"]) -> tuple[Core, ...]:
    """The laws whose lower half is that of the levels; none where that is skewed no more than by chance."""
    told = ((law, round(_lower_half(u, law), 2)) for law in (GAMMA, LOGNORMAL))  # so that tables are shared
    return tuple(_through(u, law, skew) for law, skew in told if skew > _SURE * _ERROR / np.sqrt(u.size))


def level(u: Float[np.ndarray, "n"], share: float = 0.0) -> Core:
    """The normal law whose lower half is that of the levels, but for a share of them, which is above."""
    _, middle, median = np.quantile(u, np.array(_BELOW) * (1 - share))
    return Core(float(median - middle) / float(-stats.norm.ppf(_BELOW[1])), float(median))


def left_open(u: Float[np.ndarray, "n"]) -> tuple[Core, ...]:
    """Laws of more skewness, as far as the lower half of the levels leaves it open."""
    error, out = _ERROR / np.sqrt(u.size), []
    for law in (GAMMA, LOGNORMAL):
        least = _lower_half(u, law)
        skews = [min(round(least + k * error, 2), float(_SKEWS[-1])) for k in _OPEN]
        out += [_through(u, law, skew) for skew in skews if least > 0]
    return tuple(out)


def widened(u: Float[np.ndarray, "n"]) -> tuple[Core, ...]:
    """The laws with normal values beside them that have the bulk of the levels best, `_TAKEN` of each kind
    and the likeliest about the best of these.

    Offsets of pixels, and noise, make the lower half of the levels more normal than currents are, whose tail
    is then longer than the lower half says."""
    ordered = np.sort(u)
    cut = ordered[int(_BULK * u.size)]
    counts, edges = np.histogram(ordered[ordered < cut], 400)
    centres, above = (edges[1:] + edges[:-1]) / 2, u.size - int(counts.sum())
    _, middle, median = np.quantile(ordered, _BELOW)
    if not middle < median:
        return ()

    def nats(core: Core) -> float:
        law = _of(core.law, core.skew, core.normal)
        inside = float(counts @ core.log_density(core.standard(centres))) - counts.sum() * np.log(core.spread)
        over = np.log(max(-float(np.expm1(law.logcdf(core.standard(cut)))), 1e-12))
        return inside + above * float(over)

    def through(law: str, skew: float, normal: float) -> Core:
        _, inner, centre = _of(law, skew, normal).ppf(_BELOW)
        spread = float(median - middle) / float(centre - inner)
        return Core(spread, float(median - spread * centre), law, skew, normal)

    def likeliest(near: Core) -> Core:
        """The law near this one that has the bulk best."""
        bounds = [(np.log(values[0]), np.log(values[-1])) for values in (_INNER[near.law], _NORMAL)]

        def at(logs: np.ndarray) -> Core:
            return through(near.law, *np.round(np.exp(logs), 4))

        start = np.log([near.skew, near.normal])
        simplex = start + np.array([[0, 0], [0.15, 0], [0, 0.4]]) * np.where(
            start > np.mean(bounds, 1), -1, 1
        )
        options = {"maxfev": _REFINED, "initial_simplex": simplex}
        told = optimize.minimize(
            lambda logs: -nats(at(logs)), start, method="Nelder-Mead", bounds=bounds, options=options
        )
        return at(told.x)

    out: list[Core] = []
    for law in (GAMMA, LOGNORMAL):
        tried = [through(law, skew, normal) for skew in _INNER[law] for normal in _NORMAL]
        best = sorted(tried, key=nats)[-_TAKEN:]
        out += [*best, likeliest(best[-1])]
    return tuple(out)


def _lower_half(u: Float[np.ndarray, "n"], law: str) -> float:
    """Skewness of the law whose lower half is that of the levels; 0: of none."""
    low, middle, median = np.quantile(u, _BELOW)
    if not middle < median:
        return 0.0
    return float(np.interp(-(median - low) / (median - middle), -_quantiles(law)[0], _SKEWS))


def _through(u: Float[np.ndarray, "n"], law: str, skew: float) -> Core:
    """The law of this skewness that has the median of the levels and the quantile below it."""
    _, middle, median = np.quantile(u, _BELOW)
    _, middles, medians = _quantiles(law)
    inner, centre = (float(np.interp(skew, _SKEWS, q)) for q in (middles, medians))
    spread = float(median - middle) / (centre - inner)
    return Core(spread, float(median) - spread * centre, law, skew)


@lru_cache(maxsize=1024)
def _of(law: str, skew: float, normal: float = 0.0):
    """The law of mean 0, standard deviation 1 and this skewness, but for normal values beside it."""
    if law == NORMAL:
        return stats.norm()
    if normal:
        return _Sum(_of(law, skew), normal)
    if law == GAMMA:
        return stats.pearson3(skew)
    grown = _spread_of_logs(skew)
    scale = float(1 / np.sqrt(np.exp(grown**2) * np.expm1(grown**2)))
    return stats.lognorm(grown, loc=-scale * np.exp(grown**2 / 2), scale=scale)


class _Sum:
    """The law of the sum of a value of mean 0 and standard deviation 1 and a normal one, which has a share of
    the variance, on a grid; beyond it that of the first of them."""

    def __init__(self, law, normal: float):
        self.law, self.root = law, np.sqrt(1 - normal)
        edges = np.append(_GRID - _STEP / 2, _GRID[-1] + _STEP / 2)
        mass = np.diff(law.cdf(edges / self.root))
        width = int(np.ceil(8 * np.sqrt(normal) / _STEP))
        kernel = np.exp(-0.5 * (np.arange(-width, width + 1) * _STEP) ** 2 / normal)
        density = signal.fftconvolve(mass, kernel / kernel.sum(), "same") / _STEP
        # What is left of sums by transforms is chance; far out the law is all that there is.
        far = np.exp(law.logpdf(_GRID / self.root)) / self.root
        density = np.where((density < _SMALL) & (_GRID > 0), far, np.maximum(density, 0.0))
        self.log = np.log(np.maximum(density, np.exp(_LEAST)))
        self.below = np.cumsum(density) * _STEP
        self.below /= self.below[-1] / (1 - law.sf(edges[-1] / self.root))

    def logpdf(self, u):
        far = self.law.logpdf(np.maximum(u, _GRID[-1]) / self.root) - np.log(self.root)
        return np.where(u > _GRID[-1], far, np.interp(u, _GRID, self.log, left=_LEAST))

    def ppf(self, chance):
        return np.interp(chance, self.below, _GRID + _STEP / 2)

    def isf(self, chance):
        told = self.ppf(1 - np.asarray(chance))
        return np.where(self.below[-1] > 1 - np.asarray(chance), told, self.root * self.law.isf(chance))

    def logcdf(self, u):
        return np.log(np.maximum(np.interp(u, _GRID + _STEP / 2, self.below), 1e-300))


def _spread_of_logs(skew: float) -> float:
    """Standard deviation of the logarithm of log-normal values of this skewness."""
    return float(optimize.brentq(lambda s: (np.exp(s**2) + 2) * np.sqrt(np.expm1(s**2)) - skew, 1e-4, 1.5))


@lru_cache(maxsize=2)
def _quantiles(law: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """By skewness: how far the lowest of `_BELOW` lies below the median over how far the middle one does, the
    middle one, and the median."""
    low, middle, median = np.array([_of(law, float(s)).ppf(_BELOW) for s in _SKEWS]).T
    return (median - low) / (median - middle), middle, median


@lru_cache(maxsize=512)
def _added(law: str, skew: float, normal: float, mean: float) -> tuple[np.ndarray, np.ndarray]:
    """On `_GRID`, log density of the law plus an exponential value, and the mean of that value in the sum."""
    density = np.exp(_of(law, skew, normal).logpdf(_GRID))
    kept = np.exp(-_STEP / mean)
    once = signal.lfilter([1 - kept], [1, -kept], density)
    twice = signal.lfilter([1 - kept], [1, -kept], once)
    tiny = np.finfo(float).tiny
    return np.log(np.maximum(once, tiny)), mean * twice / np.maximum(once, tiny)
