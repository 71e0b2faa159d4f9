"""The noise level function of one image from that image alone, in JAX.

Second differences along both axes cancel scene content that is smooth over three pixels of a plane; what is
left has the noise's variance where the scene is smooth, and more where it is not. The variance is therefore
fitted against the signal over small blocks, blocks far above the fit counting less and less. The idea of a
fit to the smooth part of an image follows Foi et al., IEEE Trans. Image Process. 17(10), 2008.

The colour planes are looked at together. Noise is independent between them and texture is not, so that a
block shows its texture by what its planes share, and by four times as many values as one plane has. One line
is fitted to all planes, each of which then differs from it by a factor.
"""

from __future__ import annotations

from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from cannoise_jax.physics.hidden_level import hidden_level

BLOCK, STEP = 8, 4
"""Pixels along a side of a block of one colour, and from one block to the next."""
_SPREAD = 0.34
"""Relative standard deviation of a block's mean square for white Gaussian noise: 64 squared second
differences, correlated so that they count as 17 independent ones."""
_SHARED = 0.24 / 6**0.5
"""Standard deviation of a block's correlation of two planes, mean over six pairs: 1/17^(1/2) each."""
_CHANNEL = 0.03
"""Relative standard deviation of the planes' variances about a common line, as measured on cameras whose
planes have the same gain."""
_LEAST_READ, _LEAST_SHOT = 0.002, 0.02
"""Shares of the variance at the mean signal that count as read and as shot at least: an image without dark
parts fits a line through zero as well as any."""
_BIAS = 1.01
"""Down-weighting the high side loses 1 % of the variance of plain noise (simulated, smooth scenes)."""
_CLIPPED = 0.1
"""Share of pixels at a rail from which on a block counts less: a tenth of the variance is lost there."""
_ITERATIONS = 20
"""Reweighted fits, half of them by each rule."""
_TINY = 1e-10
"""A variance that counts as none, and keeps quotients finite: that of `FLOOR`."""
FLOOR = 1e-5
"""Noise below this (normalised units) counts as none; far below the quantisation of 16 bits."""


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


@jax.jit
def estimate_nlf(
    noisy: Float[Array, "*b h w c"],
) -> tuple[Float[Array, "c"], Float[Array, "c"]]:
    """Per channel (shot, read) of `var = shot * clean + read` from noisy images alone, normalised units.

    noisy: one image or several of the same camera and setting, h and w at least 16. Both are at least zero.
    An image of one level cannot tell shot from read: there only the variance at that level means anything;
    where all pixels are alike both are zero. What neighbours that are alike (in-camera denoising) hide is put
    back, as far as the images show it, see `hidden_level`: four planes only. Clipped shadows read low, dense
    texture reads high; noise common to a row or a column is not seen.
    """
    shot, read = residual_nlf(noisy)
    images = noisy.reshape(-1, *noisy.shape[-3:])
    if images.shape[-1] != 4:
        return shot, read
    residual = high_pass(images)
    variance = residual_variance(images, shot, read)
    z = residual * lax.rsqrt(variance)
    gain = jnp.exp(2 * hidden_level(z, smoothness(residual, variance))[0])
    return gain * shot, gain * read


def residual_variance(noisy: Float[Array, "b h w c"], shot, read) -> Float[Array, "b h-2 w-2 c"]:
    """Variance of the high-pass residual at each pixel for `residual_nlf`, broadcast over the last axes."""
    return jnp.maximum(shot * jnp.maximum(local_mean(noisy), 0) + read, FLOOR**2)


