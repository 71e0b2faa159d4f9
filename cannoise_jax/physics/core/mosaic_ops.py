"""Small operations on mosaics [..., H, W] that several mechanisms share. Edges repeat the last sample."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm
from jaxtyping import Array, Float


def shifted(x: Float[Array, "... h w"], dy: int, dx: int) -> Float[Array, "... h w"]:
    """x at (i + dy, j + dx); beyond the edge the last sample of the same colour where the step is even."""
    height, width = x.shape[-2:]

    def index(n: int, step: int) -> np.ndarray:
        i = np.arange(n) + step
        unit = 2 if step % 2 == 0 and n > 1 else 1
        i = np.where(i < 0, np.arange(n) % unit, i)
        last = n - 1 - (n - 1 - np.arange(n)) % unit
        return np.where(i > n - 1, last, i)

    return x[..., index(height, dy)[:, None], index(width, dx)[None, :]]


def neighbour_mean(x: Float[Array, "... h w"], distance: int) -> Float[Array, "... h w"]:
    """Mean of the four neighbours at a distance: 1 on the mosaic, 2 within one colour."""
    steps = ((0, distance), (0, -distance), (distance, 0), (-distance, 0))
    return jnp.asarray(sum(shifted(x, dy, dx) for dy, dx in steps)) / 4


def neighbour_maximum(x: Float[Array, "... h w"]) -> Float[Array, "... h w"]:
    """Largest of the eight neighbours of the same colour."""
    steps = [(dy, dx) for dy in (-2, 0, 2) for dx in (-2, 0, 2) if (dy, dx) != (0, 0)]
    return jnp.max(jnp.stack([shifted(x, dy, dx) for dy, dx in steps]), axis=0)


def moved(x: Float[Array, "t h w"], dy: Float[Array, "t"], dx: Float[Array, "t"]) -> Float[Array, "t h w"]:
    """x at (i + dy, j + dx), one movement in pixels per frame, linear between samples of the same colour."""

    def along(x, step, axis):
        n = x.shape[axis]
        whole = jnp.floor(step / 2)
        share = (step / 2 - whole).reshape(-1, 1, 1)
        shape = [1, 1, 1]
        shape[axis] = n
        i = jnp.arange(n).reshape(shape) + (2 * whole).astype(jnp.int32).reshape(-1, 1, 1)
        parity = jnp.arange(n).reshape(shape) % 2

        def take(i):
            low, high = parity, n - 1 - (n - 1 - parity) % 2
            return jnp.take_along_axis(x, jnp.clip(i, low, high), axis=axis)

        return (1 - share) * take(i) + share * take(i + 2)

    return along(along(x, jnp.asarray(dy, jnp.float32), 1), jnp.asarray(dx, jnp.float32), 2)


def cut_below(mean, variance, limit):
    """Mean and variance of a Gaussian whose values below `limit` are set to it (censored from below)."""
    sigma = jnp.sqrt(variance)
    a = (limit - mean) / sigma
    density, below = norm.pdf(a), norm.cdf(a)
    first = mean * (1 - below) + sigma * density + limit * below
    second = (mean**2 + variance) * (1 - below) + sigma * (mean + limit) * density + limit**2 * below
    return first, jnp.maximum(second - first**2, 0.0)


def cut_above(mean, variance, limit):
    """Mean and variance of a Gaussian whose values above `limit` are set to it."""
    first, second = cut_below(-mean, variance, -limit)
    return -first, second
