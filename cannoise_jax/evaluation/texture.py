"""What histograms cannot see, as evaluators: spectra of rows and columns, correlations at several lags, and
the area under the curve of a small network that is to tell recordings from draws."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from cannoise_jax.discovery.patch_network import SIDE, Patches, train
from cannoise_jax.discovery.twosample import area
from cannoise_jax.evaluation.evaluators import Evaluator, Samples, row_spectrum

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
        numbers["row_spectrum" + suffix] = row_spectrum(z)
        # Columns are rows of the turned image; its second colour is then the third.
        numbers["column_spectrum" + suffix] = row_spectrum(z.swapaxes(1, 2)[..., [0, 2, 1, 3]])
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


class Told(NamedTuple):
    """Area under the curve, 0.5: cannot be told; patches: how many of either kind were judged."""

    area: float
    patches: int


def two_sample_area(
    samples: Samples, group: Int[np.ndarray, "n"], scene: Int[np.ndarray, "n"], seed: int = 0
) -> Told | None:
    """Can a network that knows no physics tell real patches of 32 x 32 mosaic pixels from generated ones?

    Trained on every other scene and judged on the rest, either way round; areas within each group (camera and
    setting), averaged. None where a group has one scene only, or patches are too small.
    """
    parts = np.searchsorted(np.unique(scene), scene) % 2
    rng = np.random.default_rng(seed)
    order = rng.permutation(2)
    areas, count = [], 0
    groups = [g for g in np.unique(group) if len(np.unique(parts[group == g])) == 2]
    if not groups or min(samples.real.shape[1:3]) < SIDE // 2:
        return None
    kept = np.isin(group, groups)
    for first in order:
        learn, judge = kept & (parts == first), kept & (parts != first)
        real, fake = (
            _tiles(n[learn], samples.sigma[learn], group[learn]) for n in (samples.real, samples.fake)
        )
        network = train(real, fake)
        real, fake = (
            _tiles(n[judge], samples.sigma[judge], group[judge]) for n in (samples.real, samples.fake)
        )
        told, plain = network.scores(real), network.scores(fake)
        for g in groups:
            own = real.recording == g
            areas.append(area(told[own], plain[fake.recording == g]))
            count += int(own.sum())
    return Told(float(np.mean(areas)), count)


def _tiles(noise: np.ndarray, sigma: np.ndarray, group: np.ndarray) -> Patches:
    """Mosaics of packed patches, cut into squares of the network's side, in units of sigma."""
    z = standardised(noise, sigma)
    count, height, width, _ = z.shape
    mosaic = (
        z.reshape(count, height, width, 2, 2).transpose(0, 1, 3, 2, 4).reshape(count, 2 * height, 2 * width)
    )
    rows, columns = (n // SIDE for n in mosaic.shape[1:])
    cut = mosaic[:, : rows * SIDE, : columns * SIDE].reshape(count, rows, SIDE, columns, SIDE)
    values = np.clip(cut.transpose(0, 1, 3, 2, 4).reshape(-1, SIDE, SIDE), -8, 8).astype(np.float32)
    frame = np.repeat(np.arange(count), rows * columns)
    return Patches(values, frame, np.repeat(group, rows * columns))