def residual_nlf(
    noisy: Float[Array, "*b h w c"],
) -> tuple[Float[Array, "c"], Float[Array, "c"]]:
    """`estimate_nlf` as the high-pass residual has it: that of white noise which would leave the same."""
    images = noisy.reshape(-1, *noisy.shape[-3:])
    channels = images.shape[-1]
    residual = high_pass(images)
    pairs = np.array(list(combinations(range(channels), 2)), int).reshape(-1, 2)
    first, second = pairs[:, 0], pairs[:, 1]
    products = jnp.concatenate([jnp.square(residual), residual[..., first] * residual[..., second]], -1)
    at_rail = _block_means(jnp.any(_at_rail(images), -1, keepdims=True)[:, 1:-1, 1:-1].astype(jnp.float32))
    usable = _gentle(at_rail.reshape(-1, 1) / _CLIPPED)
    level = jnp.maximum(_block_means(local_mean(images)), 0).reshape(-1, channels)
    means = _block_means(products)
    means = means.reshape(-1, means.shape[-1])
    power, shared = means[:, :channels], means[:, channels:]
    # Blocks of one code alone hide noise below a code: a line through them would be zero.
    usable = jnp.where(jnp.mean(power, -1, keepdims=True) > _TINY, usable, 1e-6)
    spread = _SPREAD / channels**0.5

    def fitted(line, smooth_blocks):
        """One step of the fit, with the weights that it took; loops keep what is compiled small."""
        shot, read = line
        predicted = shot * level + read + _TINY
        ratio = jnp.mean(power / predicted, -1, keepdims=True)
        weight = smooth_blocks(ratio, predicted) * usable
        # Only ratios of weights count; against the least variance the squares stay inside float32.
        least = lax.stop_gradient(jnp.min(predicted))
        whole = weight * jnp.square(least / predicted)
        shot, read = (v[0] for v in _weighted_line(*(_column(v) for v in (level, power, whole))))
        return (shot, read), weight

    def low_expectile(ratio, predicted):
        """Finds the smooth blocks from wherever it starts."""
        return jnp.where(ratio > 1, 0.1, 0.9)

    def within_spread(ratio, predicted):
        """Blocks within the spread of plain noise count in full, textured ones hardly."""
        correlation = shared / jnp.sqrt(predicted[:, first] * predicted[:, second])
        texture = jnp.sum(correlation, -1, keepdims=True) / max(len(pairs), 1)
        return _gentle((ratio - 1) / (2 * spread)) * _gentle(texture / (2 * _SHARED))

    line = jnp.zeros(()), jnp.mean(power) + _TINY
    for smooth_blocks, steps in ((low_expectile, _ITERATIONS // 2), (within_spread, _ITERATIONS // 2 - 1)):
        line = lax.fori_loop(0, steps, lambda _, now, kind=smooth_blocks: fitted(now, kind)[0], line)
    (shot, read), weight = fitted(line, within_spread)
    total = jnp.sum(weight, 0)
    factor = jnp.sum(weight * power / (shot * level + read + _TINY), 0) / total
    # Blocks overlap fourfold; a plane's own factor counts as far as it is better known than the prior.
    known = total / 4 / _SPREAD**2
    factor = (known * factor + 1 / _CHANNEL**2) / (known + 1 / _CHANNEL**2)
    shot, read = _both_present(shot, read, jnp.sum(weight * level) / jnp.sum(weight * jnp.ones_like(level)))
    seen = jnp.mean(power) > _TINY
    return tuple(jnp.where(seen, _BIAS * factor * v, 0) for v in (shot, read))  # type: ignore[return-value]


def smoothness(residual: Float[Array, "b h w c"], variance: Float[Array, "b h w c"]) -> Float[Array, "b h w"]:
    """From 1 where the high-pass residual is noise of this variance to 0 where it holds texture: by the mean
    square around each pixel, all planes together, and by what the planes share."""
    channels = residual.shape[-1]
    z = residual * lax.rsqrt(variance)
    power = jnp.mean(jnp.square(z), -1)
    shared = (jnp.square(jnp.sum(z, -1)) / channels - power) / max(channels - 1, 1)
    window = (1, BLOCK, BLOCK)
    power, shared = (
        lax.reduce_window(v, 0.0, lax.add, window, (1, 1, 1), "SAME") / BLOCK**2 for v in (power, shared)
    )
    return _gentle((power - 1) / (2 * _SPREAD / channels**0.5)) * _gentle(shared / (2 * _SHARED))


def _at_rail(images):
    """Where a value is as low or as high as codes go: at white, and at black where none lies below it."""
    lowest = jnp.min(images)
    return (images >= 1) | ((images <= 0) & (lowest >= 0))


def _gentle(excess):
    """A weight that falls from one as the excess grows past one; one below zero."""
    return 1 / (1 + jnp.square(jnp.square(jnp.maximum(excess, 0))))


def _column(values):
    return values.reshape(-1, 1)


def _both_present(shot, read, level):
    """The line with the least shares of shot and read, and the same variance at `level`."""
    variance = shot * level + read
    shot = shot + _LEAST_SHOT * variance / jnp.maximum(level, 1e-3)
    read = read + _LEAST_READ * variance
    kept = variance / (shot * level + read + _TINY)
    return kept * shot, kept * read


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
