"""What the noise of one image looks like, as numbers that scene content hardly moves.

A camera is told apart by how its noise grows with the signal, by its tails, by what rows and neighbouring
pixels share. A global average of instance-normalised features holds little of that: the norm erases the
level, and the scene outweighs noise a hundredfold. These statistics are taken on residuals in which smooth
scene content cancels; they are means over the image, so that any size of image gives the same expectation.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from cannoise_jax.physics.hidden_level import hidden_level
from cannoise_jax.physics.single_image import (
    FLOOR,
    high_pass,
    local_mean,
    residual_nlf,
    residual_variance,
    smoothness,
)

# Signal levels at which the noise level is read off, normalised units; log(m + TOE) is about uniform over
# them.
LEVELS = np.array([0.0, 0.02, 0.06, 0.15, 0.4], np.float32)
TOE = 0.01
TAILS = (2.5, 3.5, 5.0)
LINES = 0.01
"""What lines seem to share by chance in a few patches of 64 x 64, against the variance of dark pixels."""
SPACINGS = 1, 2
"""Of the differences that show what lines share, pixels of a colour plane."""
RUN, BOUND = 8, 2.0
"""Pixels along a line that are taken together, and how far such a run counts, in units of its noise."""


def _level_weights(mean):
    """Hat functions of the signal level, `[..., levels]`; they sum to one."""
    knots = jnp.log(LEVELS + TOE)
    position = jnp.clip(jnp.log(jnp.maximum(mean, 0) + TOE), knots[0], knots[-1])[..., None]
    left, right = jnp.diff(knots, prepend=knots[0] - 1), jnp.diff(knots, append=knots[-1] + 1)
    return jnp.clip(jnp.minimum(1 + (position - knots) / left, 1 - (position - knots) / right), 0, 1)


def noise_statistics(
    noisy: Float[Array, "b h w 4"],
) -> tuple[Float[Array, "b s"], Float[Array, "b h-2 w-2 4"]]:
    """Statistics of each image's noise, of order one, and its high-pass residual in units of its own level,
    faded out where there is texture.

    In order: log noise level at five signal levels for each channel (empty levels fall back on the rest) and
    how many pixels lie there, once over all of the image and once, all channels together, over its smooth
    part; how large that part is; logs of estimated shot and read noise; per channel kurtosis, shares beyond
    2.5, 3.5 and 5 sigma; the same of dark, smooth parts; correlation of horizontal and vertical neighbours;
    correlation of channel pairs; what rows and what columns share, at lags of 0 to 4 of one colour and of 1
    to 3 sensor lines, narrow and wide, and in how many pairs of places; how much of the darkest noise is read
    noise; how many pixels lie below and exactly at the black level, which tells whether the camera's codes
    end there; how much of the level neighbours that are alike hide, and the weight of their blend.
    """
    residual, mean = high_pass(noisy), local_mean(noisy)
    weights = _level_weights(mean)
    size = jnp.abs(residual)
    total = jnp.mean(size, (1, 2))[..., None] + FLOOR
    share = jnp.mean(weights, (1, 2))
    # 0.1 % of prior weight: a level that holds fewer pixels says the image's average instead.
    level = (jnp.mean(weights * size[..., None], (1, 2)) + 1e-3 * total) / (share + 1e-3) + FLOOR
    shot, read = jax.vmap(residual_nlf)(noisy)
    variance = residual_variance(noisy, shot[:, None, None], read[:, None, None])
    smooth = smoothness(residual, variance)
    z = residual * lax.rsqrt(variance)
    hidden, blend = jax.vmap(lambda z, smooth: hidden_level(z[None], smooth[None]))(z, smooth)
    part = smooth[..., None]
    dark = part * (shot[:, None, None] * jnp.maximum(mean, 0) < 2 * read[:, None, None])
    soft = jnp.tanh(z / 2)
    smooth_share = jnp.mean(part[..., None] * weights, (1, 2, 3))
    smooth_power = jnp.mean((part * jnp.minimum(jnp.square(z), 50))[..., None] * weights, (1, 2, 3))

    def correlation(a, b, weight):
        return 4 * _weighted(a * b, weight)

    pairs = [(0, 1), (2, 3), (0, 3), (1, 2), (0, 2), (1, 3)]
    flat = (*noisy.shape[:1], -1)
    parts = [
        (jnp.log(level) + 5).reshape(flat),
        jnp.mean(share, 1),
        4 * jnp.log((smooth_power + 1e-3) / (smooth_share + 1e-3)),
        smooth_share,
        jnp.mean(part, (1, 2, 3))[:, None],
        (jnp.log(jnp.stack([jnp.mean(shot, -1), jnp.mean(read, -1)], -1) + 1e-8) + 8) / 2 + hidden[:, None],
        *_tails(z, part),
        *(jnp.mean(t, -1, keepdims=True) for t in _tails(z, dark)),
        jnp.mean(dark, (1, 2, 3))[:, None],
        correlation(soft[:, :, 1:], soft[:, :, :-1], part[:, :, 1:]),
        correlation(soft[:, 1:], soft[:, :-1], part[:, 1:]),
        jnp.stack([correlation(soft[..., a], soft[..., b], smooth) for a, b in pairs], -1),
        *_line_offsets(noisy, variance, smooth),
        *_line_offsets(*(jnp.swapaxes(v, 1, 2) for v in (_transposed(noisy), _transposed(variance), smooth))),
        jnp.log(jnp.mean(read, -1) / _dark_variance(variance, smooth) + 1e-3)[:, None] / 2,
        (jnp.log(jnp.stack([_share(noisy < 0), _share(noisy == 0)], -1) + 1e-4) + 5) / 3,
        10 * jnp.stack([hidden, blend], -1),
    ]
    return jnp.concatenate(parts, -1), z * part


def _weighted(values, weight):
    """Mean over an image's pixels, where there is any weight; towards zero where there is hardly any."""
    return jnp.sum(values * weight, (1, 2)) / (jnp.sum(weight * jnp.ones_like(values), (1, 2)) + 20)


