"""A composite score for models that can be sampled but have no likelihood: mean log-probabilities of parts.

The score of frames under a model is the sum of three kinds of log-probability, each a proper score by itself,
each learned from frames that the model simulated (never from the frames that are scored):

1. the pixel's own law: which bin its standardised residual falls in, by light level, plus which code it takes
   within a period of eight code steps (bins and periods are the same for all models that are compared);
2. pairs: how much a bivariate normal law with the model's correlation beats two independent ones, at six lags
   within the frame and one between frames;
3. means of rows, columns and frames: normal laws with the model's mean square, against independent pixels.

Parts overlap, so the sum is no likelihood and its differences are no evidence ratios: they rank models, and a
threshold for them comes from simulated frames. Use the same `Ruler` before and after a change of the model.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

_LAGS = ((0, 1), (1, 0), (1, 1), (0, 2), (2, 0), (2, 2))
"""Rows down and columns across: neighbours, and those of the same colour."""
_PERIOD = 8
"""Codes are counted modulo this: gaps and repeats of 2, 4 and 8 codes show."""


class Ruler(NamedTuple):
    """What scores are measured with: fixed for all models compared.

    mean, sigma: DN per pixel, of a baseline.
    level: light level of every pixel, 0 to levels - 1.
    edges: of the bins of the standardised residual.
    step: of the codes, DN.
    """

    mean: Float[np.ndarray, "h w"]
    sigma: Float[np.ndarray, "h w"]
    level: Int[np.ndarray, "h w"]
    edges: Float[np.ndarray, "e"]
    step: float


class Profile(NamedTuple):
    """What a model predicts for the parts of the score, learned from its simulated frames."""

    log_bins: Float[np.ndarray, "l b"]
    log_codes: Float[np.ndarray, "p"]
    correlations: Float[np.ndarray, "7"]
    mean_squares: Float[np.ndarray, "3"]


class CompositeScore(NamedTuple):
    """Nats per pixel, larger is better, and those of the lattice of codes; `per_frame` serves intervals by
    resampling frames."""

    total: float
    codes: float
    per_frame: Float[np.ndarray, "t"]


def ruler(
    mean: Float[np.ndarray, "h w"],
    sigma: Float[np.ndarray, "h w"],
    step: float = 1.0,
    levels: int = 6,
    bins: int = 48,
) -> Ruler:
    """Light levels of equal size, and bins of the residual: normal quantiles inside, then out to 40 sigma."""
    from scipy.special import ndtri

    rank = np.argsort(np.argsort(mean.ravel(), kind="stable")).reshape(mean.shape)
    inner = ndtri(np.linspace(0, 1, bins + 1)[1:-1])
    outer = np.array([3.0, 4.0, 5.0, 7.0, 10.0, 20.0, 40.0])
    return Ruler(mean, sigma, rank * levels // mean.size, np.sort([*inner, *outer, *-outer]), float(step))


def _parts(frames: np.ndarray, by: Ruler):
    """Standardised residuals, their bins, and codes within the period."""
    values = np.asarray(frames, np.float64)
    z = (values - by.mean) / by.sigma
    codes = np.round(values / (by.step or 1.0)).astype(np.int64) % _PERIOD
    return np.clip(z, -6, 6), np.searchsorted(by.edges, z), codes


def _pairs(z: np.ndarray):
    """The pairs of standardised residuals at each lag; the last is the pixel in the next frame."""
    h, w = z.shape[1:]
    for dy, dx in _LAGS:
        yield z[:, dy:, dx:], z[:, : h - dy, : w - dx]
    if len(z) > 1:
        yield z[1:], z[:-1]


def _means(z: np.ndarray):
    """Means of rows, columns and frames, scaled to unit variance for independent pixels."""
    h, w = z.shape[1:]
    return z.mean(2) * np.sqrt(w), z.mean(1) * np.sqrt(h), z.mean((1, 2))[:, None] * np.sqrt(h * w)


def profile(simulated: np.ndarray, by: Ruler) -> Profile:
    """Learns a model from its frames `[T, H, W]`, DN: the more, the smaller the error of the score.

    Give at least twice the frames that will be scored.
    Every count is raised by one half so that nothing is impossible.
    """
    z, bins, codes = _parts(simulated, by)
    levels, width = int(by.level.max()) + 1, len(by.edges) + 1
    joint = np.broadcast_to(by.level, bins.shape) * width + bins
    counts = np.bincount(joint.ravel(), minlength=levels * width).reshape(levels, width) + 0.5
    code_counts = np.bincount(codes.ravel(), minlength=_PERIOD) + 0.5
    square = np.mean(z * z)
    correlations = [float(np.mean(a * b) / square) for a, b in _pairs(z)]
    correlations += [0.0] * (len(_LAGS) + 1 - len(correlations))
    return Profile(
        np.log(counts / counts.sum(1, keepdims=True)),
        np.log(code_counts / code_counts.sum()),
        np.clip(correlations, -0.99, 0.99),
        np.array([np.mean(m * m) for m in _means(z)]) / square,
    )


def composite_score(model: Profile, frames: np.ndarray, by: Ruler) -> CompositeScore:
    """Score of frames `[T, H, W]`, DN, under a model learned by `profile` with the same ruler."""
    z, bins, codes = _parts(frames, by)
    size = z[0].size
    marginal = model.log_bins[by.level, bins].mean((1, 2))
    by_code = model.log_codes[codes].mean((1, 2))
    unit = np.sqrt(np.mean(z * z))
    pairs = np.zeros(len(z))
    for rho, (a, b) in zip(model.correlations, _pairs(z / unit), strict=False):
        rest = 1 - rho * rho
        gain = -0.5 * np.log(rest) - (rho * rho * (a * a + b * b) - 2 * rho * a * b) / (2 * rest)
        pairs[: len(gain)] += gain.sum((1, 2)) / size
    means = np.zeros(len(z))
    for square, m in zip(model.mean_squares, _means(z / unit), strict=True):
        means += (0.5 * m * m * (1 - 1 / square) - 0.5 * np.log(square)).sum(1) / size
    per_frame = marginal + by_code + pairs + means
    return CompositeScore(float(per_frame.mean()), float(by_code.mean()), per_frame)
