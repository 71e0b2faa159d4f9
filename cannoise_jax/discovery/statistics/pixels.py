"""Pixels whose noise differs from that of the others: noisier ones, and telegraph ones."""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy import stats

from cannoise_jax.discovery.fields import Fields
from cannoise_jax.discovery.statistics.hot import without_pixels
from cannoise_jax.discovery.statistics.rare import sparse_log_p
from cannoise_jax.discovery.statistics.score import Probe, Score, skewed_log_p, unchanged
from cannoise_jax.discovery.statistics.shape import (
    NOISY,
    darks,
    known_kurtosis,
    kurtosis_doubt,
    parabola_peak,
)

_SPREADS = (0.015, 0.02, 0.03, 0.04, 0.05, 0.065, 0.08, 0.12, 0.17, 0.25, 0.35, 0.5, 0.7, 1.0)


_JUMPS = np.exp(np.linspace(np.log(0.5), np.log(60.0), 24))
_MEAN_JUMPS = tuple(np.exp(np.linspace(np.log(0.7), np.log(30), 12)))
FAR_JUMPS = tuple(j for j in _MEAN_JUMPS if j > 2)
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


def _square_map(fields: tuple[Fields, ...]) -> tuple[np.ndarray, np.ndarray, int] | None:
    """Temporal sum of squares of every pixel over all darks, which pixels to use, the degrees of freedom."""
    chosen = darks(fields)
    freedom = sum(len(f.contrasts) for f in chosen)
    if freedom < 2:
        return None
    squares = np.sum([np.einsum("nij,nij->ij", f.contrasts, f.contrasts) for f in chosen], axis=0)
    return squares.astype(np.float64), np.all([f.usable for f in chosen], axis=0), freedom


def _sums_of_squares(fields: tuple[Fields, ...]) -> tuple[np.ndarray, int] | None:
    """The sums of squares of the usable pixels and their degrees of freedom."""
    found = _square_map(fields)
    return None if found is None else (found[0][found[1]], found[2])


def _known_dispersion(fields: tuple[Fields, ...]) -> tuple[float, float]:
    """What the kurtosis of rounding and of Poisson noise adds to the variance of a pixel's sum of squares
    over all darks, and its standard error."""
    chosen = darks(fields)
    weight = np.array([len(f.contrasts) ** 2 / (len(f.contrasts) + 1.0) for f in chosen])
    known = [float(np.mean(known_kurtosis(f)[0])) for f in chosen]
    return float(weight @ known), float(np.linalg.norm(weight * [kurtosis_doubt(f) for f in chosen]))


def _dispersion_log_p(squares: np.ndarray, n: int, known: float, doubt: float) -> tuple[float, float]:
    """Over-dispersion of the sums of squares against chi-square, far pixels capped; log p and z. known: what
    rounding and Poisson noise add to the variance of a sum of squares, doubt: its standard error."""
    cap = stats.chi2.isf(1e-4, n)
    grid = np.linspace(0, cap, 4001)
    density = stats.chi2.pdf(grid, n)
    density[0] = 0 if not np.isfinite(density[0]) else density[0]
    weight = density * (grid[1] - grid[0])
    weight[-1] += stats.chi2.sf(cap, n)
    weight /= weight.sum()
    value = (grid - n) ** 2
    mean = float(np.sum(weight * value))
    variance = float(np.sum(weight * (value - mean) ** 2))
    # The scale is fitted on the same pixels: what a common factor does to the mean is projected out.
    linear = float(np.sum(weight * (value - mean) * (grid - n)) / np.sum(weight * (grid - n) ** 2))
    third = float(np.sum(weight * (value - mean - linear * (grid - n)) ** 3))
    variance = float(np.sum(weight * (value - mean - linear * (grid - n)) ** 2))
    capped = np.minimum(squares, cap)
    total = float(np.sum((capped - n) ** 2 - mean - known - linear * (capped - n)))
    z = total / np.sqrt(variance * squares.size + (doubt * squares.size) ** 2)
    skewness = third / variance**1.5 / np.sqrt(squares.size)
    return skewed_log_p(z, skewness, 1), z


