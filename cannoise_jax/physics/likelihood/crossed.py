"""Likelihood of frames with crossed shared terms: offsets of rows, columns and the frame at once.

Offsets u are normal; given them the pixels are independent. `crossed_gaussian` takes the pixels as normal
with the quantisation variance step^2 / 12 added: the covariance D + U U' has H + W + 1 low-rank directions
and is never formed. `crossed_laplace` keeps the discretised, censored pixel likelihood and expands it around
the mode of u. Both work on the small matrix I + U' D^-1 U, whose blocks are diagonal except for the rows
against the columns.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cannoise_jax.physics.likelihood.codes import UNIT_STEP, CodeGrid, gaussian_log_prob

_LOG_2PI = 1.8378770664093453
_SHARES = (1.0, 0.4, 0.1, 0.02, 0.0)
"""Of a Newton step, tried in turn: the best is taken."""


class SharedTerms(NamedTuple):
    """Factors of the covariances of the shared offsets, DN: offsets = factor @ standard normals.

    row: `[H, Kr]`, column: `[W, Kc]`; frame: sigma. White row noise of sigma s is `s * eye(H)`; a factor of
    any
    stationary covariance comes from `stationary_factor`. Zero is allowed: the term is then absent.
    """

    row: Float[Array, "h kr"]
    column: Float[Array, "w kc"]
    frame: float | Float[Array, ""] = 0.0


def white_terms(size: tuple[int, int], row=0.0, column=0.0, frame=0.0) -> SharedTerms:
    """Row, column and frame offsets without memory; sigmas in DN."""
    return SharedTerms(row * jnp.eye(size[0]), column * jnp.eye(size[1]), frame)


def stationary_factor(covariance: Float[Array, "n"]) -> Float[Array, "n n"]:
    """Cholesky factor of the Toeplitz matrix of an autocovariance (lags 0 to n-1, DN^2), for pink row
    noise."""
    n = covariance.shape[0]
    lag = np.abs(np.arange(n)[:, None] - np.arange(n)[None, :])
    return jnp.linalg.cholesky(covariance[lag] + 1e-6 * covariance[0] * jnp.eye(n))


def _spread(terms: SharedTerms, unit: Float[Array, "k"]) -> Float[Array, "h w"]:
    """U @ unit: the offset of every pixel."""
    rows, columns = terms.row.shape[1], terms.column.shape[1]
    row, column = terms.row @ unit[:rows], terms.column @ unit[rows : rows + columns]
    return row[:, None] + column[None, :] + terms.frame * unit[-1]


def _gather(terms: SharedTerms, pixels: Float[Array, "h w"]) -> Float[Array, "k"]:
    """U' @ pixels."""
    return jnp.concatenate(
        [terms.row.T @ pixels.sum(1), terms.column.T @ pixels.sum(0), terms.frame * pixels.sum()[None]]
    )


def _small_matrix(terms: SharedTerms, weight: Float[Array, "h w"]) -> Float[Array, "k k"]:
    """I + U' diag(weight) U."""
    by_row, by_column = weight.sum(1), weight.sum(0)
    rr = terms.row.T @ (by_row[:, None] * terms.row)
    cc = terms.column.T @ (by_column[:, None] * terms.column)
    rc = terms.row.T @ weight @ terms.column
    rf = (terms.row.T @ by_row * terms.frame)[:, None]
    cf = (terms.column.T @ by_column * terms.frame)[:, None]
    ff = (terms.frame**2 * weight.sum())[None, None]
    full = jnp.block([[rr, rc, rf], [rc.T, cc, cf], [rf.T, cf.T, ff]])
    return full + jnp.eye(full.shape[0])


