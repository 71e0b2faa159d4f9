"""What Poisson noise and rounding do to the shape of noise."""

from __future__ import annotations

import math

import numpy as np
from scipy import special

from cannoise_jax.physics.robust import median
from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures.fields import Fields, channel_index


def rounded_enough(field: Fields) -> bool:
    """Whether rounding to the code step leaves the shape of the noise alone."""
    return bool(median(field.sigma) > 0.65 * field.step)


def darks(fields: tuple[Fields, ...]) -> list[Fields]:
    """Darks of several frames whose noise is not lost in rounding."""
    return [f for f in fields if f.kind in DARK and len(f.contrasts) and rounded_enough(f)]


def rounding_kurtosis(mean: np.ndarray, sigma: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Excess kurtosis of normal noise after rounding, and what rounding leaves of a small excess kurtosis: of
    given mean and standard deviation of the rounded values, DN. Below one step both depend on where between
    two codes the mean lies (Sheppard's correction is their mean over that place).

    A small excess kurtosis k adds k He4 / 24 to the normal density (Gram-Charlier), -k He3 / 24 to its
    integral.
    """
    place, wide = np.broadcast_arrays(np.asarray(mean, float) / step, np.asarray(sigma, float) / step)
    out = np.array(-1.0 / (120 * wide**4), float)
    left = np.array(np.clip(1 - 1 / (12 * wide**2), 0, 1) ** 2, float)
    for at in np.ndindex(wide.shape):
        width, goal = float(wide[at]), float(place[at]) % 1.0
        if width > 1.5:
            continue
        latent, middle = math.sqrt(max(width**2 - 1 / 12, 0.02)), goal
        reach = math.ceil(9 * latent) + 2
        codes = np.arange(-reach, reach + 2.0)
        for _ in range(4):  # the latent mean and width whose rounded values have the given ones
            edges = (np.append(codes, codes[-1] + 1) - 0.5 - middle) / latent
            p = np.diff(special.ndtr(edges))
            centre = float(np.sum(p * codes))
            variance = float(np.sum(p * (codes - centre) ** 2))
            middle += goal - centre
            latent = math.sqrt(max(latent**2 + width**2 - variance, 1e-3))
        fourth = float(np.sum(p * (codes - centre) ** 4))
        out[at] = fourth / variance**2 - 3
        moved = np.diff((3 * edges - edges**3) * np.exp(-0.5 * edges**2)) / (24 * math.sqrt(2 * math.pi))
        second_moved, fourth_moved = (float(np.sum(moved * (codes - centre) ** k)) for k in (2, 4))
        left[at] = fourth_moved / variance**2 - 2 * fourth * second_moved / variance**3
    return out, left


def known_kurtosis(field: Fields) -> tuple[np.ndarray, np.ndarray]:
    """Excess kurtosis of each pixel by Poisson noise and by rounding, and the share of an excess kurtosis of
    its read noise that shows in it."""
    poisson = float(np.mean(field.gain)) ** 3 * field.signal / field.sigma**2 / field.sigma**2
    if field.kind not in DARK:
        read = np.clip(1 - field.shot - field.step**2 / 12 / field.sigma**2, 0, 1)
        return poisson - field.step**4 / 120 / field.sigma**2 / field.sigma**2, read**2
    channel = channel_index(field.mean.shape)
    chosen = [channel == c for c in range(4)]
    mean = np.array([median(field.mean[m]) for m in chosen])
    sigma = np.array([median(field.sigma[m]) for m in chosen])
    own, left = rounding_kurtosis(mean, sigma, field.step)
    return poisson + own[channel], left[channel] * np.clip(1 - field.shot, 0, 1) ** 2


def known_skewness(field: Fields) -> np.ndarray:
    """Skewness of each pixel by Poisson noise."""
    return float(np.mean(field.gain)) ** 2 * field.signal / field.sigma**3


def kurtosis_doubt(field: Fields) -> float:
    """Standard error of a dark's kurtosis by Poisson noise: that of the dark level that it follows from.
    Matters where single electrons stand out from the read noise."""
    # The dark level is that beyond another dark's.
    values = 2 / max(field.frames * int(field.usable.sum()), 1)
    return float(np.mean(field.gain) ** 3 * np.sqrt(values) / median(field.sigma) ** 3)
