"""How good the likelihood is: quadrature errors against brute force in float64, and interval coverage."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp
from scipy.stats import norm

from cannoise_jax.physics.likelihood.codes import CodeGrid, gaussian_log_prob
from cannoise_jax.physics.likelihood.crossed import crossed_gaussian, crossed_laplace, white_terms
from cannoise_jax.physics.likelihood.maximum import maximise
from cannoise_jax.physics.likelihood.shared import shared_log_prob
from cannoise_jax.physics.likelihood.shot import skewed_log_prob

_COLUMNS = 3  # brute force integrates over so many column offsets at once


def interval_mass(centre: np.ndarray, half: float) -> np.ndarray:
    """Standard normal mass in centre +- half in float64, in the tail that keeps its digits."""
    a = np.abs(centre)
    return norm.sf(a - half) - norm.sf(a + half)


def brute_force_rows(codes, mean, sigma: float, row_sigma: float) -> Float[np.ndarray, "groups"]:
    """Log-probability of each group of whole codes with a shared offset, by 4001 equidistant points."""
    unit = np.linspace(-9, 9, 4001)
    z = (codes - mean)[..., None] / sigma - row_sigma / sigma * unit
    inside = np.log(np.maximum(interval_mass(z, 0.5 / sigma), 1e-300)).sum(-2)
    return logsumexp(inside + norm.logpdf(unit), axis=-1) + np.log(unit[1] - unit[0])


def brute_force_crossed(codes, mean, sigma: float, row_sigma: float, column_sigma: float) -> float:
    """Log-probability of one frame of three columns with row and column offsets: every column offset of a
    grid of
    31^3 Gauss-Hermite points, and for each of them every row by 81 equidistant points."""
    points, weights = np.polynomial.hermite_e.hermegauss(31)
    grid = np.stack(np.meshgrid(*[points] * _COLUMNS, indexing="ij"), -1).reshape(-1, _COLUMNS)
    log_weight = np.log(weights / np.sqrt(2 * np.pi))
    prior = np.stack(np.meshgrid(*[log_weight] * _COLUMNS, indexing="ij"), -1).reshape(-1, _COLUMNS).sum(-1)
    unit = np.linspace(-6, 6, 81)
    total = prior
    for row, level in zip(codes, mean, strict=True):
        inside = np.zeros((len(points), _COLUMNS, unit.size))
        for c in range(_COLUMNS):
            offset = column_sigma * points[:, None] + row_sigma * unit
            mass = interval_mass((row[c] - level[c] - offset) / sigma, 0.5 / sigma)
            inside[:, c] = np.log(np.maximum(mass, 1e-300))
        index = np.searchsorted(points, grid)
        pixels = sum(inside[index[:, c], c] for c in range(_COLUMNS))
        total = total + logsumexp(pixels + norm.logpdf(unit), axis=-1) + np.log(unit[1] - unit[0])
    return float(logsumexp(total))


class SharedError(NamedTuple):
    """Errors in nats per pixel: of the nested quadrature, and on crossed frames of the two approximations."""

    sigma: float
    shared_sigma: float
    nested: float
    crossed_normal: float
    crossed_laplace: float


@jax.jit
def _nested(codes, mean, sigma, shared_sigma):
    """Row offsets by quadrature: log-probability of each row."""
    return shared_log_prob(
        lambda offset: gaussian_log_prob(codes, mean + offset, sigma**2), shared_sigma, codes.shape[0]
    )


@jax.jit
def _laplace(frames, mean, sigma, terms):
    """Crossed offsets by Laplace's approximation: log-probability of each frame."""
    return jax.vmap(
        lambda codes: crossed_laplace(
            lambda offset: gaussian_log_prob(codes, mean + offset, sigma**2), terms, codes.shape
        )
    )(frames)


