"""Log-probability of stored codes: the mass of the noise distribution over the recording's own code step.

A camera stores integers. The probability of a code is the mass between its edges, code +- step / 2, and a
code at a rail holds all the mass beyond it. A density in place of that mass is wrong by log(step), and
rewards models that put spikes on the codes. All functions run in float32 and have finite gradients in the
far tails and for noise much smaller than the step: the mass is always written as the normal density at the
nearer edge times a ratio of order one, and both the logarithm and its derivatives use that ratio.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Real = Float[Array, "..."]
Values = Real | Float[np.ndarray, "..."] | float
"""Arrays or numbers that broadcast to the pixels."""

_LOG_SQRT_2PI = 0.9189385332046727
"""log sqrt(2 pi), of the normal density."""
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)
"""Gauss-Legendre rule over a narrow bin."""


class CodeGrid(NamedTuple):
    """The codes a converter can give: their spacing and the two rails, DN; broadcast to the pixels.

    step: spacing of the codes; 0: not on a lattice, log-probabilities are then log-densities per DN.
    low, high: codes at or beyond are censored: black clip (often 0) and the white level. A white level that
      is no code itself (65535 with steps of 16) stands for the highest code below it, see `highest_code`.
    """

    step: Values = 1.0
    low: Values = -np.inf
    high: Values = np.inf


UNIT_STEP = CodeGrid()
"""Whole DN, no rails."""


def _mills(x: Real) -> Real:
    """(1 - cdf(x)) / pdf(x) of the standard normal for x >= 0; the continued fraction takes over at 4."""
    near = jnp.minimum(x, 4.0)
    small = np.sqrt(np.pi / 2) * jnp.exp(near * near / 2) * jax.lax.erfc(near / np.sqrt(2))
    far = jnp.maximum(x, 4.0)
    fraction = far
    for k in range(12, 0, -1):
        fraction = far + k / fraction
    return jnp.where(x < 4.0, small, 1 / fraction)


def _log_pdf(x: Real) -> Real:
    return -x * x / 2 - _LOG_SQRT_2PI


def _interval(centre: Real, half: Real) -> tuple[Real, Real]:
    """Log of the normal mass in centre +- half, and the density at the edge nearer to zero over that mass."""
    a = jnp.abs(centre)
    edge = a - half
    inside = (edge < 0) & (half > 1)
    # Narrow bins: Gauss-Legendre of the density relative to the edge; exact to float32 for half * a <= 2.
    narrow_bin = (half <= 1) & (half * a <= 2)
    h = jnp.where(narrow_bin, half, 1.0)
    e = jnp.where(narrow_bin, edge, 0.0)
    total = sum(
        float(w) / 2 * jnp.exp(-s * (e + s / 2))
        for w, s in ((w, h * (1 + float(t))) for t, w in zip(_NODES, _WEIGHTS, strict=True))
    )
    narrow = 2 * h * total
    outside = jnp.maximum(edge, 0.0)
    wide_half = jnp.where(narrow_bin, 1.0, half)
    wide_a = jnp.where(narrow_bin, 3.0, a)
    wide = _mills(outside) - jnp.exp(-2 * wide_half * wide_a) * _mills(outside + 2 * wide_half)
    relative = jnp.where(narrow_bin, narrow, wide)  # mass / density at the edge
    relative = jnp.where(inside, 1.0, jnp.maximum(relative, 1e-37))
    beyond = (jax.lax.erfc(-edge / np.sqrt(2)) + jax.lax.erfc((a + half) / np.sqrt(2))) / 2
    log_inside = jnp.log1p(-jnp.where(inside, beyond, 0.0))
    log_mass = jnp.where(inside, log_inside, _log_pdf(edge) + jnp.log(relative))
    ratio = jnp.where(inside, jnp.exp(_log_pdf(edge) - log_inside), 1 / relative)
    return log_mass, ratio


@jax.custom_jvp
def _edge_ratio(centre: Real, half: Real) -> Real:
    return _interval(centre, half)[1]


@_edge_ratio.defjvp
def _edge_ratio_jvp(primals, tangents):
    centre, half = primals
    ratio = _edge_ratio(centre, half)
    sign = jnp.where(centre >= 0, 1.0, -1.0)
    edge_dot = sign * tangents[0] - tangents[1]
    return ratio, -ratio * (
        (jnp.abs(centre) - half) * edge_dot + _log_interval_dot(centre, half, ratio, tangents)
    )


def _log_interval_dot(centre, half, ratio, tangents):
    sign = jnp.where(centre >= 0, 1.0, -1.0)
    falloff = -2 * sign * centre * half
    return ratio * (sign * jnp.expm1(falloff) * tangents[0] + (1 + jnp.exp(falloff)) * tangents[1])


@jax.custom_jvp
def log_normal_interval(centre: Real, half: Real) -> Real:
    """Log of the standard normal mass in [centre - half, centre + half], half > 0; any order of derivative.

    float32: to 2e-6 relative or 2e-6 nats, whichever is larger, for |centre| and half from 1e-6 to 1e6.
    """
    return _interval(centre, half)[0]


@log_normal_interval.defjvp
def _log_normal_interval_jvp(primals, tangents):
    centre, half = primals
    return log_normal_interval(centre, half), _log_interval_dot(
        centre, half, _edge_ratio(centre, half), tangents
    )


def _lower_ratio(x: Real) -> tuple[Real, Real]:
    """Log of the normal cdf at x, and density over cdf."""
    mills = _mills(jnp.maximum(-x, 0.0))
    above = jnp.log1p(-jax.lax.erfc(jnp.maximum(x, 0.0) / np.sqrt(2)) / 2)
    log_cdf = jnp.where(x > 0, above, _log_pdf(x) + jnp.log(mills))
    return log_cdf, jnp.where(x > 0, jnp.exp(_log_pdf(x) - above), 1 / mills)


@jax.custom_jvp
def _hazard(x: Real) -> Real:
    return _lower_ratio(x)[1]


@_hazard.defjvp
def _hazard_jvp(primals, tangents):
    (x,) = primals
    ratio = _hazard(x)
    return ratio, -ratio * (x + ratio) * tangents[0]


@jax.custom_jvp
def log_normal_cdf(x: Real) -> Real:
    """Log of the standard normal cumulative distribution, its derivative finite for any finite x."""
    return _lower_ratio(x)[0]


@log_normal_cdf.defjvp
def _log_normal_cdf_jvp(primals, tangents):
    (x,) = primals
    return log_normal_cdf(x), _hazard(x) * tangents[0]


def highest_code(codes: Values, grid: CodeGrid) -> Real:
    """The highest code at or below `grid.high` on the lattice of `codes`, wherever its origin lies; without a
    lattice or a rail `grid.high` itself."""
    step, high = jnp.asarray(grid.step, jnp.float32), jnp.asarray(grid.high, jnp.float32)
    bound = (step > 0) & jnp.isfinite(high)
    spacing, rail = jnp.where(step > 0, step, 1.0), jnp.where(bound, high, 0.0)
    # The thousandth keeps a rail on the lattice there when black has been taken out in float32.
    steps = jnp.floor((rail - codes) / spacing + 1e-3)
    return jnp.where(bound, jnp.minimum(codes + steps * spacing, high), high)


def censored(codes: Values, inner: Real, below: Real, above: Real, grid: CodeGrid) -> Real:
    """`inner` between the rails; at or beyond a rail the log-mass of everything past it."""
    return jnp.where(codes <= grid.low, below, jnp.where(codes >= grid.high, above, inner))


def rail_edge(rail: Values, offset: Real) -> Real:
    """The edge of a rail's bin, kept finite where there is no rail (the value is then not used)."""
    return jnp.where(jnp.isfinite(rail), rail, 0.0) + offset


@jax.jit
def gaussian_log_prob(codes: Values, mean: Values, variance: Values, grid: CodeGrid = UNIT_STEP) -> Real:
    """Log-probability of each code for normal noise, nats per pixel.

    codes, mean: DN. variance: DN^2, without the quantisation variance: the step is integrated exactly. All
    broadcast, so maps of means and of pixel read noise need nothing else.
    """
    codes = jnp.asarray(codes, jnp.float32)
    grid = grid._replace(high=highest_code(codes, grid))
    step = jnp.asarray(grid.step, jnp.float32)
    half = step / 2
    sigma = jnp.sqrt(jnp.maximum(variance, 1e-12 * jnp.where(step > 0, step * step, 1.0)))
    z = (codes - mean) / sigma
    lattice = log_normal_interval(z, jnp.where(step > 0, half, 1.0) / sigma)
    inner = jnp.where(step > 0, lattice, _log_pdf(z) - jnp.log(sigma))
    below = log_normal_cdf((rail_edge(grid.low, half) - mean) / sigma)
    above = log_normal_cdf((mean - rail_edge(grid.high, -half)) / sigma)
    return censored(codes, inner, below, above, grid)
