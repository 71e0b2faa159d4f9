"""Likelihood of codes under true Poisson shot noise: an exact sum over photo-electrons, or a skew correction.

The normal approximation of shot noise costs about skewness^2 / 12 nats per pixel: 8e-4 at 100 electrons
without read noise, which a frame of 256 x 256 pixels sees clearly. `shot_error` measures the cost of each
form, `choose_shot` picks the cheapest one that is good enough.
"""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.likelihood.codes import (
    UNIT_STEP,
    CodeGrid,
    Real,
    Values,
    censored,
    gaussian_log_prob,
    highest_code,
    log_normal_cdf,
    log_normal_interval,
    rail_edge,
)

Shot = Literal["gaussian", "skewed", "poisson"]

_TERMS = 64
EXACT_BELOW_E = 25.0
"""Up to this many electrons 64 terms of the sum hold all of the mass (6 standard deviations to each side)."""


@jax.jit
def poisson_log_prob(
    codes: Values,
    electrons: Values,
    gain: Values,
    black: Values,
    read_sigma: Values,
    grid: CodeGrid = UNIT_STEP,
) -> Real:
    """Exact log-probability of codes = round(black + gain * Poisson(electrons) + N(0, read_sigma^2)).

    gain: DN/e-. black, read_sigma: DN. The sum runs over 64 electron counts around the one that explains the
    code best, so it holds in both tails; meant for means below about `EXACT_BELOW_E`.
    """
    codes = jnp.asarray(codes, jnp.float32)
    mean_e = jnp.maximum(electrons, 1e-6)
    spread = read_sigma**2 + jnp.asarray(grid.step, jnp.float32) ** 2 / 12
    pull = gain * gain / spread
    target = (codes - black) / gain
    count = jnp.maximum((1 + pull * target) / (1 / jnp.maximum(mean_e, 1) + pull), 0.0)
    for _ in range(5):
        slope = jnp.log(mean_e) - jnp.log(count + 0.5) + pull * (target - count)
        count = jnp.maximum(count + slope / (1 / (count + 0.5) + pull), 0.0)
    first = jax.lax.stop_gradient(jnp.maximum(jnp.round(count) - _TERMS // 2, 0.0))

    def add(total, offset):
        n = first + offset
        prior = n * jnp.log(mean_e) - mean_e - jax.lax.lgamma(n + 1)
        return jnp.logaddexp(
            total, prior + gaussian_log_prob(codes, black + gain * n, read_sigma**2, grid)
        ), None

    shape = jnp.broadcast_shapes(*(jnp.shape(x) for x in (codes, mean_e, gain, black, read_sigma)))
    offsets = jnp.arange(_TERMS, dtype=jnp.float32)
    return jax.lax.scan(jax.checkpoint(add), jnp.full(shape, -1e30, jnp.float32), offsets)[0]


@jax.jit
def skewed_log_prob(
    codes: Values,
    electrons: Values,
    gain: Values,
    black: Values,
    read_sigma: Values,
    grid: CodeGrid = UNIT_STEP,
) -> Real:
    """Log-probability of codes with the mean, variance and skewness of Poisson plus read noise.

    The code edges are carried to normal scores by the cube-root transformation of Wilson and Hilferty (PNAS
    17, 684, 1931) for a shifted gamma distribution, and differenced there. More than 9 standard deviations
    below
    the mean, where that distribution ends, the normal distribution stands in.
    """
    codes = jnp.asarray(codes, jnp.float32)
    mean = black + gain * electrons
    variance = gain * gain * jnp.maximum(electrons, 1e-6) + read_sigma**2
    sigma = jnp.sqrt(variance)
    skewness = gain**3 * jnp.maximum(electrons, 1e-6) / (variance * sigma)
    grid = grid._replace(high=highest_code(codes, grid))
    half = jnp.asarray(grid.step, jnp.float32) / 2

    def score(x):  # w -> 6 / g * ((1 + g w / 2)^(1/3) - 1) + g / 6, without cancellation at small g
        w = (x - mean) / sigma
        base = 1 + skewness * w / 2
        root = jnp.cbrt(jnp.maximum(base, 0.05))
        return base > 0.05, root, 3 * w / (root * root + root + 1) + skewness / 6

    low_ok, low_root, low_score = score(codes - half)
    _, high_root, high_score = score(codes + half)
    width = 3 * (2 * half / sigma) / (high_root**2 + high_root * low_root + low_root**2)
    width = jnp.where(low_ok, width, 1.0)
    middle = jnp.where(low_ok, (low_score + high_score) / 2, 0.0)
    inner = jnp.where(
        low_ok, log_normal_interval(middle, width / 2), gaussian_log_prob(codes, mean, variance, grid)
    )
    low_rail_ok, _, below = score(rail_edge(grid.low, half))
    _, _, above = score(rail_edge(grid.high, -half))
    below = jnp.where(low_rail_ok, below, (rail_edge(grid.low, half) - mean) / sigma)
    return censored(codes, inner, log_normal_cdf(below), log_normal_cdf(-above), grid)


def shot_log_prob(
    codes: Values,
    electrons: Values,
    gain: Values,
    black: Values,
    read_sigma: Values,
    grid: CodeGrid = UNIT_STEP,
    shot: Shot = "skewed",
) -> Real:
    """Log-probability of codes for `electrons` mean photo-electrons, nats per pixel; see `choose_shot`.

    electrons: mean counts, may be negative where the expected signal is (only "gaussian" uses the sign).
    gain: DN/e-. black, read_sigma: DN, scalars or maps. grid.step 0 is supported by "gaussian" only.
    """
    if shot == "poisson":
        return poisson_log_prob(codes, electrons, gain, black, read_sigma, grid)
    if shot == "skewed":
        return skewed_log_prob(codes, electrons, gain, black, read_sigma, grid)
    variance = gain * gain * jnp.maximum(electrons, 0.0) + read_sigma**2
    return gaussian_log_prob(codes, black + gain * electrons, variance, grid)


def choose_shot(
    electrons: Float[np.ndarray, "..."],
    gain: float,
    read_sigma: float | Float[np.ndarray, "..."],
    tolerance: float = 1e-5,
) -> np.ndarray:
    """The form to use at each mean, 0 gaussian, 1 skewed, 2 poisson: its error stays below `tolerance`.

    Leading terms of the error, nats per pixel: normal skewness^2 / 12, skewed (excess kurtosis error)^2 / 48
    with half the Poisson kurtosis missing; `shot_error` measures the same by summing over all codes.
    """
    mu = np.maximum(np.asarray(electrons, np.float64), 1e-6)
    share = mu / (mu + (np.asarray(read_sigma, np.float64) / gain) ** 2)
    normal = share**3 / mu / 12
    skewed = (share**2 * (1.5 * share - 1) / mu) ** 2 / 48 + (share**2.5 / mu**1.5) ** 2 / 10
    return np.where(normal < tolerance, 0, np.where((skewed < tolerance) & (mu > EXACT_BELOW_E), 1, 2))


def shot_error(electrons: float, gain: float, read_sigma: float, grid: CodeGrid, shot: Shot) -> float:
    """Mean log-likelihood lost per pixel, nats: the divergence of the form `shot` from the exact sum.

    The sum runs over the whole codes between mean - 12 and mean + 16 standard deviations and the rails, with
    as many Poisson terms as the mean needs, in float64 weights.
    """
    sigma = float(np.hypot(gain * np.sqrt(electrons), read_sigma)) + float(grid.step)
    mean = gain * electrons
    step = float(grid.step)
    grid = grid._replace(high=np.floor(grid.high / step) * step)
    low = np.maximum(np.floor((mean - 12 * sigma) / step) * step, grid.low)
    high = np.minimum(np.ceil((mean + 16 * sigma) / step) * step, grid.high)
    codes = np.arange(low, high + step / 2, step)
    exact = _reference_probability(codes, electrons, gain, read_sigma, grid)
    log_form = np.asarray(shot_log_prob(codes, electrons, gain, 0.0, read_sigma, grid, shot), np.float64)
    kept = exact > 1e-25
    return float(np.sum(exact[kept] * (np.log(exact[kept]) - log_form[kept])))


def _reference_probability(codes, electrons, gain, read_sigma, grid):
    """Exact probabilities of `codes` (black level 0) by a float64 sum over all counts that matter."""
    from scipy import stats

    counts = np.arange(
        max(0, int(electrons - 12 * np.sqrt(electrons) - 20)),
        int(electrons + 16 * np.sqrt(electrons) + 40),
    )
    weight = stats.poisson.pmf(counts, electrons)
    upper = np.where(codes >= grid.high, np.inf, codes + grid.step / 2)[:, None]
    lower = np.where(codes <= grid.low, -np.inf, codes - grid.step / 2)[:, None]
    a, b = (lower - gain * counts) / read_sigma, (upper - gain * counts) / read_sigma
    flip = a > 0  # the far side of the mean keeps its digits in the upper tail
    mass = np.where(flip, stats.norm.cdf(-a) - stats.norm.cdf(-b), stats.norm.cdf(b) - stats.norm.cdf(a))
    return mass @ weight