def _tails(z, weight):
    """Per channel log of the fourth moment, and of the shares beyond the thresholds."""
    yield jnp.log(_weighted(jnp.minimum(jnp.square(jnp.square(z)), 1e3), weight) + 1)
    for t in TAILS:
        yield (jnp.log(_weighted(jax.nn.sigmoid((jnp.abs(z) - t) * 5), weight) + 1e-3) + 5) / 2


def _share(condition):
    return jnp.mean(condition.astype(jnp.float32), (1, 2, 3))


def _transposed(image):
    """The packed channels as they lie in a transposed mosaic: rows become columns."""
    return image[..., np.array([0, 2, 1, 3])]


def _line_offsets(noisy, variance, smooth):
    """What the pixels of a row have in common beside the scene.

    Pixels are weighted by their inverse variance and taken together in runs along the row. Noise of pixels
    and texture, which is alike over a few pixels, leave nothing in the products of runs that lie apart, and
    a run that an edge of the scene moves is bounded. Products at lags of 0 to 4 rows of one colour, and of
    sensor rows that lie 1, 1 and 3 apart; with wider differences, which see more of what is slow and more of
    the scene, of the same row and of rows 1 apart; all in units of the noise of dark pixels; and how many
    there are.
    """
    dark = lax.stop_gradient(_dark_variance(variance, smooth))[:, None, None, None]
    scaled = noisy / jnp.sqrt(dark), variance / dark, smooth
    near, wide = (_products_along(*scaled, spacing) for spacing in SPACINGS)
    pairs = [_sum(near(0, 0, k), near(1, 1, k)) for k in range(5)]
    pairs += [near(0, 1, 0), near(1, 0, 1), near(0, 1, 1)]
    pairs += [_sum(wide(0, 0, 0), wide(1, 1, 0)), _sum(wide(0, 1, 0), wide(1, 0, 1))]
    shared = jnp.stack([power / (weights + 1) for power, weights in pairs], -1)
    # Shares of the variance: of the order of their chance below LINES, logarithmic above.
    return jnp.arcsinh(shared / LINES) / 2, jnp.log1p(pairs[0][1])[:, None] / 8


def _sum(first, second):
    return tuple(a + b for a, b in zip(first, second, strict=True))


def _products_along(noisy, variance, smooth, spacing: int):
    """(upper or lower channels of one, of the other, rows between) -> sums over the image of products of runs
    along the rows, and of the products of their weights.

    Of second differences down the columns, of pixels that lie `spacing` apart in a colour plane: they have no
    memory for slow scene content, and keep of slow offsets what tells them from white ones.
    """
    difference = noisy[:, : -2 * spacing] - 2 * noisy[:, spacing:-spacing] + noisy[:, 2 * spacing :]
    difference = difference[:, :, 1:-1] / 6**0.5
    inner = slice(spacing - 1, variance.shape[1] - spacing + 1)
    variance, smooth = variance[:, inner], smooth[:, inner]
    batch, height, width, _ = difference.shape
    run = min(RUN, max(width // 4, 1))
    count = width // run
    sigma = jnp.sqrt(variance)
    weight = smooth[..., None] / variance

    def in_runs(values):
        """Sums over each run of both channels of a sensor row, `[b, h, runs, 2]`: the upper and the lower."""
        return jnp.sum(values[:, :, : count * run].reshape(batch, height, count, run, 2, 2), (3, 5))

    total = in_runs(weight * 2 * sigma * jnp.tanh(difference / sigma / 2))
    known = in_runs(weight)
    spread = jnp.sqrt(known + FLOOR)
    total = spread * BOUND * jnp.tanh(total / spread / BOUND)
    # What all rows share is no offset of rows, but the bend of the scene's shading and of bounded noise.
    centre = jnp.sum(total, (1, 2), keepdims=True) / (jnp.sum(known, (1, 2), keepdims=True) + FLOOR)
    total = total - known * centre
    places = np.arange(count)
    apart = (np.abs(np.subtract.outer(places, places)) > 1).astype(np.float32)

    def products(first: int, second: int, lag: int):
        rows = height - lag
        return tuple(
            jnp.einsum("bti,ij,btj->b", v[:, :rows, :, first], apart, v[:, lag:, :, second])
            for v in (total, known)
        )

    return products


def _dark_variance(variance, smooth):
    """Harmonic mean of the variance over the smooth part: that of the darkest pixels, `[b]`."""
    total = jnp.sum(smooth[..., None] / variance, (1, 2, 3))
    return (jnp.sum(smooth, (1, 2)) * variance.shape[-1] + FLOOR) / (total + FLOOR / jnp.mean(variance))
