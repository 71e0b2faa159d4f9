"""Sums of squares of every pixel over the darks, which say how noisy it is."""

from __future__ import annotations

import numpy as np
from scipy import stats

from cannoise_jax.physics.robust import median
from cannoise_jax.signatures.charge_noise import by_charge, own_charge
from cannoise_jax.signatures.fields import Fields, without_pixels
from cannoise_jax.signatures.handed import Many
from cannoise_jax.signatures.known_shape import darks
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.signature import CONTRASTS, STATIC

LOOKED_AT = np.log(0.05)
"""Log p from which on nothing more is asked of how the noisy pixels are noisy."""


def square_map(fields: tuple[Fields, ...]) -> tuple[np.ndarray, np.ndarray, int] | None:
    """Temporal sum of squares of every pixel over all darks, which pixels to use, the degrees of freedom."""
    chosen = darks(fields)
    freedom = sum(len(f.contrasts) for f in chosen)
    if freedom < 2:
        return None
    return (
        sum_of_squares(tuple(chosen), own_charge(fields)),
        np.all([f.usable for f in chosen], axis=0),
        freedom,
    )


def sum_of_squares(chosen: Many, charge: np.ndarray | None) -> np.ndarray:
    """In units of the noise, in which the shot noise of what each pixel collects is."""
    total = np.zeros(chosen[0].mean.shape)
    for f in chosen:
        total += np.einsum("nij,nij->ij", f.contrasts, f.contrasts) / by_charge(f, charge)
    return total


def histogram(squares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Counts and centres on a fine logarithmic grid: likelihoods are then sums over a few hundred bins."""
    logs = np.log(np.maximum(squares, 1e-3))
    counts, edges = np.histogram(logs, 600)
    used = counts > 0
    return counts[used], np.exp((edges[1:] + edges[:-1]) / 2)[used]


def mask_noisy(fields: tuple[Fields, ...], score: Score) -> tuple[Fields, ...]:
    """Takes the pixels whose variance stands out in the darks out of every field."""
    found = square_map(fields)
    if found is None:
        return fields
    return without_pixels(fields, found[0] > stats.chi2.isf(1e-3, found[2]))


READS = STATIC | CONTRASTS | {"mean", "signal", "shot"}


def dark_sigma(fields: Many) -> float:
    """Standard deviation of the noise, DN, in whose square the sums of squares of all darks together count
    what a pixel has beside it."""
    told = [(max(len(f.contrasts), 1e-3), float(median(f.sigma))) for f in fields if not f.lit]
    return float(np.sqrt(sum(n for n, _ in told) / sum(n / sigma**2 for n, sigma in told)))
