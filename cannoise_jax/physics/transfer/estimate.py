"""What a measurement gives: a value with its interval, or the reason why the recordings cannot give it.

Amplitudes that are variances minus other variances follow one rule everywhere: the mean squares behave as
chi-square, their difference gets the modified-large-sample interval of Graybill and Wang (J. Am. Stat. Assoc.
75, 1980), which keeps its coverage when the difference is near or below zero; the interval is cut at zero
and its square root is taken. The estimate itself is the root of the difference, 0 where that is negative.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import stats

_TAIL = 0.05  # of a 90 % interval
Z90 = 1.6449
"""Standard errors on each side of a 90 % interval."""


@dataclass(frozen=True)
class Estimate:
    """A measured value, its standard error and 90 % interval, all in the unit of the value.

    chance: with which a true value of zero shows as much, where that is not as Gaussian errors have it. (The
    root of a variance is not: at three standard errors above zero the variance is at one and a half.)
    """

    value: float
    stderr: float
    ci90: tuple[float, float]
    chance: float | None = None

    def scaled(self, factor: float) -> Estimate:
        """The same measurement in another unit."""
        low, high = sorted((self.ci90[0] * factor, self.ci90[1] * factor))
        return Estimate(self.value * factor, self.stderr * abs(factor), (low, high), self.chance)

    def shifted(self, by: float) -> Estimate:
        """The same measurement with a known number added."""
        return Estimate(self.value + by, self.stderr, (self.ci90[0] + by, self.ci90[1] + by))

    def of_which(self, other: float) -> Estimate:
        """The same measurement, of which up to `other` may be something else."""
        if not other:
            return self
        low = self.ci90[0] - other
        sure = Estimate(self.value - other, self.stderr, (low, self.ci90[1] - other)).by_chance
        return Estimate(self.value, self.stderr, (low, self.ci90[1]), sure if self.value > other else 1.0)

    @property
    def by_chance(self) -> float:
        """The chance with which a true value of zero shows as much (both signs where both can be)."""
        if self.chance is not None:
            return self.chance
        if self.stderr <= 0:
            return 0.0 if self.value else 1.0
        return float(2 * stats.norm.sf(abs(self.value) / self.stderr))

    @property
    def significant(self) -> bool:
        """Whether the 90 % interval leaves out zero."""
        return not self.ci90[0] <= 0.0 <= self.ci90[1]


@dataclass(frozen=True)
class NotMeasurable:
    """The recordings cannot give this quantity. record: what to record to get it. answered: nothing need be
    recorded, for `record` says why there is none of it."""

    record: str
    answered: bool = False


Outcome = Estimate | NotMeasurable
Estimates = Mapping[str, Estimate] | NotMeasurable


def normal_estimate(value: float, stderr: float, dof: float = np.inf) -> Estimate:
    """An estimate with Gaussian error; `dof`: degrees of freedom behind its `stderr` (Student t)."""
    half = float(stats.t.ppf(1 - _TAIL, dof)) * stderr if np.isfinite(dof) else Z90 * stderr
    known = np.isfinite(dof) and stderr > 0
    chance = float(2 * stats.t.sf(abs(value) / stderr, dof)) if known else None
    return Estimate(float(value), float(stderr), (float(value - half), float(value + half)), chance)


def scatter_estimate(values: Float[np.ndarray, "n"]) -> Estimate:
    """The mean of independent, equally good measurements, its error from their scatter."""
    values = np.asarray(values, np.float64)
    return normal_estimate(values.mean(), values.std(ddof=1) / np.sqrt(len(values)), len(values) - 1)


def jackknife_estimate(value: float, left_out: Float[np.ndarray, "n"]) -> Estimate:
    """A value and its error from the values with one block at a time left out."""
    left_out = np.asarray(left_out, np.float64)
    count = len(left_out)
    stderr = np.sqrt((count - 1) / count * np.sum((left_out - left_out.mean()) ** 2))
    return normal_estimate(value, float(stderr), count - 1)


def variance_estimate(square: float, dof: float) -> Estimate:
    """A variance from a mean square with a chi-square distribution of `dof` degrees of freedom."""
    low, high = dof / stats.chi2.ppf((1 - _TAIL, _TAIL), dof)
    return Estimate(
        float(square), float(square * np.sqrt(2 / dof)), (float(square * low), float(square * high))
    )


def variance_difference(first: float, first_dof: float, second: float, second_dof: float) -> Estimate:
    """`first - second` of two independent mean squares (Graybill and Wang 1980), not cut at zero."""
    one, two = float(first), float(second)
    f = stats.f.ppf
    upper, lower = f(1 - _TAIL, first_dof, second_dof), f(_TAIL, first_dof, second_dof)
    g1, h1 = (
        1 - first_dof / stats.chi2.ppf(1 - _TAIL, first_dof),
        first_dof / stats.chi2.ppf(_TAIL, first_dof) - 1,
    )
    g2, h2 = (
        1 - second_dof / stats.chi2.ppf(1 - _TAIL, second_dof),
        second_dof / stats.chi2.ppf(_TAIL, second_dof) - 1,
    )
    g12 = ((upper - 1) ** 2 - g1**2 * upper**2 - h2**2) / upper
    h12 = ((1 - lower) ** 2 - h1**2 * lower**2 - g2**2) / lower
    below = g1**2 * one**2 + h2**2 * two**2 + g12 * one * two
    above = h1**2 * one**2 + g2**2 * two**2 + h12 * one * two
    stderr = np.sqrt(2 * one**2 / first_dof + 2 * two**2 / second_dof)
    value = one - two
    low, high = value - float(np.sqrt(max(below, 0))), value + float(np.sqrt(max(above, 0)))
    chance = float(stats.f.sf(one / two, first_dof, second_dof)) if two > 0 else float(one <= 0)
    return Estimate(value, float(stderr), (low, high), chance)


def root(variance: Estimate) -> Estimate:
    """The rms that belongs to a variance: value and interval cut at zero and rooted, the error by the slope
    of the root (at one standard error where the variance is not above it). Where the whole interval lies
    below zero it reaches up to one standard error, so that it is never empty."""
    value = np.sqrt(max(variance.value, 0.0))
    low = float(np.sqrt(max(variance.ci90[0], 0.0)))
    high = float(np.sqrt(variance.ci90[1] if variance.ci90[1] > 0 else variance.stderr))
    reach = max(variance.value, variance.stderr)
    stderr = variance.stderr / (2 * np.sqrt(reach)) if reach > 0 else 0.0
    return Estimate(float(value), float(stderr), (low, high), variance.by_chance if value else 1.0)


def heavy_dof(values: Float[np.ndarray, "*n"], count: float | None = None) -> float:
    """Degrees of freedom of the mean square of `values`: fewer than their count when their tails are heavy,
    since var(s^2)/s^4 = (2 + excess kurtosis)/n."""
    values = np.asarray(values, np.float64)
    count = values.size if count is None else count
    centred = values - values.mean()
    square = np.mean(centred**2)
    if square <= 0:
        return float(count)
    excess = np.mean(centred**4) / square**2 - 3
    return float(max(2.0, count / (1 + max(excess, -1.0) / 2)))
