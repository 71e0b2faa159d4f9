"""The one Poisson-Gaussian sampler, and the noise level function that goes with it.

Units: electrons for charge, DN for codes. `var = K^2 (mu + s^2)` with the system gain K in DN/e- and the read
noise s in e- (EMVA 1288 release 4.0, linear camera model); in normalised units `var = shot * clean + read`.

Poisson counts are drawn from one uniform number per pixel by inverting the distribution: below `_SWITCH`
electrons by summing its terms, above it by the expansion of the quantile in powers of mu^(-1/2) (M. B. Giles,
ACM Trans. Math. Softw. 42(1), 2016, algorithm 955, the normal expansion). Both are plain arithmetic on every
pixel, which XLA fuses into one loop, so the cost is that of the random bits.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from cannoise_jax.physics.core.random_bits import random_bits

InitialNoise = Callable[..., tuple[Any, Any]]
"""What a learned generator starts from: (key, clean, shot, read) -> (noise, sigma)."""

_SWITCH = 12.0
"""Mean count above which the expansion is used: there it misses the exact quantile in < 5e-4 of the draws."""
_TERMS = 44
"""Terms summed below the switch: the chance of more counts than this at the switch is below 1e-11."""


def centred_uniform(key: Key[Array, ""], shape: tuple[int, ...]) -> Float[Array, "..."]:
    """Uniform numbers strictly between -1 and 1, float32, 2^-23 apart and symmetric about 0."""
    bits = random_bits(key, shape) >> 8
    return (bits.astype(jnp.float32) - np.float32(2**23 - 0.5)) * np.float32(2.0**-23)


def _normal(v: Float[Array, "..."]) -> Float[Array, "..."]:
    return np.float32(math.sqrt(2.0)) * jax.lax.erf_inv(v)


def poisson_quantile(v: Float[Array, "..."], mean: Float[Array, "..."]) -> Float[Array, "..."]:
    """Poisson count at cumulative probability (1 + v) / 2 for `v` in (-1, 1); `mean` >= 0 in counts.

    float32 whole numbers. Exact (to float32) below 12 counts; above it one count off in less than 5e-4 of the
    draws, and from 1e4 counts on in as many draws as float32 rounding moves over a whole number (4e-3 at
    1e5).
    """
    # A frame without dark pixels needs no sums.
    bright = jnp.all(mean >= _SWITCH)
    return jax.lax.cond(bright, _expanded, _either, *jnp.broadcast_arrays(v, mean))


def _either(v: Float[Array, "..."], mean: Float[Array, "..."]) -> Float[Array, "..."]:
    return jnp.where(mean < _SWITCH, _summed(v, mean), _expanded(v, mean))


def _summed(v: Float[Array, "..."], mean: Float[Array, "..."]) -> Float[Array, "..."]:
    """The count at which the summed probabilities pass (1 + v) / 2; mean below the switch."""
    # Near 1 the float32 sum stalls short of u: there the chance of more counts, (1 - v) / 2, decides.
    u, rest = 0.5 + 0.5 * v, 0.5 - 0.5 * v
    small = jnp.minimum(mean, _SWITCH)
    term = jnp.exp(-small)
    total, count = term, jnp.zeros_like(u * small)
    for k in range(1, _TERMS):
        below = u > total
        term = term * (small / k)
        # The chance of k or more counts is at most term / (1 - small / (k + 1)).
        count = count + (below & (term * (k + 1) > rest * (k + 1 - small)))
        total = total + term
    return count


def _expanded(v: Float[Array, "..."], mean: Float[Array, "..."]) -> Float[Array, "..."]:
    """The quantile by its expansion in powers of mean^(-1/2); mean above the switch."""
    large = jnp.maximum(mean, _SWITCH)
    w = _normal(v)
    root = jnp.sqrt(large)
    square = w * w
    expansion = (
        large
        + root * w
        + (1 / 3 + square / 6)
        - w * (1 / 36 + square / 72) / root
        + (-8 / 405 + square * (7 / 810 + square / 270)) / large
    )
    return jnp.floor(expansion)


def sample_poisson(key: Key[Array, ""], mean: Float[Array, "..."]) -> Float[Array, "..."]:
    """Poisson counts of the given mean, float32 whole numbers; negative means count as zero."""
    mean = jnp.maximum(jnp.asarray(mean, jnp.float32), 0.0)
    return poisson_quantile(centred_uniform(key, mean.shape), mean)


def sample_normal(key: Key[Array, ""], shape: tuple[int, ...]) -> Float[Array, "..."]:
    """Standard normal numbers, float32."""
    return _normal(centred_uniform(key, shape))


def electrons_from_nlf(shot: Float[Array, "..."], read: Float[Array, "..."], span_dn: float | Array = 1.0):
    """System gain (DN/e-) and read noise (e-) of a noise level function `var = shot * clean + read` in
    normalised units, where `span_dn` is white minus black level."""
    shot = jnp.asarray(shot)
    return shot * span_dn, jnp.sqrt(jnp.maximum(jnp.asarray(read), 0.0)) / shot


def nlf_from_electrons(gain_dn_per_e, read_noise_e, span_dn: float | Array = 1.0):
    """Noise level function (shot, read) in normalised units: the inverse of `electrons_from_nlf`."""
    shot = jnp.asarray(gain_dn_per_e) / span_dn
    return shot, (shot * jnp.asarray(read_noise_e)) ** 2


def nlf_sigma(
    clean: Float[Array, "..."], shot: Float[Array, "..."], read: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Standard deviation of the noise level function, normalised units; negative signal counts as zero."""
    return jnp.sqrt(shot * jnp.maximum(clean, 0.0) + read)