def spread_score(fields: tuple[Fields, ...], *, probe: str) -> Score | None:
    """A read noise of its own for every pixel (log-normal): marginal likelihood of the sums of squares."""
    found = _sums_of_squares(fields)
    if found is None:
        return None
    squares, n = found
    log_p, z = _dispersion_log_p(squares, n, *_known_dispersion(fields))
    nodes, weights = np.polynomial.hermite_e.hermegauss(15)
    counts, centre = _histogram(squares)
    best, at = 0.0, 0.0
    gains = []
    for spread in _SPREADS:
        width = np.sqrt(np.log1p(spread**2))
        variance = np.exp(2 * (width * nodes - width**2))
        log_terms = -n / 2 * np.log(variance) + 0.5 * centre[:, None] * (1 - 1 / variance)
        top = log_terms.max(1, keepdims=True)
        gains.append(
            float(np.sum(counts * (top[:, 0] + np.log(np.exp(log_terms - top) @ (weights / weights.sum())))))
        )
    k = int(np.argmax(gains))
    if gains[k] > 0:
        best, at = gains[k], parabola_peak(np.array(_SPREADS), np.array(gains), k)
    # chi-square dispersion grows by 4 spread^2 n^2.
    unit = 4 * n**2 / np.sqrt(_dispersion_variance(n) * squares.size) * squares.size
    error = 1 / (unit * max(2 * at, 1 / np.sqrt(unit)))
    return Score(
        probe,
        log_p,
        best,
        0.5 * float(np.log(squares.size)),
        at,
        float(error),
        float(1 / np.sqrt(unit)),
        2,
        {"spread": (at, "1", float(error))},
        {"axis": "pixel", "z": z},
        at,
    )


def _dispersion_variance(n: int) -> float:
    """Variance of (chi2_n - n)^2 with its linear part projected out."""
    return 8.0 * n**2 + 16.0 * n


def _histogram(squares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Counts and centres on a fine logarithmic grid: likelihoods are then sums over a few hundred bins."""
    logs = np.log(np.maximum(squares, 1e-3))
    counts, edges = np.histogram(logs, 600)
    used = counts > 0
    return counts[used], np.exp((edges[1:] + edges[:-1]) / 2)[used]


def telegraph_score(fields: tuple[Fields, ...], *, probe: str) -> Score | None:
    """A small share of pixels with extra fluctuation of exponentially spread size."""
    found = _sums_of_squares(fields)
    if found is None:
        return None
    squares, n = found
    counts, centre = _histogram(squares)
    best, at, share = 0.0, 1.0, 0.0
    ratios = []
    for mean in _MEAN_JUMPS:
        mixed = jump_log_ratio(centre, n, mean)
        if mean in FAR_JUMPS:
            ratios.append(mixed)
        f = 0.005
        for _ in range(40):
            responsibility = f * np.exp(mixed) / (1 - f + f * np.exp(mixed))
            f = float(np.clip(np.sum(counts * responsibility) / counts.sum(), 1e-6, 0.3))
        gain = float(np.sum(counts * np.log1p(f * np.expm1(mixed))))
        if gain > best:
            best, at, share = gain, float(mean), f
    number = int(np.sum(squares > stats.chi2.isf(1e-5, n)))
    log_p = sparse_log_p(counts, ratios)
    sigma = float(np.mean([np.median(f.sigma) for f in darks(fields)]))
    amplitude = sigma * np.sqrt(share * 2 * at**2 / 4)
    error = amplitude / np.sqrt(max(share * squares.size, 1.0))
    shift = sigma * np.sqrt(np.sqrt(2 / n / squares.size))
    return Score(
        probe,
        max(log_p, -700.0),
        best,
        float(np.log(squares.size)),
        float(amplitude),
        float(error),
        float(shift),
        2,
        {
            "fraction": (share, "1", float(np.sqrt(share / squares.size))),
            "jump": (at * sigma, "DN", at * sigma / np.sqrt(max(share * squares.size, 1.0))),
        },
        {"axis": "pixel", "pixels": number},
        (share, at),
    )


def mask_noisy(fields: tuple[Fields, ...], score: Score) -> tuple[Fields, ...]:
    """Takes the pixels whose variance stands out in the darks out of every field."""
    found = _square_map(fields)
    if found is None:
        return fields
    return without_pixels(fields, found[0] > stats.chi2.isf(1e-3, found[2]))


def probes() -> tuple[Probe, ...]:
    """The probes of this signature."""
    pixel = {"enters": "readout", "varies_over": "pixel", "scales": "additive"}
    return (
        Probe(
            "pixel_spread",
            "pixel_read_noise_map",
            {**pixel, "time": "frozen", "law": "log-normal variance"},
            partial(spread_score, probe="pixel_spread"),
            unchanged,
            NOISY,
        ),
        Probe(
            "telegraph",
            "rts",
            {**pixel, "time": "telegraph", "law": "two levels"},
            partial(telegraph_score, probe="telegraph"),
            mask_noisy,
            NOISY,
            rare=True,
        ),
    )
