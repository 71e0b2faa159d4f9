"""The maximum of a likelihood, and intervals from its curvature there."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import optimize
from scipy.special import ndtri


class Maximum(NamedTuple):
    """Parameters at the maximum of a likelihood; covariance from the observed information there."""

    values: Float[np.ndarray, "p"]
    covariance: Float[np.ndarray, "p p"]
    log_likelihood: float
    converged: bool

    def interval(self, index: int, level: float = 0.9) -> tuple[float, float]:
        """Normal confidence interval of one parameter."""
        half = float(ndtri(0.5 + level / 2)) * float(np.sqrt(self.covariance[index, index]))
        return float(self.values[index]) - half, float(self.values[index]) + half


def maximise(
    value_and_grad: Callable[[Float[np.ndarray, "p"]], tuple[float, Float[np.ndarray, "p"]]],
    start: Float[np.ndarray, "p"],
    count: float,
    step: float = 0.02,
) -> Maximum:
    """Maximum of `count` times a mean log-likelihood, by L-BFGS, its curvature by differences of the
    gradient.

    value_and_grad: of the mean over `count` pixels, float32 inside is enough. Parameters should be scaled so
    that
    `step` is a small change of each (logarithms of positive ones).
    """

    def negative(theta):
        value, grad = value_and_grad(theta)
        return -float(value), -np.asarray(grad, np.float64)

    found = optimize.minimize(
        negative, start, jac=True, method="L-BFGS-B", options={"ftol": 1e-10, "gtol": 2e-6, "maxiter": 200}
    )
    shifts = step * np.eye(len(start))
    hessian = np.array([negative(found.x + s)[1] - negative(found.x - s)[1] for s in shifts]) / (2 * step)
    information = count * (hessian + hessian.T) / 2
    try:
        covariance = np.linalg.inv(information)
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        covariance = np.full_like(information, np.nan)
    settled = float(np.max(np.abs(found.jac))) < 1e-3 and bool(np.isfinite(covariance).all())
    return Maximum(found.x, covariance, -count * float(found.fun), settled)
