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
from jaxtyping import Array, Float

from cannoise_jax.physics.single_image import high_pass, local_mean

# Signal levels at which the noise level is read off, normalised units; log(m + TOE) is about uniform over
# them.
LEVELS = np.array([0.0, 0.02, 0.06, 0.15, 0.4], np.float32)
TOE = 0.01
FLOOR = 1e-5
"""Noise below this (normalised units) counts as none; far below the quantisation of 16 bits."""
TAILS = (2.5, 3.5, 5.0)


def _level_weights(mean):
    """Hat functions of the signal level, `[..., levels]`; they sum to one."""
    knots = jnp.log(LEVELS + TOE)
    position = jnp.clip(jnp.log(jnp.maximum(mean, 0) + TOE), knots[0], knots[-1])[..., None]
    left, right = jnp.diff(knots, prepend=knots[0] - 1), jnp.diff(knots, append=knots[-1] + 1)
    return jnp.clip(jnp.minimum(1 + (position - knots) / left, 1 - (position - knots) / right), 0, 1)


def noise_statistics(
    noisy: Float[Array, "b h w 4"],
) -> tuple[Float[Array, "b s"], Float[Array, "b h-2 w-2 4"]]:
    """Statistics of each image's noise, of order one, and its high-pass residual in units of its own level.

    In order: log noise level at five signal levels for each channel (empty levels fall back on the rest) and
    how many pixels lie there; per channel kurtosis, shares beyond 2.5, 3.5 and 5 sigma; correlation of
    horizontal and vertical neighbours; correlation of channel pairs; size of row offsets against white noise,
    and how much of them the two channels of a sensor row share; how many pixels lie below and exactly at the
    black level, which tells whether the camera's codes end there.
    """
    residual, mean = high_pass(noisy), local_mean(noisy)
    weights = _level_weights(mean)
    size = jnp.abs(residual)
    total = jnp.mean(size, (1, 2))[..., None] + FLOOR
    share = jnp.mean(weights, (1, 2))
    # 0.1 % of prior weight: a level that holds fewer pixels says the image's average instead.
    level = (jnp.mean(weights * size[..., None], (1, 2)) + 1e-3 * total) / (share + 1e-3) + FLOOR
    sigma = jnp.sum(weights * level[:, None, None], -1)
    z = residual / sigma * np.float32(np.sqrt(2 / np.pi))  # mean absolute value to standard deviation
    soft = jnp.tanh(z / 2)

    def correlation(a, b):
        return 4 * jnp.mean(a * b, (1, 2))

    tails = [jnp.mean(jax.nn.sigmoid((jnp.abs(z) - t) * 5), (1, 2)) for t in TAILS]
    pairs = [(0, 1), (2, 3), (0, 3), (1, 2), (0, 2), (1, 3)]
    rows, shared_rows = _row_offsets(noisy, sigma)
    flat = (*noisy.shape[:1], -1)
    parts = [
        (jnp.log(level) + 5).reshape(flat),
        jnp.mean(share, 1),
        jnp.log(jnp.mean(jnp.minimum(jnp.square(z), 100), (1, 2)) + FLOOR),
        *((jnp.log(t + 1e-3) + 5) / 2 for t in tails),
        correlation(soft[:, :, 1:], soft[:, :, :-1]),
        correlation(soft[:, 1:], soft[:, :-1]),
        jnp.stack([correlation(soft[..., a], soft[..., b]) for a, b in pairs], -1),
        rows,
        shared_rows,
        (jnp.log(jnp.stack([_share(noisy < 0), _share(noisy == 0)], -1) + 1e-4) + 5) / 3,
    ]
    return jnp.concatenate(parts, -1), z


def _share(condition):
    return jnp.mean(condition.astype(jnp.float32), (1, 2, 3))


def _row_offsets(noisy, sigma):
    """Log size of row-mean second differences against white noise; correlation in and across rows."""
    rows = jnp.mean(noisy, 2)
    width = noisy.shape[2]
    difference = (rows[:, :-2] - 2 * rows[:, 1:-1] + rows[:, 2:]) / 6**0.5
    white = jnp.sqrt(jnp.mean(jnp.square(sigma), 2) / width) + FLOOR
    units = difference / white
    soft = jnp.tanh(units / 4)
    power = jnp.mean(jnp.square(soft), 1) + 1e-3
    shared = jnp.mean(soft[..., 0] * soft[..., 1] + soft[..., 2] * soft[..., 3], 1)
    crossed = jnp.mean(soft[..., 0] * soft[..., 3] + soft[..., 1] * soft[..., 2], 1)
    scale = jnp.mean(power, -1)
    return jnp.log(power) + 2, jnp.stack([shared / scale, crossed / scale], -1)
