"""Likelihood of frames with crossed shared terms: offsets of rows, columns and the frame at once.

Offsets u are normal; given them the pixels are independent, and taken as normal with the quantisation
variance step^2 / 12 added: the covariance D + U U' has H + W + 1 low-rank directions and is never formed. All
is done on the small matrix I + U' D^-1 U, whose blocks are diagonal except for the rows against the columns.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cannoise_jax.physics.likelihood.codes import UNIT_STEP, CodeGrid, gaussian_log_prob

_LOG_2PI = 1.8378770664093453
"""log(2 pi), of the normal density."""


class SharedTerms(NamedTuple):
    """Factors of the covariances of the shared offsets, DN: offsets = factor @ standard normals.

    row: `[H, Kr]`, column: `[W, Kc]`; frame: sigma. White row noise of sigma s is `s * eye(H)`; a factor of
    any stationary covariance comes from `stationary_factor`. Zero is allowed: the term is then absent.
    """

    row: Float[Array, "h kr"]
    column: Float[Array, "w kc"]
    frame: float | Float[Array, ""] = 0.0


def stationary_factor(covariance: Float[Array, "n"]) -> Float[Array, "n n"]:
    """Cholesky factor of the Toeplitz matrix of an autocovariance (lags 0 to n-1, DN^2), for pink row
    noise."""
    n = covariance.shape[0]
    lag = np.abs(np.arange(n)[:, None] - np.arange(n)[None, :])
    return jnp.linalg.cholesky(covariance[lag] + 1e-6 * covariance[0] * jnp.eye(n))


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
    Error against the exact likelihood, per pixel: below 1e-4 nats for pixel noise of at least one step, 6e-3
    where it is a third of a step; rails are not seen.
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
