"""Random fields on the sites of a sensor: the draws behind the grammar. All have unit rms unless said."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from cannoise_jax.physics.core import tukey_lambda
from cannoise_jax.physics.core.places import NEAR, place
from cannoise_jax.physics.core.poisson_gaussian import centred_uniform, sample_normal

excess_kurtosis = tukey_lambda.excess_kurtosis


def group_of(point, size: tuple[int, int]) -> np.ndarray:
    """The group to which every row (or column) belongs, for a point whose rows (or columns) share numbers."""
    return (np.arange(size[0] if point.over == "row" else size[1]) + point.phase) // point.group


def site_shape(point, size: tuple[int, int]) -> tuple[int, ...]:
    """Shape of one number per site of a `grammar.Point`: rows (H,), raster (H*W,), pixels (H, W), channels
    (2, 2), blocks, or the groups of rows or columns."""
    if not point.plain:
        return ((int(group_of(point, size)[-1]) + 1) * point.interleave,)
    return place(point.over).sites(size, point.blocks)


def spread(drawn: Float[Array, "t ..."], point, size: tuple[int, int]) -> Float[Array, "t ..."]:
    """Site numbers [T, sites...] in a shape that broadcasts against [T, H, W]."""
    if point.plain:
        return place(point.over).spread(drawn, size)
    lines = drawn.reshape(drawn.shape[0], -1, point.interleave)[:, group_of(point, size)]
    if point.over == "column":
        lines = lines.transpose(0, 2, 1)
        return lines[:, np.arange(size[0]) % point.interleave]
    return lines[:, :, np.arange(size[1]) % point.interleave]


def group_lags(point, size: tuple[int, int], power) -> dict[tuple[int, int], Array]:
    """Covariance at lags one and two: across the rows (columns) `power` where both are of one group; along
    them, where their pixels take turns, `power` between those that share a number."""
    group, n = group_of(point, size), point.interleave
    lags = {}
    for k in (1, 2):
        alike = np.zeros(group.size, np.float32)
        alike[:-k] = group[k:] == group[:-k]
        shape = (-1, 1) if point.over == "row" else (1, -1)
        lags[lag(point.over, k, size[1])] = power * alike.reshape(shape)
        if n > 1:
            lags[lag("column" if point.over == "row" else "row", k, size[1])] = power * float(k % n == 0)
    return lags


def site_lags(point, size: tuple[int, int], power) -> dict[tuple[int, int], Array]:
    """Covariance at the lags of the place: `power` where both pixels share a number."""
    alike = place(point.over).alike
    if not alike:
        return {}
    count = int(np.prod(site_shape(point, size)))
    # Numbers of sites are exact in float32 up to 2^24.
    index = spread(jnp.arange(count, dtype=jnp.float32).reshape(1, *site_shape(point, size)), point, size)[0]
    there = jnp.pad(index, ((0, 2), (2, 2)), constant_values=-1)
    return {
        (dy, dx): power * (index == there[dy : dy + size[0], 2 + dx : 2 + dx + size[1]]) for dy, dx in alike
    }


def map_lags(field: Float[Array, "h w"], power) -> dict[tuple[int, int], Array]:
    """Covariance at lags up to two of one random number times a map: `power` times the products of its
    pixels."""
    h, w = field.shape
    there = jnp.pad(field, ((0, 2), (2, 2)))
    return {(dy, dx): power * field * there[dy : dy + h, 2 + dx : 2 + dx + w] for dy, dx in NEAR}


def kernel_correlations(kernel) -> dict[tuple[int, int], float]:
    """Correlation of white noise filtered by a square kernel at lags up to two, right and down."""
    side = int(len(kernel) ** 0.5)
    values = np.reshape(np.asarray(kernel, np.float64), (side, side))
    padded = np.pad(values, ((0, 2), (0, 2)))
    total = np.sum(values**2)
    return {
        (dy, dx): float(np.sum(values * padded[dy : dy + side, dx : dx + side]) / total) for dy, dx in NEAR
    }


def neighbours(key: Key[Array, ""], frames: int, size: tuple[int, int], kernel) -> Float[Array, "t h w"]:
    """White noise filtered by a square kernel (its values row by row, unit norm for unit variance), around
    the edges."""
    side = int(len(kernel) ** 0.5)
    white = sample_normal(key, (frames, *size))
    out = jnp.zeros_like(white)
    for n, weight in enumerate(kernel):
        if weight:
            shift = (n // side - side // 2, n % side - side // 2)
            out = out + weight * jnp.roll(white, shift, (1, 2))
    return out


def numbers(key: Key[Array, ""], shape: tuple[int, ...], distribution: str, values) -> Float[Array, "..."]:
    """Independent numbers of zero mean (a sparse field: positive) and unit rms."""
    if distribution == "gaussian":
        return sample_normal(key, shape)
    if distribution == "tukey_lambda":
        return tukey_lambda.standard_quantile(centred_uniform(key, shape), values["tukey_lambda"])
    where, height = jax.random.split(key)
    heights = -jnp.log1p(-jax.random.uniform(height, shape)) / jnp.sqrt(2.0)  # exponential of unit rms
    return sparse_sites(where, shape, values["fraction"]) * heights


def numbers_mean(distribution: str, values) -> Array | float:
    """Mean of the numbers of `numbers`: sparse heights are positive."""
    return jnp.sqrt(jnp.asarray(values["fraction"], jnp.float32) / 2) if distribution == "sparse" else 0.0


def sparse_sites(key: Key[Array, ""], shape: tuple[int, ...], fraction) -> Float[Array, "..."]:
    """1/sqrt(fraction) at a random share of the sites, else 0."""
    return (jax.random.uniform(key, shape) < fraction) / jnp.sqrt(jnp.asarray(fraction, jnp.float32))


def telegraph(key: Key[Array, ""], frames: int, sites: tuple[int, ...], rate) -> Float[Array, "t ..."]:
    """Two-level telegraph signal of +1 and -1: starts at random, jumps with chance `rate` from frame to
    frame."""
    first, jumps = jax.random.split(key)
    start = jax.random.bernoulli(first, 0.5, (1, *sites))
    jumped = jax.random.uniform(jumps, (frames, *sites)) < rate
    flips = jnp.cumsum(jumped.at[0].set(False), axis=0) % 2
    return jnp.where(start ^ (flips == 1), 1.0, -1.0)


def remember(raw: Float[Array, "t ..."], memory_frames) -> Float[Array, "t ..."]:
    """Stationary first-order autoregression over the frames of white `raw`: correlation exp(-n / memory)."""
    rho = jnp.exp(-1.0 / jnp.asarray(memory_frames, jnp.float32))

    def step(previous, new):
        now = rho * previous + jnp.sqrt(1 - rho**2) * new
        return now, now

    _, rest = jax.lax.scan(step, raw[0], raw[1:])
    return jnp.concatenate([raw[:1], rest])


def _shaping(length: int, exponent) -> Float[Array, "f"]:
    """Amplitude over frequency of a 1/f^exponent process on a circle of `length`, unit variance. The zero
    frequency gets the power of the lowest one, so that exponent 0 is exactly white."""
    frequency = jnp.maximum(jnp.fft.rfftfreq(length), 1.0 / length)
    power = (frequency * length) ** (-jnp.asarray(exponent, jnp.float32))
    twice = jnp.full(power.shape, 2.0).at[0].set(1.0)
    if length % 2 == 0:
        twice = twice.at[-1].set(1.0)
    return jnp.sqrt(power * length / jnp.sum(twice * power))


def colour(white: Float[Array, "... m"], exponent) -> Float[Array, "... n"]:
    """White noise of twice the length wanted, filtered along its last axis to a 1/f^exponent spectrum.
    Half of the circle is thrown away, so that the two ends of the result are not neighbours."""
    length = white.shape[-1]
    shaped = jnp.fft.irfft(jnp.fft.rfft(white) * _shaping(length, exponent), length)
    return shaped[..., : length // 2]


def power_law_correlation(exponent, length: int) -> Float[Array, "n"]:
    """Correlation of a power-law sequence of a length at all its lags."""
    circle = 2 * length
    return jnp.fft.irfft(_shaping(circle, exponent) ** 2, circle)[:length]


def within_frame(exponent: float, over: str, size: tuple[int, int]) -> float:
    """Standard deviation within a frame of a power-law field along its axis that is drawn at one of 1."""
    (length,) = place(over).sites(size, (1, 1))
    return _about_mean(round(float(exponent), 3), length)


@functools.lru_cache(maxsize=64)
def _about_mean(exponent: float, length: int) -> float:
    correlation = np.asarray(power_law_correlation(exponent, length), np.float64)
    of_mean = (2 * np.sum((1 - np.arange(length) / length) * correlation) - correlation[0]) / length
    return float(np.sqrt(max(1 - of_mean, 0.1)))


def correlations(exponent, over: str, size: tuple[int, int]) -> dict[int, Array]:
    """Correlation of a power-law field at small steps along its axis."""
    (length,) = place(over).sites(size, (1, 1))
    correlation = power_law_correlation(exponent, length)
    return {k: correlation[k] for k in place(over).steps(size[1])}


def lag(over: str, step: int, width: int) -> tuple[int, int]:
    """A step along the axis as a pixel lag (dy, dx)."""
    return place(over).lag(step, width)


def sinusoid(
    key: Key[Array, ""], frames: int, sites: tuple[int, ...], frequency, *, redrawn: bool, late: float = 0.0
):
    """cos(2 pi f n + phase - late) along the sites, unit peak, with a random phase per frame (frozen: one
    phase), that of the key. late: radians."""
    phase = jax.random.uniform(key, (frames, 1)) * (2 * jnp.pi)
    steps = 1
    for s in sites:
        steps *= s
    # Frequency times index loses float32 digits on long scans: reduce it in two exact parts.
    index = jnp.arange(steps)
    high, low = index // 4096, index % 4096
    cycles = (frequency * 4096 % 1.0) * high % 1.0 + frequency * low % 1.0
    return jnp.cos(2 * jnp.pi * cycles + (phase - late)).reshape(frames, *sites)


def plane_wave(
    key: Key[Array, ""], frames: int, size: tuple[int, int], down, across
) -> Float[Array, "t h w"]:
    """cos(2 pi (down y + across x) + phase), cycles per pixel, unit peak, with a random phase per frame."""
    phase = jax.random.uniform(key, (frames, 1, 1)) * (2 * jnp.pi)
    y, x = jnp.arange(size[0])[:, None], jnp.arange(size[1])
    # Whole cycles go first: float32 has few digits left for what remains of many.
    return jnp.cos(2 * jnp.pi * (down * y % 1.0 + across * x % 1.0) + phase)
