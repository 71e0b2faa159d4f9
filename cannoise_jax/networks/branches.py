"""The physical part of the generator: small differentiable branches, each with a parameter that a camera has.

Initial noise of standard deviation sigma is z = n_init / sigma. With a second draw w, independent of it,
u = cos z + sin w and v = sin z - cos w are independent standard normals for any angle; with
cos^2 = shot x / sigma^2 the parts sigma cos u of the photons and sigma sin v of the read-out add up to n_init
again. Each part can then be given the law that it has in a camera, and where there is nothing to give, the
noise stays the initial noise.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Key

from cannoise_jax.physics.core.tukey_lambda import standard_quantile

LEAST_SHOT, LEAST_READ = 1e-7, 1e-9
"""Levels count as no lower than this, normalised units, so that they can be multiplied."""
TAIL_CENTRE, TAIL_REACH = 0.02, 0.24
GAUSSIAN_TAIL = 0.135
"""The Tukey-lambda shape that is close to a Gaussian."""
MOST_SHARE, MOST_BLEND = 0.25, 0.4
_MEMORIES = (0.5, 0.85, 0.96, 0.99)
"""Autoregressions of equal power at these octaves of memory add up to about 1/f."""
_MOST_SKEW = 1.0
_EDGE = 1 - 2.0**-23


class NoiseLevel(NamedTuple):
    """What is known of the noise's level: shot and read (packed order, normalised units), whether they were
    handed over (1) or estimated (0), and how many images they, and the camera, were read off."""

    shot: Float[Array, "b 4"]
    read: Float[Array, "b 4"]
    known: Float[Array, "b"]
    shown: Float[Array, "b"]


class Physics(NamedTuple):
    """Parameters of the branches, one set an image.

    log_shot, log_read: log of the whole shot and read variance against the level. tail: Tukey-lambda shape of
    the pixels' read noise. row, slow_row, column: shares of the read variance that rows (white, about 1/f)
    and columns have in common. blend: weight of the mean of four neighbours of one colour. offset: of each
    channel, in units of the read noise.
    """

    log_shot: Float[Array, "b"]
    log_read: Float[Array, "b"]
    tail: Float[Array, "b"]
    row: Float[Array, "b"]
    slow_row: Float[Array, "b"]
    column: Float[Array, "b"]
    blend: Float[Array, "b"]
    offset: Float[Array, "b 4"]


class Draws(NamedTuple):
    """Standard normal draws beside the initial noise. pixels: of every value; rows, slow: of every sensor
    row, white and about 1/f; columns: of every sensor column."""

    pixels: Float[Array, "b h w 4"]
    rows: Float[Array, "b h 2"]
    slow: Float[Array, "b h 2"]
    columns: Float[Array, "b w 2"]


OUTPUTS = 7 + 4


def branch_draws(key: Key[Array, ""], shape: tuple[int, ...]) -> Draws:
    """Those of images `[b, h, w, 4]`."""
    pixel_key, line_key = jax.random.split(key)
    return Draws(jax.random.normal(pixel_key, shape), *line_draws(line_key, *shape[:3]))


def line_draws(key: Key[Array, ""], images: int, height: int, width: int) -> tuple[Array, Array, Array]:
    """Those of `Draws` that whole lines have in common."""
    row_key, slow_key, column_key = jax.random.split(key, 3)
    return (
        jax.random.normal(row_key, (images, height, 2)),
        _slow(slow_key, images, height),
        jax.random.normal(column_key, (images, width, 2)),
    )


def physics_of(raw: Float[Array, "b 11"]) -> Physics:
    """Parameters within their bounds from numbers without; zeros give (next to) Gaussian, white noise."""
    scalars = jnp.moveaxis(raw[:, :7], -1, 0)
    start = jnp.arctanh((GAUSSIAN_TAIL - TAIL_CENTRE) / TAIL_REACH)
    row, slow_row, column = MOST_SHARE * jax.nn.sigmoid(scalars[3:6] - 4)
    return Physics(
        3 * jnp.tanh(scalars[0] / 3),
        3 * jnp.tanh(scalars[1] / 3),
        TAIL_CENTRE + TAIL_REACH * jnp.tanh(start + scalars[2]),
        row,
        slow_row,
        column,
        MOST_BLEND * jax.nn.sigmoid(scalars[6] - 4),
        0.5 * jnp.tanh(raw[:, 7:]),
    )


def line_variance(
    physics: Physics, level: NoiseLevel, clean: Float[Array, "b h w 4"]
) -> Float[Array, "b h w 4"]:
    """Variance of the branches' noise at every pixel: the level, each part scaled."""
    shot, read = _scaled(physics, level)
    return shot * jnp.maximum(clean, 0) + read


