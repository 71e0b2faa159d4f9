"""Statistics of standardised residuals z[T, H, W] that are standard normal where z is white Gaussian noise.

Each is the efficient score of one template, normalised to unit variance; a large value says that the data
have the template's structure. Templates broadcast to z.
"""

from __future__ import annotations

import math

import jax.numpy as jnp
from jax.scipy.stats import norm
from jaxtyping import Array, Float

from cannoise_jax.physics.core.mosaic_ops import neighbour_maximum, shifted

Residuals = Float[Array, "t h w"]


def mean_score(z: Residuals, template) -> Array:
    """Structure in the mean."""
    template = jnp.broadcast_to(template, z.shape)
    return jnp.sum(z * template) / jnp.sqrt(jnp.maximum(jnp.sum(template**2), 1e-30))


def variance_score(z: Residuals, template) -> Array:
    """Structure in the variance."""
    template = jnp.broadcast_to(template, z.shape)
    return jnp.sum((z**2 - 1) * template) / jnp.sqrt(jnp.maximum(2 * jnp.sum(template**2), 1e-30))


def skew_score(z: Residuals, template) -> Array:
    """Structure in the third cumulant."""
    template = jnp.broadcast_to(template, z.shape)
    return jnp.sum((z**3 - 3 * z) * template) / jnp.sqrt(jnp.maximum(6 * jnp.sum(template**2), 1e-30))


def lag_score(z: Residuals, dy: int, dx: int, weight=1.0) -> Array:
    """Covariance with the pixel (dy, dx) away, weighted; dy, dx >= 0."""
    height, width = z.shape[1:]
    product = z[:, : height - dy, : width - dx] * z[:, dy:, dx:]
    weight = jnp.broadcast_to(weight, z.shape)[:, : height - dy, : width - dx]
    return jnp.sum(weight * product) / jnp.sqrt(jnp.maximum(jnp.sum(weight**2), 1e-30))


def temporal_score(z: Residuals) -> Array:
    """Covariance of each pixel with itself one frame later; 0 for a single frame."""
    return jnp.sum(z[1:] * z[:-1]) / math.sqrt(max(z[1:].size, 1))


def frame_score(z: Residuals) -> Array:
    """Spread of the frame means, by the cube root that makes a chi-square normal (Wilson and Hilferty)."""
    count = z[0].size
    power = jnp.sum(jnp.mean(z, axis=(1, 2)) ** 2) * count / z.shape[0]
    return chi_square_score(power, z.shape[0])


def chi_square_score(mean_power, degrees: int) -> Array:
    """A chi-square over its degrees of freedom as a standard normal number (Wilson and Hilferty 1931)."""
    spread = 2 / (9 * degrees)
    return (jnp.cbrt(mean_power) - (1 - spread)) / math.sqrt(spread)


def count_score(hits: Array, chance: float) -> Array:
    """How many more hits than by chance, in standard deviations of a binomial count."""
    return (jnp.sum(hits) - hits.size * chance) / math.sqrt(hits.size * chance * (1 - chance))


def high_score(z: Residuals) -> Array:
    """Excess of values above 3."""
    return count_score(z > 3.0, float(norm.sf(3.0)))


def low_score(z: Residuals) -> Array:
    """Excess of values below -3."""
    return count_score(z < -3.0, float(norm.sf(3.0)))


def peak_deficit_score(z: Residuals) -> Array:
    """Fewer local maxima among the nine pixels of one colour than one in nine.

    The maxima of neighbouring windows exclude each other; sampling every third pixel of a colour in both
    directions keeps the windows apart.
    """
    peaks = (z > neighbour_maximum(z))[:, 2:-2, 2:-2]
    apart = jnp.stack([peaks[:, i::6, j::6][:, : (peaks.shape[1] - 1) // 6, : (peaks.shape[2] - 1) // 6]
                       for i in (0, 1) for j in (0, 1)])  # fmt: skip
    return -count_score(apart, 1 / 9)


def interpolation_score(z: Residuals) -> Array:
    """Excess of pixels that are nearly the mean of their four neighbours of the same colour."""
    near = sum(shifted(z, dy, dx) for dy, dx in ((0, 2), (0, -2), (2, 0), (-2, 0))) / 4
    gap = ((z - near) / math.sqrt(1.25))[:, 2:-2, 2:-2]
    return count_score(jnp.abs(gap) < 0.05, float(norm.cdf(0.05) - norm.cdf(-0.05)))
