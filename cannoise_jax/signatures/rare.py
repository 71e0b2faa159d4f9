"""The law of the likelihood ratio of an effect in a few pixels at unknown places."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from scipy import special, stats

from cannoise_jax.physics.robust import robust_std

_SHARES = (2e-5, 1e-4, 5e-4, 2e-3)
"""Shares of rare pixels that are tried."""
HEATS = tuple(np.exp(np.linspace(np.log(1.5), np.log(200), 14)))
"""Mean heights that are tried, in standard deviations of a pixel's level."""
EDGES = np.concatenate(
    [
        np.arange(-8, -1.5, 0.05),
        np.arange(-1.5, 1.5, 0.0125),
        np.arange(1.5, 8, 0.05),
        np.geomspace(8, 1e7, 1400),
    ]
)
"""Bins of the levels, standard deviations: finest where most of a law lies that is skewed far."""
CENTRES = (EDGES[1:] + EDGES[:-1]) / 2
FAR = 600.0
"""Nats by which one pixel may speak for an effect: beyond, no law of the noise is known so well."""
_DRAWS = 100
"""Draws of each mixture for the null law of the likelihood ratio."""


def log_ratio_of(u: np.ndarray, mean: np.ndarray | float) -> np.ndarray:
    """Log density of a standard normal value plus an exponential one of this mean over the normal's alone."""
    log_ratio = (
        0.5 / np.square(mean)
        - u / mean
        - np.log(mean)
        + stats.norm.logcdf(u - 1 / mean)
        - stats.norm.logpdf(u)
    )
    return np.maximum(log_ratio, -50)


def sparse_log_p(counts: np.ndarray, log_ratios: list[np.ndarray]) -> float:
    """log p that a few values follow another law: log_ratios holds, for several sizes of the effect, the log
    of its density over the null's at the values. The likelihood ratio averaged over sizes and shares has mean
    one under the null, so its inverse is a p-value (Markov)."""
    logs = [
        float(np.sum(counts * np.log1p(share * np.expm1(np.minimum(ratio, 600.0)))))
        for ratio in log_ratios
        for share in _SHARES
    ]
    return min(0.0, float(np.log(len(logs)) - special.logsumexp(logs)))


@lru_cache(maxsize=1)
def _table() -> np.ndarray:
    """Log likelihood ratio of a pixel in every bin, for every mean height and share that are tried."""
    return table_of([log_ratio_of(CENTRES, mean) for mean in HEATS])


def table_of(ratios: Sequence[np.ndarray]) -> np.ndarray:
    """The same of log density ratios in every bin, one for every mean height."""
    capped = (np.minimum(r, FAR) for r in ratios)
    return np.array([np.logaddexp(np.log1p(-f), np.log(f) + r) for r in capped for f in _SHARES])


def level_counts(u: np.ndarray) -> np.ndarray:
    """How many levels, in standard deviations, lie in each bin."""
    return np.histogram(np.clip(u, EDGES[0], 0.999 * EDGES[-1]), EDGES)[0]


def log_mixture(counts: np.ndarray, table: np.ndarray | None = None) -> np.ndarray:
    """Log likelihood ratio averaged over the mean heights and shares that are tried; counts `[bins]` or
    `[bins, n]`. table: of each bin, of levels that are not normal, see `table_of`."""
    logs = np.einsum("kb,b...->k...", _table() if table is None else table, counts)
    return special.logsumexp(logs, axis=0) - np.log(len(logs))


@lru_cache(maxsize=16)
def _law(pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """Values of the averaged likelihood ratio L, descending, and log of the chance that normal noise reaches
    each.

    Draws of the noise Q0 and, as many, of the mixture Q that L is the density ratio of: seen from both
    together the noise has the weight 2 / (1 + L), which reaches as far into its tail as L does.
    """
    rng = np.random.default_rng(0)
    quiet = np.diff(stats.norm.cdf(EDGES))
    # The number of pixels is fixed: what a Poisson draw has too many of is taken from all bins alike.
    whole = _table() @ quiet

    def logs(density: np.ndarray, number: int) -> np.ndarray:
        used = density > 1e-12 / pixels
        n = rng.poisson(pixels * density[used], (number, int(used.sum()))).astype(float)
        out = np.einsum("kb,nb->kn", _table()[:, used], n) + whole[:, None] * (pixels - n.sum(1))
        return special.logsumexp(out, axis=0) - np.log(len(out))

    mixed = []
    for mean in HEATS:
        hot = np.maximum(np.diff(stats.exponnorm.cdf(EDGES, mean)), 0.0)
        mixed += [logs((1 - f) * quiet + f * hot, _DRAWS) for f in _SHARES]
    value = np.concatenate([*mixed, logs(quiet, len(mixed) * _DRAWS)])
    value = np.sort(value)[::-1]
    return value, np.log(2 / value.size) + np.logaddexp.accumulate(-np.logaddexp(0.0, value))


def hot_log_p(log_ratio: float, pixels: int) -> float:
    """log of the chance that the averaged likelihood ratio of so many pixels of normal noise is as high."""
    # Pixel numbers within some percent of one another share a law.
    value, log_p = _law(int(round(float(np.exp(np.round(np.log(pixels) * 16) / 16)))))
    known = min(log_ratio, 40.0)  # beyond, the inverse of the ratio bounds how much rarer the higher is
    at = int(np.searchsorted(-value, -known, side="right"))
    seldom = -known - float(np.log(value.size))  # where no draw fell
    return min(0.0, float(np.logaddexp(log_p[at - 1] if at else -np.inf, seldom)) - (log_ratio - known))


_CAPPED = float(1 + 2 * (8 * stats.norm.sf(3) - 3 * stats.norm.pdf(3)))
"""Mean square of a standard normal value, capped at 9."""


def spread_of(u: np.ndarray) -> float:
    """Standard deviation of the bulk, at least 1: of values that may lie on a coarse lattice, a few of them
    far out."""
    size = max(robust_std(u), 1.0)
    for _ in range(10):
        inner = np.square(u[np.abs(u) < 6 * size] / size)
        if not inner.size:  # all of a few values far out
            break
        size *= float(np.sqrt(np.mean(np.minimum(inner, 9.0)) / _CAPPED))
    return max(size, 1.0)


_JUMPS = np.exp(np.linspace(np.log(0.5), np.log(60.0), 24))
"""Jumps of single pixels that are summed over, standard deviations of the noise."""
MEAN_JUMPS = tuple(np.exp(np.linspace(np.log(0.7), np.log(30), 12)))
"""Means of them that are tried."""
FAR_JUMPS = tuple(j for j in MEAN_JUMPS if j > 2)
"""Mean jumps that count as a few far pixels: smaller ones change the bulk, which rounding changes too."""


def jump_log_ratio(squares: np.ndarray, n: int, mean: float) -> np.ndarray:
    """Log density of a pixel's sum of squares, n degrees of freedom, with jumps spread exponentially about
    this mean over that without."""
    extra = 1 + _JUMPS**2 / 4
    single = -n / 2 * np.log(extra) + 0.5 * squares[:, None] * (1 - 1 / extra)
    weight = np.exp(-_JUMPS / mean) * np.gradient(_JUMPS)
    top = single.max(1, keepdims=True)
    mixed = top[:, 0] + np.log(np.exp(single - top) @ (weight / weight.sum()))
    return mixed.clip(-50, 600)
