"""The noise level function of one image from that image alone, in JAX.

Second differences along both axes cancel scene content that is smooth over three pixels of a plane; what is
left has the noise's variance where the scene is smooth, and more where it is not. The variance is therefore
fitted against the signal over small blocks, blocks far above the fit counting less and less. The idea of a
fit to the smooth part of an image follows Foi et al., IEEE Trans. Image Process. 17(10), 2008.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

BLOCK, STEP = 8, 4
_SPREAD = 0.34
"""Relative standard deviation of a block's mean square for white Gaussian noise: 64 squared second
differences, correlated so that they count as 17 independent ones."""
_BIAS = 1.05
"""Down-weighting the high side loses 5 % of the variance of plain noise (simulated, smooth scenes)."""
_ITERATIONS = 24
_TINY = 1e-10


def high_pass(x: Float[Array, "*b h w c"]) -> Float[Array, "*b h-2 w-2 c"]:
    """Second difference along both axes within each channel, scaled to keep the variance of white noise.

    Zero for any bilinear scene, and uncorrelated with the 3x3 mean of white noise.
    """
    x = x[..., :-2, :, :] - 2 * x[..., 1:-1, :, :] + x[..., 2:, :, :]
    return (x[..., :-2, :] - 2 * x[..., 1:-1, :] + x[..., 2:, :]) / 6


def local_mean(x: Float[Array, "*b h w c"]) -> Float[Array, "*b h-2 w-2 c"]:
    """Mean of the 3x3 neighbourhood within each channel."""
    x = x[..., :-2, :, :] + x[..., 1:-1, :, :] + x[..., 2:, :, :]
    return (x[..., :-2, :] + x[..., 1:-1, :] + x[..., 2:, :]) / 9


def estimate_nlf(
    noisy: Float[Array, "*b h w c"],
) -> tuple[Float[Array, "c"], Float[Array, "c"]]:
    """Per channel (shot, read) of `var = shot * clean + read` from noisy images alone, normalised units.

    noisy: one image or several of the same camera and setting, h and w at least 16. Both are at least zero.
    An image of one level cannot tell shot from read: there only the variance at that level means anything;
    where all pixels are alike both are zero. Correlated noise (in-camera denoising) and clipped shadows read
    low, dense texture reads high.

    Median error of shot, read and sigma at 18 % grey, against fits that know the clean image, virtual cameras
    at all their ISOs: one patch of 64x64 packed pixels 15 %, 100 %, 6 % (one patch in ten: sigma off by more
    than 26 %); eight patches of a setting 8 %, 75 %, 3 %: what a scene without deep shadows says of read is
    next to nothing. Real bias frames and flats, sigma at their own level: 1 to 3 %, 7 to 8 %. Scenes on real
    darks of low noise (0.35 % at 18 % grey): sigma 15 to 22 % too high, for texture outweighs it.
    """
    images = noisy.reshape(-1, *noisy.shape[-3:])
    level = jnp.maximum(_block_means(local_mean(images)), 0)
    power = _block_means(jnp.square(high_pass(images)))
    level, power = (a.reshape(-1, a.shape[-1]) for a in (level, power))
    shot, read = jnp.zeros(level.shape[-1]), jnp.mean(power, 0) + _TINY
    for i in range(_ITERATIONS):
        predicted = shot * level + read + _TINY
        ratio = power / predicted
        if i < _ITERATIONS // 2:
            # A low expectile: finds the smooth blocks from wherever it starts.
            weight = jnp.where(ratio > 1, 0.1, 0.9)
        else:
            # Blocks within the spread of plain noise count in full, textured ones hardly.
            weight = 1 / (1 + jnp.square(jnp.maximum(ratio - 1, 0) / (2 * _SPREAD)) ** 2)
        # Only ratios of weights count; against the least variance the squares stay inside float32.
        least = lax.stop_gradient(jnp.min(predicted, 0))
        shot, read = _weighted_line(level, power, weight * jnp.square(least / predicted))
    return _BIAS * shot, _BIAS * read


def _block_means(x):
    """Means of overlapping blocks, `[n, rows, columns, c]`."""
    window = (1, BLOCK, BLOCK, 1)
    return lax.reduce_window(x, 0.0, lax.add, window, (1, STEP, STEP, 1), "VALID") / BLOCK**2


def _weighted_line(x, y, weight):
    """Weighted least squares of y = slope x + offset over the first axis, neither below zero."""
    weight = weight / jnp.sum(weight, 0)
    mean_x, mean_y = jnp.sum(weight * x, 0), jnp.sum(weight * y, 0)
    # A millesimal of the squared mean keeps images of one level from asking for a slope.
    spread = jnp.sum(weight * jnp.square(x - mean_x), 0) + 1e-3 * jnp.square(mean_x) + _TINY
    slope = jnp.sum(weight * (x - mean_x) * (y - mean_y), 0) / spread
    offset = mean_y - slope * mean_x
    through_zero = jnp.sum(weight * x * y, 0) / (jnp.sum(weight * x * x, 0) + _TINY)
    slope = jnp.where(offset < 0, through_zero, jnp.maximum(slope, 0))
    offset = jnp.where(slope > 0, jnp.maximum(offset, 0), mean_y)
    return slope, offset
