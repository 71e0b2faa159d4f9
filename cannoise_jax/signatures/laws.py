"""By which law two sources are told apart: one value, in standard deviations of a normal law, for every
statistic, signed (positive: the recordings have more), and one honest count of how often was looked."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import special, stats

from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.fit import median_quotient

_PRIOR = 20.0
"""Degrees of freedom that the other statistics of a family lend to the spread of one of them."""

_SEEN = 8
"""Degrees of freedom from which on a spread that is far beyond the others' stands for itself."""


FARTHEST = 38.0
"""Standard deviations beyond which the tail of a normal law, 6e-300 at 37, is no number above zero."""


class Judged(NamedTuple):
    """Recorded and simulated value of every statistic, their difference in standard deviations."""

    recorded: Float[np.ndarray, "k"]
    simulated: Float[np.ndarray, "k"]
    z: Float[np.ndarray, "k"]


def _spread(
    simulated: Float[np.ndarray, "m u k"], closed: Float[np.ndarray, "k"]
) -> tuple[np.ndarray, float, float]:
    """Variance of one unit, how much more the means of whole sets scatter than their units allow (a factor,
    at least 1, of the whole family), and the degrees of freedom of the first. closed: the variance of a unit
    by its closed form, by which the statistics of a family are weighed."""
    m, u, _ = simulated.shape
    if u > 1:
        inner = simulated.var(1, ddof=1).mean(0)
        dof = m * (u - 1)
        if m > 1:
            outer = simulated.mean(1).var(0, ddof=1) * u
            known = inner > 0
            total = float(np.sum(inner[known] / closed[known]))
            ratio = float(np.sum(outer[known] / closed[known])) / total if total > 0 else 1.0
            slack = np.sqrt(2 / (m - 1) / max(known.sum(), 1))
            return inner, max(ratio if ratio > 1 + 3 * slack else 1.0, 1.0), dof
        return inner, 1.0, dof
    if m > 1:
        return simulated[:, 0].var(0, ddof=1), 1.0, m - 1
    return np.zeros(simulated.shape[2]), 1.0, 0


def as_normal(upper: np.ndarray, lower: np.ndarray, far: np.ndarray) -> np.ndarray:
    """Standard deviations of a normal law with these tail probabilities; `far` where they underflow."""
    with np.errstate(divide="ignore"):
        z = np.where(upper < lower, -special.ndtri(upper), special.ndtri(lower))
    return np.where(np.isfinite(z), z, far)


def energy_excess(
    simulated: Float[np.ndarray, "m v k"], count: Float[np.ndarray, "k"]
) -> Float[np.ndarray, "k"]:
    """How much more than chi-squared the mean squares of a simulator's units scatter: few coefficients hold
    most of a wave, and are large or small together."""
    b = simulated.mean((0, 1))
    expected = 2 * np.maximum(b, 1e-12) ** 2 / count
    each, between, dof = _spread(simulated, expected)
    excess = np.ones_like(b)
    if dof:
        ratio = each / expected
        family = max(float(median(ratio[count >= 4])) if (count >= 4).any() else 1.0, 1.0)
        excess = np.maximum((_PRIOR * family + dof * ratio) / (_PRIOR + dof), 1.0)
        if dof >= _SEEN:
            excess = np.where(ratio > 1 + 4 * np.sqrt(2 / dof), ratio, excess)
    return excess * between


def compare_energies(
    recorded: Float[np.ndarray, "u k"],
    simulated: Float[np.ndarray, "m v k"],
    count: Float[np.ndarray, "k"],
    least: Float[np.ndarray, "k"] | float = 1.0,
) -> Judged:
    """Mean squares of `count` coefficients a unit, by the F law; where the simulator's own units scatter
    more than chi-squared, by `least` times as much at least, with fewer degrees of freedom."""
    a, b = recorded.mean(0), simulated.mean((0, 1))
    m, u, _ = simulated.shape
    excess = np.maximum(energy_excess(simulated, count), least)
    first, second = (np.maximum(n * count / excess, 0.5) for n in (len(recorded), m * u))
    tiny = 1e-9
    ratio = (a + tiny) / (b + tiny)
    z = as_normal(
        stats.f.sf(ratio, first, second), stats.f.cdf(ratio, first, second), _paulson(ratio, first, second)
    )
    return Judged(a, b, z)


def _paulson(ratio, first, second):
    """Normal approximation of the F law for tails beyond double precision."""
    root = np.cbrt(ratio)
    one, two = 2 / (9 * first), 2 / (9 * second)
    return ((1 - two) * root - (1 - one)) / np.sqrt(two * root**2 + one)


def compare_means(
    recorded: Float[np.ndarray, "u k"],
    simulated: Float[np.ndarray, "m v k"],
    variance: Float[np.ndarray, "k"],
    parts: int = 1,
) -> Judged:
    """Means by a moderated t law (G. K. Smyth, Stat. Appl. Genet. Mol. Biol. 3(1), 2004, article 3): the
    scatter of a statistic over the simulator's units, drawn towards what the family shows of `variance`, the
    closed form of a unit under white noise. parts: of the family, as many and as long, that scatter each in
    their own way: where a map is not noise, squares do by more than cubes do."""
    a, b = recorded.mean(0), simulated.mean((0, 1))
    m, u, _ = simulated.shape
    each, between, dof = _spread(simulated, variance)
    if dof:
        typical = median((each / variance).reshape(parts, -1), 1) / median_quotient(dof)
        family = np.repeat(np.maximum(typical, 0.5), variance.size // parts)
        each = (_PRIOR * family * variance + dof * each) / (_PRIOR + dof)
    else:
        each = variance
    error = np.sqrt(each * between * (1 / len(recorded) + 1 / (m * u)))
    t = (a - b) / np.maximum(error, 1e-12)
    law = _PRIOR + dof
    return Judged(
        a, b, as_normal(stats.t.sf(t, law), stats.t.cdf(t, law), np.sign(t) * np.minimum(abs(t), FARTHEST))
    )


def compare_counts(
    recorded: Float[np.ndarray, "u k"],
    simulated: Float[np.ndarray, "m v k"],
    share: float,
    least: Float[np.ndarray, "k"] | float = 1.0,
) -> Judged:
    """Counts: given their sum, binomial with `share` = recorded trials over all trials; where the simulator's
    units scatter more than Poisson counts, both are divided by the excess, by `least` at least."""
    a, b = recorded.sum(0), simulated.sum((0, 1))
    mean = np.maximum(simulated.mean((0, 1)), 0.5)
    each, between, dof = _spread(simulated, mean)
    excess = np.ones_like(b)
    if dof:
        excess = np.maximum((_PRIOR + dof * each / mean) / (_PRIOR + dof), 1.0)
    excess = np.maximum(excess * between, least)
    x, n = np.floor(a / excess), np.floor(a / excess) + np.ceil(b / excess)
    upper, lower = stats.binom.sf(x - 1, n, share), stats.binom.cdf(x, n, share)
    wide = np.sqrt(np.maximum(n * share * (1 - share), 0.25))
    z = as_normal(
        np.minimum(upper, 1.0), np.minimum(lower, 1.0), np.clip((x - n * share) / wide, -FARTHEST, FARTHEST)
    )
    z = np.where((upper > 0.5) & (lower > 0.5), 0.0, z)
    trials = (1 - share) / share
    return Judged(a, b / trials if trials else b, z)


def threshold(alpha: float, families: int, looks: int) -> float:
    """|z| that one of `looks` statistics of one of `families` passes by chance in a share `alpha` of runs."""
    return float(-special.ndtri(alpha / (2 * max(families, 1) * max(looks, 1))))
