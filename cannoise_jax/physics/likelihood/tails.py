"""Likelihood of codes with heavy-tailed read noise: Student-t and other scale mixtures, and Tukey-lambda.

Shot noise is normal here and is convolved with the read noise, not added in quadrature: a scale mixture of
normals stays one when a normal is added; for Tukey-lambda, which has no closed cumulative distribution, the
quantile function is inverted for the broader of the two laws and the narrower one is integrated by
quadrature.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from cannoise_jax.physics.core import tukey_lambda
from cannoise_jax.physics.likelihood.codes import (
    UNIT_STEP,
    CodeGrid,
    Real,
    Values,
    censored,
    gaussian_log_prob,
    highest_code,
    rail_edge,
)

_MIXTURE = 48
_GH_POINTS, _GH_WEIGHTS = np.polynomial.hermite_e.hermegauss(16)
_GH_LOG = np.log(_GH_WEIGHTS / np.sqrt(2 * np.pi))
_LOGIT_STEP = 0.5
_LOGITS = _LOGIT_STEP * np.arange(-50, 51)
_NEWTON = 14
_SLOPE = 1e-5
"""Added to the quantile per unit of logit: where it ends (shape > 0) the log-probability falls on,
steeply."""


def mixture_log_prob(
    codes: Values,
    mean: Values,
    shot_variance: Values,
    read_variance: Values,
    log_weights: Real,
    ratios: Real,
    grid: CodeGrid = UNIT_STEP,
) -> Real:
    """Log-probability for read noise that is normal with variance read_variance * ratios[k], weight k.

    DN and DN^2; log_weights and ratios `[K]`, weights summing to one.
    """

    def add(total, part):
        log_weight, ratio = part
        variance = shot_variance + read_variance * ratio
        return jnp.logaddexp(total, log_weight + gaussian_log_prob(codes, mean, variance, grid)), None

    shape = jnp.broadcast_shapes(*(jnp.shape(x) for x in (codes, mean, shot_variance, read_variance)))
    start = jnp.full(shape, -1e30, jnp.float32)
    return jax.lax.scan(jax.checkpoint(add), start, (log_weights, ratios))[0]


def student_mixture(dof: Values) -> tuple[Real, Real]:
    """Log-weights and variance ratios of the Student-t law of `dof` > 2 degrees and unit variance, `[48]`
    each.

    Student's t is a normal whose variance is divided by chi2(dof) / dof; the trapezoid rule in the logarithm
    of that quotient is good to 2e-5 nats for codes down to a probability of e^-30.
    """
    dof = jnp.asarray(dof, jnp.float32)
    low, high = -60.0 / dof - 3 * jnp.sqrt(2 / dof), 7 * jnp.sqrt(2 / dof) / (1 + jnp.sqrt(1 / dof))
    u = low + (high - low) * (jnp.arange(_MIXTURE) + 0.5) / _MIXTURE
    return jax.nn.log_softmax(dof / 2 * (u - jnp.expm1(u))), jnp.exp(-u) * (dof - 2) / dof


@jax.jit
def student_log_prob(
    codes: Values,
    mean: Values,
    shot_variance: Values,
    read_sigma: Values,
    dof: Values,
    grid: CodeGrid = UNIT_STEP,
) -> Real:
    """Log-probability for Student-t read noise of standard deviation read_sigma (DN), dof > 2, plus shot
    noise."""
    log_weights, ratios = student_mixture(dof)
    return mixture_log_prob(codes, mean, shot_variance, jnp.square(read_sigma), log_weights, ratios, grid)


def _quantile(logit: Real, shape: Real) -> tuple[Real, Real]:
    """Unscaled quantile at a logit of probability, and its derivative; both are kept growing by `_SLOPE`."""
    high, low = -jax.nn.softplus(-logit), -jax.nn.softplus(logit)  # log p, log(1 - p)
    safe = jnp.where(jnp.abs(shape) < 1e-5, 1e-5, shape)
    value = (jnp.expm1(safe * high) - jnp.expm1(safe * low)) / safe + _SLOPE * logit
    return value, jnp.exp(safe * high + low) + jnp.exp(safe * low + high) + _SLOPE


def tukey_logit(x: Values, shape: Values) -> Real:
    """Logit of the cumulative Tukey-lambda distribution (not scaled) at x, by Newton's method on its
    quantile.

    log cdf = -softplus(-logit). Differentiable in x and shape.
    """
    x, shape = jnp.asarray(x, jnp.float32), jnp.asarray(shape, jnp.float32)
    safe = jnp.where(jnp.abs(shape) < 1e-5, 1e-5, shape)
    size = jnp.abs(jax.lax.stop_gradient(x))
    fixed = jax.lax.stop_gradient(safe)
    logit = -jnp.log(jnp.maximum(1 - fixed * size, 1e-5)) / fixed

    def newton(logit, _):
        value, slope = _quantile(logit, fixed)
        return jnp.maximum(logit - (value - size) / slope, 0.0), None

    logit = jax.lax.scan(newton, logit, None, length=_NEWTON)[0]
    logit = jnp.where(x < 0, -logit, logit)
    value, slope = _quantile(logit, shape)
    return logit + (x - value) / jax.lax.stop_gradient(slope)  # zero, with the implicit derivatives


def _tukey_codes(codes: Values, mean: Values, scale: Values, shape: Values, grid: CodeGrid) -> Real:
    """Log-probability of codes for Tukey-lambda noise alone; mass between logits a < b: s(b) s(-a) (1 -
    e^(a-b))."""
    grid = grid._replace(high=highest_code(codes, grid))
    half = jnp.asarray(grid.step, jnp.float32) / 2
    edges = (codes - half, codes + half, rail_edge(grid.low, half), rail_edge(grid.high, -half))
    offsets = jnp.stack(jnp.broadcast_arrays(*((edge - mean) / scale for edge in edges)))
    low, high, black, white = tukey_logit(offsets, shape)
    gap = jnp.maximum(high - low, 1e-6)
    inner = jax.nn.log_sigmoid(high) + jax.nn.log_sigmoid(-low) + jnp.log(-jnp.expm1(-gap))
    below, above = jax.nn.log_sigmoid(black), jax.nn.log_sigmoid(-white)
    return censored(codes, inner, below, above, grid)


@jax.jit
def tukey_log_prob(
    codes: Values,
    mean: Values,
    shot_variance: Values,
    read_sigma: Values,
    shape: Values,
    grid: CodeGrid = UNIT_STEP,
) -> Real:
    """Log-probability for Tukey-lambda read noise of standard deviation read_sigma (DN) plus normal shot
    noise.

    shape > -0.5 (0.135: near normal; smaller: heavier tails). grid.step must not be 0. Where shot noise is
    more
    than half of the read noise the latter is integrated over 101 quantiles; elsewhere, and 6 deviations out
    for
    tails that never end, shot noise over 16 Gauss-Hermite nodes.
    """
    codes = jnp.asarray(codes, jnp.float32)
    scale = read_sigma / jnp.sqrt(tukey_lambda.variance(shape))
    shot_sigma = jnp.sqrt(jnp.maximum(shot_variance, 1e-12))
    shape32 = jnp.asarray(shape, jnp.float32)
    dims = jnp.broadcast_shapes(*(jnp.shape(x) for x in (codes, mean, shot_variance, read_sigma)))
    start = jnp.full(dims, -1e30, jnp.float32)

    def over_shot(total, node):
        point, log_weight = node
        part = _tukey_codes(codes, mean + shot_sigma * point, scale, shape, grid)
        return jnp.logaddexp(total, log_weight + part), None

    def over_read(total, logit):
        offset, _ = _quantile(logit, shape32)
        log_weight = jax.nn.log_sigmoid(logit) + jax.nn.log_sigmoid(-logit) + np.log(_LOGIT_STEP)
        part = gaussian_log_prob(codes, mean + scale * offset, shot_variance, grid)
        return jnp.logaddexp(total, log_weight + part), None

    nodes = (jnp.asarray(_GH_POINTS, jnp.float32), jnp.asarray(_GH_LOG, jnp.float32))
    narrow_shot = jax.lax.scan(jax.checkpoint(over_shot), start, nodes)[0]
    logits = jnp.asarray(_LOGITS, jnp.float32)
    broad_shot = jax.lax.scan(jax.checkpoint(over_read), start, logits)[0]
    far = jnp.abs(codes - mean) > 6 * jnp.hypot(shot_sigma, read_sigma)
    return jnp.where((shot_sigma > 0.5 * read_sigma) & ~(far & (shape32 < 0.05)), broad_shot, narrow_shot)
