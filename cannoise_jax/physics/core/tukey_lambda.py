"""The Tukey-lambda distribution: Q(p) = (p^l - (1 - p)^l) / l, the field's usual law for heavy-tailed read
noise.

l = 0.135 is close to a Gaussian, 0 is the logistic, l <= -0.25 has infinite kurtosis, l <= -0.5 infinite
variance. Moments: J. W. Tukey's family as given by Joiner and Rosenblatt, J. Am. Stat. Assoc. 66, 394 (1971).
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln
from jaxtyping import Array, Float
from scipy.special import beta

GAUSSIAN = 0.135
"""The shape nearest to a Gaussian: its excess kurtosis is zero."""
_NEAR_ZERO = 0.15
"""Below this |l| the variance is a polynomial through float64 values, for the closed form divides by l^2."""


def quantile(v: Float[Array, "..."], shape) -> Float[Array, "..."]:
    """Quantile at cumulative probability (1 + v) / 2, v in (-1, 1), not scaled: the variance is
    `variance`."""
    shape = jnp.asarray(shape, jnp.float32)
    # log p and log(1 - p), accurate in both tails; expm1 keeps digits for small shapes.
    high, low = jnp.log1p(v) - np.float32(np.log(2)), jnp.log1p(-v) - np.float32(np.log(2))
    safe = jnp.where(jnp.abs(shape) < 1e-6, 1.0, shape)
    curved = (jnp.expm1(safe * high) - jnp.expm1(safe * low)) / safe
    return jnp.where(jnp.abs(shape) < 1e-6, high - low, curved)


def variance(shape) -> Float[Array, "..."]:
    """Variance of the unscaled distribution; infinite for shape <= -0.5."""
    shape = jnp.asarray(shape, jnp.float32)
    near = jnp.abs(shape) < _NEAR_ZERO
    away = jnp.where(near | (shape <= -0.5), 0.5, shape)
    product = jnp.exp(2 * gammaln(away + 1) - gammaln(2 * away + 2))
    closed = 2 / away**2 * (1 / (1 + 2 * away) - product)
    polynomial = jnp.polyval(jnp.asarray(_VARIANCE, jnp.float32), shape)
    return jnp.where(shape <= -0.5, jnp.inf, jnp.where(near, polynomial, closed))


def standard_quantile(v: Float[Array, "..."], shape) -> Float[Array, "..."]:
    """Quantile of the distribution scaled to unit variance; shape > -0.5."""
    return quantile(v, shape) / jnp.sqrt(variance(shape))


def excess_kurtosis(shape) -> Float[Array, "..."]:
    """Excess kurtosis; infinite for shape <= -0.25."""
    shape = jnp.asarray(shape, jnp.result_type(float))
    shapes, values = (jnp.asarray(table, shape.dtype) for table in (_SHAPES, _KURTOSES))
    return jnp.interp(shape, shapes, values, left=jnp.inf)


def _moments64(shape: float) -> tuple[float, float]:
    """Variance and fourth central moment in float64; |shape| not below 1e-3, where the form is 0/0."""
    l = shape  # noqa: E741
    second = 2 / l**2 * (1 / (1 + 2 * l) - beta(l + 1, l + 1))
    if l <= -0.25:
        return second, np.inf
    fourth = 2 / l**4 * (1 / (1 + 4 * l) - 4 * beta(3 * l + 1, l + 1) + 3 * beta(2 * l + 1, 2 * l + 1))
    return second, fourth


def _kurtosis64(shape: float) -> float:
    if abs(shape) < 5e-3:  # straight line between the values at +-5e-3
        share = (shape + 5e-3) / 1e-2
        return (1 - share) * _kurtosis64(-5e-3) + share * _kurtosis64(5e-3)
    second, fourth = _moments64(shape)
    return fourth / second**2 - 3


_NODES = 1.2 * _NEAR_ZERO * np.cos(np.pi * (np.arange(14) + 0.5) / 14)
_VARIANCE = np.polyfit(_NODES, [_moments64(float(s))[0] for s in _NODES], 13)
"""The polynomial near zero, through the Chebyshev nodes of a range a fifth wider than it is used in."""
_SHAPES = np.concatenate([-0.25 + np.geomspace(1e-4, 0.25, 400), np.linspace(0.002, 1.0, 400)])
_KURTOSES = np.array([_kurtosis64(float(s)) for s in _SHAPES])
"""A table of the kurtosis, finer towards the shape at which it is infinite."""