def shared_errors(sigma: float, shared_sigma: float, seed: int = 0) -> SharedError:
    """Largest error over 6 rows of 48 pixels (nested) and over 4 frames of 12 x 3 pixels (crossed), for
    codes of
    step 1, pixel noise `sigma` and row and column offsets of `shared_sigma`, all DN."""
    rng = np.random.default_rng(seed)
    mean = np.float32(rng.uniform(0, 1, (6, 48)))
    codes = np.round(mean + shared_sigma * rng.normal(size=(6, 1)) + sigma * rng.normal(size=mean.shape))
    exact = brute_force_rows(
        codes, mean.astype(np.float64), float(np.float32(sigma)), float(np.float32(shared_sigma))
    )
    nested = _nested(codes.astype(np.float32), mean, sigma, shared_sigma)
    level = np.float32(rng.uniform(0, 1, (12, _COLUMNS)))
    terms = white_terms((12, _COLUMNS), shared_sigma, shared_sigma)
    shared = shared_sigma * (rng.normal(size=(4, 12, 1)) + rng.normal(size=(4, 1, _COLUMNS)))
    frames = np.round(level + shared + sigma * rng.normal(size=(4, 12, _COLUMNS))).astype(np.float32)
    truth = [brute_force_crossed(f, level, sigma, shared_sigma, shared_sigma) for f in frames]
    normal = crossed_gaussian(jnp.asarray(frames), jnp.asarray(level), sigma**2, terms)
    laplace = _laplace(frames, level, sigma, terms)

    def worst(found, known, pixels):
        return float(np.max(np.abs(np.asarray(found, np.float64) - known))) / pixels

    return SharedError(
        sigma,
        shared_sigma,
        worst(nested, exact, 48),
        worst(normal, truth, level.size),
        worst(laplace, truth, level.size),
    )


class Coverage(NamedTuple):
    """How often the 90 % interval of a parameter holds the truth, and the mean estimate in units of it."""

    parameter: str
    truth: float
    mean: float
    covered: float
    simulations: int


@jax.jit
def _joint(theta, codes, signal):
    """Mean log-likelihood per pixel of rows with shared noise; theta: black, and logs of gain, read, row
    sigma."""

    def mean_log_prob(theta):
        gain, read, row = jnp.exp(theta[1]), jnp.exp(theta[2]), jnp.exp(theta[3])

        def pixels(offset):
            return skewed_log_prob(
                codes, signal / gain, gain, theta[0] + offset, read, CodeGrid(1.0, 0.0, 4095.0)
            )

        return jnp.sum(shared_log_prob(pixels, row, codes.shape[0], nodes=9, newton_steps=4)) / codes.size

    return jax.value_and_grad(mean_log_prob)(theta)


def coverage(
    simulations: int,
    seed: int = 0,
    size: tuple[int, int] = (64, 48),
    truth: tuple[float, float, float, float] = (64.0, 1.5, 8.0, 3.0),
) -> tuple[Coverage, ...]:
    """Coverage of the 90 % intervals of black level (DN), gain (DN/e-), read noise and row noise (DN).

    Each simulation draws frames of `size` with Poisson shot noise at 30 to 120 e- by NumPy and maximises the
    joint likelihood with the row offsets integrated out.
    """
    names = ("black_level", "gain", "read_noise", "row_noise")
    black, gain, read, row = truth
    rng = np.random.default_rng(seed)
    electrons = np.linspace(30, 120, size[1]) * np.ones(size)
    signal = (electrons * gain).astype(np.float32)
    known = np.array([black, np.log(gain), np.log(read), np.log(row)])
    inside, found = np.zeros(4), []
    for _ in range(simulations):
        analogue = black + gain * rng.poisson(electrons) + read * rng.normal(size=size)
        codes = np.clip(np.round(analogue + row * rng.normal(size=(size[0], 1))), 0, 4095).astype(np.float32)
        value = partial(_objective, codes=codes, signal=signal)
        best = maximise(value, known + 0.05, codes.size)
        found.append(best.values)
        bounds = [best.interval(k) for k in range(4)]
        inside += [low <= v <= high for (low, high), v in zip(bounds, known, strict=True)]
    values = np.array(found)
    values[:, 1:] = np.exp(values[:, 1:])
    return tuple(
        Coverage(n, t, float(m), float(c) / simulations, simulations)
        for n, t, m, c in zip(names, truth, values.mean(0), inside, strict=True)
    )


def _objective(theta, codes, signal):
    value, grad = _joint(theta.astype(np.float32), codes, signal)
    return float(value), np.asarray(grad, np.float64)
