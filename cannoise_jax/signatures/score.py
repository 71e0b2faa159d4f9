"""What a statistic returns, and the tails of the laws they follow."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Generic, NamedTuple, Self, TypeVar

import numpy as np
from scipy import optimize, special, stats

from cannoise_jax.physics.core.places import place
from cannoise_jax.physics.transfer.estimate import Z90

P = TypeVar("P")

ONE_PARAMETER = 5.0
"""Nats that a free parameter costs: 0.5 log(n) (Schwarz 1978, Ann. Stat. 6, 461) of n = 22,000 values. For
1,000 to 1,000,000 it would be 3.5 to 6.9."""
ONE_OF_SEVERAL = 2.5
"""Nats of each of several parameters that explain one thing together (a shift of every scene): half of what
one costs alone, 0.5 log(n) of n = 150 values."""
KNOWN_SHAPE = float(0.5 * np.log(1e5)) / 2
"""Nats of the strength of a shape that is known, 2.9: half of 0.5 log(n) of n = 100,000 pixels. By the Occam
factor of a parameter, the log of its range over sqrt(2 pi) errors (MacKay 2003, Information Theory,
Inference, and Learning Algorithms, section 28.1), a range of 45 errors costs as much."""
OF_A_CURVE = 7.0
"""Nats of a departure from a curve: two parameters (where, how far) of 1,000 points, 2 x 0.5 log(1,000) =
6.9. Eight sets of straight curves gained 3.2 on average and 7.5 at most."""
SHARE_OF_FEW = 2.0
"""Nats of the share of a few pixels, their places paid for one by one: 0.5 log(n) of n = 55 of them."""


@dataclass(frozen=True, kw_only=True)
class Score(Generic[P]):
    """One mechanism against the data.

    log_p: natural log of the p-value, the search inside the family (frequencies, templates) accounted for.
    gain: log-likelihood gain of the best fit over the baseline, nats; penalty: nats that its free parameters
    and its search cost. amplitude, error: in the mechanism's unit. shift: amplitude that moves the statistic
    by one null standard deviation; power: the statistic grows as amplitude ** power. spot: what it says of
    where in the frames it is (a frequency, a boundary), and how far two fits of one effect may lie apart.
    payload: what the functions of its own family need again, of a type that they alone know.
    drawn: number of independent draws whose scatter the amplitude is; infinite: of a fixed value or of many.
    too_much: whether the simulator has too much of it, not too little. where: the place (`axis`, of
    `physics.core.places`) and what is known of it. Raises ValueError for a place that there is not.
    """

    log_p: float
    gain: float
    penalty: float
    amplitude: float
    error: float
    shift: float
    power: int
    parameters: dict[str, tuple[float, str, float]]
    where: dict[str, Any]
    payload: P = None  # type: ignore[assignment]
    spot: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    too_much: bool = False
    drawn: float = float("inf")

    def __post_init__(self):
        place(self.where.get("axis"))

    def replace(self, **changes: Any) -> Self:
        """The score with some of its fields changed."""
        return dataclasses.replace(self, **changes)

    @property
    def evidence(self) -> float:
        """Penalised log-likelihood gain, nats."""
        return self.gain - self.penalty

    @property
    def interval90(self) -> tuple[float, float]:
        """90 % interval of the amplitude. That of few draws is chi-squared, of their variance with the noise
        in it, from which the noise is taken: three frames may by chance lie far closer together than their
        law says, and hardly farther apart."""
        value, error, n = self.amplitude, self.error, self.drawn
        low, high = value - Z90 * error, value + Z90 * error
        if self.power != 2:
            return low, high
        total = 2 * value * error * np.sqrt(n / 2) if np.isfinite(n) else np.inf
        if not 0 < total < np.inf:
            return max(low, 0.0), high
        total = max(total, value**2)  # no error is below that of the draws themselves
        noise = total - value**2
        least, most = (total * n / stats.chi2.isf(p, n) - noise for p in (0.05, 0.95))
        return float(np.sqrt(max(least, 0.0))), float(np.sqrt(max(most, value**2)))

    def same_spot(self, other: Score) -> bool:
        """Whether both put the effect at the same frequency, boundary or period."""
        both = ((a, other.spot[name]) for name, a in self.spot.items() if name in other.spot)
        return not any(abs(a - b) > max(reach, other_reach) for (a, reach), (b, other_reach) in both)

    @property
    def mde(self) -> float:
        """Amplitude at which the mean of the statistic is shifted by five null standard deviations."""
        return self.shift * 5 ** (1 / self.power)


LEAST_LOG_P = -700.0
"""Below this log p is told as this: its exponential is near the least number that is told from zero."""


def p_of(log_p: float) -> float:
    """The p-value of its logarithm, above zero however small."""
    return math.exp(max(log_p, LEAST_LOG_P))


def sidak(log_p: float, count: float) -> float:
    """log p of the smallest of `count` independent p-values."""
    if log_p < -30:
        return min(0.0, log_p + math.log(count))
    return float(np.log(-np.expm1(count * np.log1p(-min(math.exp(log_p), 1 - 1e-12)))))


def quadratic_log_p(value: float, weights: np.ndarray, dof: np.ndarray | float = 1.0) -> float:
    """log of the upper tail of sum w chi2(dof), by matching three cumulants (Hall-Buckley-Eagleson)."""
    c1, c2, c3 = (float(np.sum(dof * weights**k)) for k in (1, 2, 3))
    if c3 == 0:
        return 0.0  # nothing to see it with
    nu = c2**3 / c3**2
    x = nu + (value - c1) * np.sqrt(nu / c2)
    return float(chi2_log_sf(max(x, 0.0), nu))


def chi2_log_sf(x: float, dof: float) -> float:
    """log of the chi-square upper tail, also where it underflows."""
    # As scipy.stats has it, without its checks of arrays, which take most of the time.
    tail = special.chdtrc(dof, x)
    if tail > 0:
        if x <= 0:
            return 0.0
        upper = x > 2 * special.gammaincinv(dof / 2, 0.5)
        value = float(np.log(tail) if upper else np.log1p(-special.chdtr(dof, x)))
        if value > -600:
            return value
    a, h = dof / 2, x / 2
    return float((a - 1) * np.log(h) - h - special.gammaln(a))


def normal_log_p(z: float, sides: int = 2) -> float:
    """log p of a standard normal value."""
    return min(0.0, float(special.log_ndtr(-float(abs(z) if sides == 2 else z))) + math.log(sides))


def skewed_log_p(z: float, skewness: float, sides: int = 2) -> float:
    """log p of a standardised sum whose law has this (positive) skewness: a shifted gamma."""
    if skewness < 2e-3:
        return normal_log_p(z, sides)
    shape = 4 / skewness**2
    x = shape + z * math.sqrt(shape)
    log_p = chi2_log_sf(2 * x, 2 * shape) if x > 0 else 0.0
    if sides == 2:
        below = float(stats.gamma.logcdf(x, shape)) if x > 0 else -600.0
        log_p = min(log_p, below) + math.log(2)
    return min(0.0, log_p)


def student_log_p(z: float, freedom: float, sides: int = 2) -> float:
    """log p of a value whose standard error rests on `freedom` degrees of freedom."""
    if freedom < 1:
        return 0.0
    return float(min(0.0, stats.t.logsf(abs(z) if sides == 2 else z, freedom) + math.log(sides)))


class Component(NamedTuple):
    """Fit of one variance component: variance, its standard error, gain (nats), log p, one-sigma variance."""

    variance: float
    error: float
    gain: float
    log_p: float
    shift: float


def variance_component(
    power: np.ndarray, information: np.ndarray, dof: np.ndarray | float = 1.0, scale_variance: float = 0.0
) -> Component:
    """Common variance v of offsets seen as sum(dof) chi-square powers with mean dof (1 + v * information).

    power: sum over `dof` of U^2/I, one entry per template. The likelihood ratio is that of the full Gaussian
    data, because each template is a rank-one term of the covariance. scale_variance: variance of the log of
    the noise variance that the powers were divided by; it widens the null law.
    """
    power, information = np.ravel(power), np.ravel(information)
    dof = np.broadcast_to(np.asarray(dof, float), power.shape)
    used = (information > 0) & (dof > 0)
    power, information, dof = power[used], information[used], dof[used]
    if not power.size:
        return Component(0.0, 0.0, 0.0, 0.0, np.inf)
    score_sd = np.sqrt(0.5 * np.sum(dof * information**2))
    excess = 0.5 * np.sum(information * (power - dof))
    wider = np.sqrt(1 + scale_variance * np.sum(dof * information) ** 2 / (2 * np.sum(dof * information**2)))
    expected = np.sum(dof * information)
    log_p = quadratic_log_p(
        float(expected + (np.sum(information * power) - expected) / wider), information, dof
    )
    score_sd = score_sd / wider

    def loss(log_v: float) -> float:
        tau = np.exp(log_v) * information
        return -0.5 * float(np.sum(power * tau / (1 + tau) - dof * np.log1p(tau)))

    if excess <= 0:
        return Component(0.0, 1 / score_sd, 0.0, log_p, 1 / score_sd)
    start = np.log(excess / (score_sd * wider) ** 2)
    best = optimize.minimize_scalar(
        loss, bounds=(start - 4, start + 4), method="bounded", options={"xatol": 1e-3}
    )
    v = float(np.exp(best.x))
    tau = v * information
    fisher = 0.5 * np.sum(dof * (information / (1 + tau)) ** 2)
    return Component(v, float(wider / np.sqrt(fisher)), max(-float(best.fun), 0.0), log_p, 1 / score_sd)
