"""What histograms cannot see, as evaluators: spectra of rows and columns, correlations at several lags."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from cannoise_jax.evaluation.evaluators import Evaluator, Samples, row_power_ratio

LAGS = ((0, 1), (1, 0), (1, 1), (0, 2), (2, 0))
"""Rows and columns, packed pixels of one colour."""
_LEAST = 1e-6


def standardised(noise: Float[np.ndarray, "n h w 4"], sigma: Float[np.ndarray, "n h w 4"]) -> np.ndarray:
    """Noise in units of the noise level function's standard deviation."""
    return noise / np.maximum(sigma, _LEAST)


def spectra(samples: Samples) -> dict[str, float]:
    """Power of row and column means at low frequencies over white noise's: 1 if white; generated and real."""
    numbers = {}
    for suffix, noise in (("", samples.fake), ("_real", samples.real)):
        z = standardised(noise, samples.sigma)
        numbers["row_spectrum" + suffix] = row_power_ratio(z)
        # Columns are rows of the turned image; its second colour is then the third.
        numbers["column_spectrum" + suffix] = row_power_ratio(z.swapaxes(1, 2)[..., [0, 2, 1, 3]])
    return numbers


def lags(samples: Samples) -> dict[str, float]:
    """Correlation of pixels of one colour at each of `LAGS`, generated and real, and their rms difference."""
    made, real = (_correlations(standardised(n, samples.sigma)) for n in (samples.fake, samples.real))
    numbers = {f"lag_{y}_{x}": value for (y, x), value in zip(LAGS, made, strict=True)}
    numbers |= {f"lag_{y}_{x}_real": value for (y, x), value in zip(LAGS, real, strict=True)}
    numbers["lags_rms"] = float(np.sqrt(np.mean(np.square(np.subtract(made, real)))))
    return numbers


def _correlations(z: np.ndarray) -> list[float]:
    centred = z - z.mean(axis=(1, 2), keepdims=True)
    power = float(np.square(centred).mean())
    height, width = z.shape[1:3]
    out = []
    for y, x in LAGS:
        product = centred[:, y:, x:] * centred[:, : height - y, : width - x]
        out.append(float(product.mean()) / power if power > 0 else float("nan"))
    return out


TEXTURE: tuple[Evaluator, ...] = (Evaluator("spectra", spectra), Evaluator("lags", lags))
