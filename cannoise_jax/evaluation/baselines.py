"""The noise models to beat: Gaussian, Poisson-Gaussian as published, as estimated from the references alone,
and re-calibrated.

All are samplers with the signature that a learned model has too,
`sampler(key, clean, reference_noisy, shot, read) -> noise`, batches packed `[b, h, w, 4]`, k references each
`[b, k, h, w, 4]`, shot and read `[b, 4]` in packed order, normalised units, unclipped.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import nnls

from cannoise_jax.physics.core.poisson_gaussian import nlf_sigma, sample_normal
from cannoise_jax.physics.single_image import estimate_nlf

Sampler = Callable[..., Any]

SATURATED = 0.9
_BINS = 48


@jax.jit
def gaussian(key, clean, reference_noisy, shot, read) -> Float[Array, "b h w 4"]:
    """N(0, shot): the shot coefficient taken as a variance, as if the signal were 1 everywhere.

    The baseline of CA-NoiseGAN's evaluation, kept as it is; it is no fit to anything.
    """
    return jax.numpy.sqrt(shot)[:, None, None, :] * sample_normal(key, clean.shape)


@jax.jit
def poisson_gaussian(key, clean, reference_noisy, shot, read) -> Float[Array, "b h w 4"]:
    """N(0, shot * clean + read) per pixel, the paper's eq. 1 with the noise level function it is given."""
    sigma = nlf_sigma(clean, shot[:, None, None, :], read[:, None, None, :])
    return sigma * sample_normal(key, clean.shape)


def poisson_gaussian_estimated(key, clean, reference_noisy, shot, read) -> Float[Array, "b h w 4"]:
    """`poisson_gaussian` at the level that the references show: what is to be had without any training."""
    return poisson_gaussian(key, clean, reference_noisy, *estimated_levels(reference_noisy))


estimated_levels = jax.jit(jax.vmap(estimate_nlf))
"""(shot, read) `[b, 4]` as references `[b, k, h, w, 4]` show them: one program for all columns of a
comparison that read levels off them."""


def calibrate_nlf(
    clean: Float[np.ndarray, "..."], noise: Float[np.ndarray, "..."], rounds: int = 4
) -> tuple[float, float]:
    """Shot and read that fit recorded noise: variances in bins of clean intensity against the intensity.

    Non-negative least squares, each variance weighted by its own standard error (from the fit of the round
    before). The variance in a bin is taken about the bin's own mean, so black-level errors do not enter;
    saturated parts (clean >= 0.9) are left out. Normalised units.
    Raises ValueError if fewer than 1000 values are left.
    """
    clean, noise = np.ravel(clean).astype(np.float64), np.ravel(noise).astype(np.float64)
    use = clean < SATURATED
    clean, noise = clean[use], noise[use]
    if clean.size < 1000:
        raise ValueError(f"only {clean.size} unsaturated values: a noise level fit needs at least 1000")
    edges = np.unique(np.quantile(clean, np.linspace(0, 1, _BINS + 1)))
    place = np.clip(np.searchsorted(edges, clean, side="right") - 1, 0, max(edges.size - 2, 0))
    count = np.bincount(place)
    kept = count > 20
    count, sums = count[kept], [np.bincount(place, w)[kept] for w in (clean, noise, noise**2)]
    level, mean, square = (total / count for total in sums)
    variance = (square - mean**2) * count / (count - 1)
    shot, read = 0.0, float(np.mean(variance))
    for _ in range(rounds):
        weight = np.sqrt(count / 2) / np.maximum(shot * level + read, 1e-12)
        design = np.stack([level, np.ones_like(level)], axis=1) * weight[:, None]
        shot, read = nnls(design, variance * weight)[0]
    return float(shot), float(read)


def calibrate_by_setting(
    clean: Float[np.ndarray, "n h w 4"],
    noise: Float[np.ndarray, "n h w 4"],
    camera: np.ndarray,
    iso: np.ndarray,
) -> dict[tuple[int, int], tuple[float, float]]:
    """`calibrate_nlf` for every camera and ISO among the training patches: {(camera, iso): (shot, read)}."""
    settings = sorted({(int(c), int(i)) for c, i in zip(camera, iso, strict=True)})
    fitted = {}
    for c, i in settings:
        here = (camera == c) & (iso == i)
        fitted[c, i] = calibrate_nlf(clean[here], noise[here])
    return fitted