@partial(jax.jit, static_argnames="correct")
def crossed_gaussian(
    codes: Float[Array, "t h w"],
    mean: Float[Array, "*t h w"] | float,
    variance: Float[Array, "#h #w"] | float,
    terms: SharedTerms,
    grid: CodeGrid = UNIT_STEP,
    correct: bool = True,
) -> Float[Array, "t"]:
    """Log-probability of each frame, nats: normal pixels and shared terms, the step in the variance, no
    rails.

    variance: DN^2 of the pixel's own noise. correct: adds, per pixel, the discretised minus the normal
      log-marginal, which removes most of the error of treating codes as continuous.
    Error against the exact likelihood, per pixel: below 1e-4 nats for pixel noise of at least one step, up
    to 1e-3
    below that (`bin/bench likelihood` measures it); there, and near the rails, use `crossed_laplace`.
    One factorisation of an (H + W + 1)-square matrix serves all frames.
    """
    codes = jnp.asarray(codes, jnp.float32)
    residual = codes - mean
    step = jnp.asarray(grid.step, jnp.float32)
    size = residual.shape[-2:]
    total = jnp.broadcast_to(variance + step**2 / 12, size)
    weight = 1 / total
    factor = jnp.linalg.cholesky(_small_matrix(terms, weight))
    log_det = 2 * jnp.sum(jnp.log(jnp.diagonal(factor))) + jnp.sum(jnp.log(total))

    def quadratic(frame):
        whitened = jax.scipy.linalg.solve_triangular(factor, _gather(terms, weight * frame), lower=True)
        return jnp.sum(weight * frame * frame) - jnp.sum(whitened**2)

    width = jnp.where(step > 0, step, 1.0)
    log_mass = size[0] * size[1] * (jnp.log(width) - _LOG_2PI / 2)
    result = log_mass - log_det / 2 - jax.vmap(quadratic)(residual) / 2
    if correct:
        shared = (terms.row**2).sum(1)[:, None] + (terms.column**2).sum(1)[None, :] + terms.frame**2
        own = jnp.broadcast_to(variance, size) + shared
        fine = gaussian_log_prob(residual, 0.0, own, CodeGrid(step))
        spread = own + step**2 / 12
        coarse = jnp.log(width) - (_LOG_2PI + jnp.log(spread) + residual**2 / spread) / 2
        result = result + jnp.sum(fine - coarse, (-2, -1))
    return result


def crossed_laplace(
    log_prob: Callable[[Float[Array, "h w"]], Float[Array, "h w"]],
    terms: SharedTerms,
    size: tuple[int, int],
    newton_steps: int = 12,
) -> Float[Array, ""]:
    """Log-probability of one frame, nats, by Laplace's approximation over all shared offsets; `vmap` over
    frames.

    log_prob: pixel log-probabilities given an offset map, DN, to be added to the mean; any pixel likelihood
    of
      this package, censored at the rails or not.
    Exact for normal pixels. Error against exact integrals, nats per pixel: below 3e-5 on frames of 32 x 32
    for noise of a third of a step or more; on tiny frames of 12 x 3, 1e-4 at one step and 1e-3 at half a
    step; no larger where an offset is 100 sigma.
    The gradient follows the mode: one implicit Newton step at the end is differentiated.
    """
    pixels, hoisted = jax.closure_convert(log_prob, jnp.zeros(size, jnp.float32))
    fixed, fixed_terms = jax.lax.stop_gradient((hoisted, terms))

    def derivatives(offset, hoisted):
        slope = jax.grad(lambda o: jnp.sum(pixels(o, *hoisted)))
        first, second = jax.jvp(slope, (offset,), (jnp.ones_like(offset),))
        return first, jnp.maximum(-second, 0.0)

    def height(unit):
        return jnp.sum(pixels(_spread(fixed_terms, unit), *fixed)) - jnp.sum(unit**2) / 2

    def step(unit, _):
        # Normal pixels reach their mode, however far, in one step; shorter ones are for codes coarser than
        # the noise, and for tails.
        first, weight = derivatives(_spread(fixed_terms, unit), fixed)
        small = _small_matrix(fixed_terms, weight + 1e-3 * jnp.mean(weight))
        move = jnp.linalg.solve(small, _gather(fixed_terms, first) - unit)
        shares = jnp.asarray(_SHARES)
        heights = jax.lax.map(lambda share: height(unit + share * move), shares)
        return unit + shares[jnp.argmax(heights)] * move, None

    unit = jnp.zeros(terms.row.shape[1] + terms.column.shape[1] + 1)
    unit = jax.lax.scan(step, unit, None, length=newton_steps)[0]
    first, weight = derivatives(_spread(terms, unit), hoisted)
    small = jax.lax.stop_gradient(_small_matrix(terms, weight))
    unit = unit + jnp.linalg.solve(small, _gather(terms, first) - unit)
    _, weight = derivatives(_spread(terms, unit), hoisted)
    factor = jnp.linalg.cholesky(_small_matrix(terms, weight))
    fit = jnp.sum(log_prob(_spread(terms, unit)))
    return fit - jnp.sum(unit**2) / 2 - jnp.sum(jnp.log(jnp.diagonal(factor)))