def physical_noise(
    draws: Draws,
    z: Float[Array, "b h w 4"],
    clean: Float[Array, "b h w 4"],
    level: NoiseLevel,
    physics: Physics,
) -> Float[Array, "b h w 4"]:
    """Noise of these parameters, normalised units, from initial noise z = n_init / sigma."""
    signal = jnp.maximum(clean, 0)
    of_level = (_per_image(jnp.maximum(v, m)) for v, m in zip(level, (LEAST_SHOT, LEAST_READ), strict=False))
    share = signal * next(of_level)
    share = share / (share + next(of_level))
    cos, sin = jnp.sqrt(share + 1e-7), jnp.sqrt(1 - share + 1e-7)
    u, v = cos * z + sin * draws.pixels, sin * z - cos * draws.pixels
    shot, read = _scaled(physics, level)
    common = physics.row + physics.slow_row + physics.column
    pixels = jnp.sqrt(read * (1 - _per_image(common)))
    noise = jnp.sqrt(shot * signal + 1e-7 * read) * _skewed(u, shot, signal)
    noise = _blended(noise + pixels * _tailed(v, physics.tail), physics.blend)
    # R and Gr lie in one sensor row, Gb and B in the next; R and Gb in one column, Gr and B in the next.
    rms = [jnp.sqrt(share)[:, None, None] for share in (physics.row, physics.slow_row, physics.column)]
    rows, columns = rms[0] * draws.rows + rms[1] * draws.slow, rms[2] * draws.columns
    lines = jnp.repeat(rows, 2, -1)[:, :, None] + jnp.tile(columns, 2)[:, None]
    return noise + jnp.sqrt(read) * (lines + physics.offset[:, None, None])


def _scaled(physics: Physics, level: NoiseLevel):
    shot = jnp.maximum(level.shot, LEAST_SHOT) * jnp.exp(physics.log_shot)[:, None]
    read = jnp.maximum(level.read, LEAST_READ) * jnp.exp(physics.log_read)[:, None]
    return shot[:, None, None], read[:, None, None]


def _per_image(values):
    """[b] or [b, 4] beside [b, h, w, 4]."""
    return values[:, None, None, None] if values.ndim == 1 else values[:, None, None]


def _skewed(u, shot, signal):
    """Standard normals with the third moment of Poisson counts, 1 / sqrt(count) (Cornish and Fisher)."""
    skew = jnp.sqrt(jnp.minimum(shot / jnp.maximum(signal, 1e-6), _MOST_SKEW**2))
    return (u + skew / 6 * (jnp.square(u) - 1)) / jnp.sqrt(1 + jnp.square(skew) / 18)


def _tailed(v, tail):
    """Standard normals as Tukey-lambda numbers of unit variance."""
    level = jnp.clip(lax.erf(v / 2**0.5), -_EDGE, _EDGE)
    return standard_quantile(level, _per_image(tail))


def _blended(noise, blend):
    """Each value and the mean of its four neighbours of one colour, at unchanged variance."""
    padded = jnp.pad(noise, ((0, 0), (1, 1), (1, 1), (0, 0)), mode="edge")
    across = padded[:, :-2, 1:-1] + padded[:, 2:, 1:-1] + padded[:, 1:-1, :-2] + padded[:, 1:-1, 2:]
    weight = _per_image(blend)
    return ((1 - weight) * noise + weight * across / 4) / jnp.sqrt(
        jnp.square(1 - weight) + jnp.square(weight) / 4
    )


def _slow(key, batch, height):
    """Offsets of sensor rows, [b, h, 2], unit variance, that wander about as 1/f."""
    start, *pushes = jnp.split(jax.random.normal(key, (2 * height + 1, len(_MEMORIES), batch)), [1])
    memory = jnp.array(_MEMORIES)[:, None]

    def step(before, push):
        """x_t = memory x_(t-1) + sqrt(1 - memory^2) e_t."""
        now = memory * before + jnp.sqrt(1 - jnp.square(memory)) * push
        return now, jnp.sum(now, 0)

    _, total = lax.scan(step, start[0], pushes[0])  # stationary from the start
    return total.T.reshape(batch, height, 2) / len(_MEMORIES) ** 0.5
