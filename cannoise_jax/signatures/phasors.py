"""Waves as phasors: the likelihood of an amplitude, and fields without what waves span."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from scipy import optimize, special

from cannoise_jax.signatures.fields import Fields, map_contrasts
from cannoise_jax.signatures.score import quadratic_log_p


class Rician(NamedTuple):
    """Waves of one amplitude in several fields: log p at one frequency, gain, amplitude, its error, shift."""

    log_p: float
    gain: float
    amplitude: float
    error: float
    shift: float


def rician_fit(
    peak: float,
    power: np.ndarray,
    information: np.ndarray,
    whole: np.ndarray | float = 1.0,
    rest: np.ndarray | float = 1.0,
) -> Rician:
    """Likelihood of amplitude A when the power of field k, of information I_k, is that of a phasor of mean
    power A^2 I_k / 4 in complex noise of power 1. peak: sum of I_k power_k over sum of I_k. whole: what the
    powers were divided by, in units of the noise of which I_k tells; rest: the same without the phasor."""
    share = information / information.sum()
    log_p = quadratic_log_p(2 * peak, share, 2.0)
    beside, information = information / rest, information / whole
    start = (
        4 * max(float(np.sum(information * (power - 1))), 1e-3 * information.sum()) / np.sum(information**2)
    )

    def loss(log_square: float) -> float:
        mean = np.exp(log_square) * information / 4
        argument = 2 * np.sqrt(power * mean)
        return -float(np.sum(np.log(special.i0e(argument)) + argument - mean))

    middle = float(np.log(start))
    best = optimize.minimize_scalar(
        loss, bounds=(middle - 5, middle + 3), method="bounded", options={"xatol": 1e-3}
    )
    amplitude = float(np.exp(best.x / 2)) if best.fun < 0 else 0.0
    error = float(np.sqrt(2 / beside.sum()))
    shift = float(np.sqrt(4 / np.sqrt(np.sum(beside**2))))
    return Rician(log_p, max(-float(best.fun), 0.0), amplitude, error, shift)


def about_centre(points: Complex[np.ndarray, "t"]) -> Complex[np.ndarray, "t"]:
    """Points as seen from the centre of the circle that comes nearest to them, by linear least squares (Kasa,
    A circle fitting procedure and its error analysis, IEEE Trans. Instrum. Meas. IM-25, 8 (1976))."""
    basis = np.stack([2 * points.real, 2 * points.imag, np.ones(len(points))], 1)
    x, y, _ = np.linalg.lstsq(basis, np.abs(points) ** 2, rcond=None)[0]
    return points - (x + 1j * y)


def orthonormal(basis: Float[np.ndarray, "k n"]) -> Float[np.ndarray, "m n"]:
    """Orthonormal rows that span those of the basis, by its small Gram matrix."""
    values, vectors = np.linalg.eigh(basis @ basis.T)
    kept = values > 1e-6 * values[-1]
    return ((vectors[:, kept] / np.sqrt(values[kept])).T @ basis).astype(np.float32)


def without(field: Fields, basis: Float[np.ndarray, "k n"]) -> Fields:
    """The field with what the rows of `basis` span projected out."""
    return map_contrasts(field, partial(projected_out, q=orthonormal(basis)))


def projected_out(values: Float[np.ndarray, "n h w"], q: Float[np.ndarray, "m p"]) -> np.ndarray:
    """Images without what orthonormal rows `q` span."""
    share = values.reshape(len(values), q.shape[1]) @ q.T
    return values - (share @ q).reshape(values.shape)


def without_beside(
    values: Float[np.ndarray, "h w"], q: Float[np.ndarray, "m p"], others: Float[np.ndarray, "k p"]
) -> Float[np.ndarray, "h w"]:
    """An image without its share of orthonormal rows `q`, told beside what the rows of `others` span, of
    which nothing is taken; all that `q` spans where the others hold most of that as well."""
    held = orthonormal(others)
    own = q - (q @ held.T) @ held
    gram = own @ own.T
    if np.trace(gram) < 0.5 * len(q):
        return projected_out(values[None], q)[0]
    share = np.linalg.lstsq(gram, own @ values.ravel(), rcond=1e-3)[0]
    return values - (share @ q).reshape(values.shape)
