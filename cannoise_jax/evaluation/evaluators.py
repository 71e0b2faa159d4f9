"""Evaluators: numbers that compare generated noise with real noise, all with one contract.

An evaluator has a name and a pure function from `Samples` to named numbers. KL sees only the histogram, so
others stand beside it: rows that share an offset, neighbours that are correlated, the scale at each
intensity, and the tails. They see noise divided by the noise level function's sigma, z = n / sigma(clean),
so that an image's light and dark parts weigh alike; each number comes for the real and the generated noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cannoise_jax.evaluation import kl

DARK, BRIGHT = 0.05, 0.2
"""Clean intensities that part dark from middle from bright."""


class Samples(NamedTuple):
    """Real and generated noise on the same clean patches, packed `[n, h, w, 4]`, normalised units.

    real, fake: noisy minus clean, both clipped as `kl.clipped_noise` does. sigma: of the noise level function
    that the model was given, same shape.
    """

    real: Float[np.ndarray, "n h w 4"]
    fake: Float[np.ndarray, "n h w 4"]
    clean: Float[np.ndarray, "n h w 4"]
    sigma: Float[np.ndarray, "n h w 4"]


@dataclass(frozen=True)
class Evaluator:
    """`run(samples)` gives numbers by name, for one column of one row of the table."""

    name: str
    run: Callable[[Samples], dict[str, float]]


def kl_by_patch(samples: Samples) -> dict[str, float]:
    """The reference protocol: the KL of each patch, its floor and its smoothed version, mean over patches.

    `kl_se` is the standard error of `kl` over the patches. `kl_pool` is the KL of one histogram over all
    patches together, whose floor is far lower: it sees finer, and only what all patches have in common.
    Raises ValueError for noise that is not finite, which histograms would pass over in silence.
    """
    for name, noise in (("real", samples.real), ("generated", samples.fake)):
        wrong = noise.size - np.isfinite(noise).sum()
        if wrong:
            raise ValueError(f"{wrong} of {noise.size} values of the {name} noise are not finite")
    real = [kl.histogram(patch) for patch in samples.real]
    fake = [kl.histogram(patch) for patch in samples.fake]
    pairs = list(zip(real, fake, strict=True))
    values = [kl.kl_of_counts(a, b) for a, b in pairs]
    all_real, all_fake = np.sum(real, axis=0), np.sum(fake, axis=0)
    return {
        "kl": float(np.mean(values)),
        "kl_floor": float(np.mean([kl.kl_floor_of_counts(a, int(b.sum()), trials=8) for a, b in pairs])),
        "kl_smoothed": float(np.mean([kl.kl_smoothed_of_counts(a, b) for a, b in pairs])),
        "kl_se": float(np.std(values) / np.sqrt(len(values))),
        "kl_pool": kl.kl_of_counts(all_real, all_fake),
        "kl_pool_floor": kl.kl_floor_of_counts(all_real, int(all_fake.sum())),
        "patches": len(values),
    }


def row_power_ratio(noise: Float[np.ndarray, "n h w 4"]) -> float:
    """Power of the row means at low frequencies, divided by what white noise would leave there: 1 if white.

    Rows are mosaic rows (R with Gr, Gb with B), their means taken after each channel's own; low means the
    lowest quarter of the frequencies, the constant excluded.
    """
    centred = noise - noise.mean(axis=(1, 2), keepdims=True)
    count, height, width, _ = centred.shape
    rows = centred.reshape(count, height, width, 2, 2).mean(axis=(2, 4)).reshape(count, 2 * height)
    power = np.abs(np.fft.rfft(rows, axis=1)[:, 1 : height // 4 + 1]) ** 2 / rows.shape[1]
    return _ratio(power.mean() * 2 * width, np.square(centred).mean())


def lag_correlation(noise: Float[np.ndarray, "n h w 4"], axis: int) -> float:
    """Correlation of neighbours of one packed channel, along the rows (axis 2) or across them (axis 1)."""
    centred = np.moveaxis(noise - noise.mean(axis=(1, 2), keepdims=True), axis, 1)
    return _ratio((centred[:, 1:] * centred[:, :-1]).mean(), np.square(centred).mean())


def excess_kurtosis(noise: Float[np.ndarray, "..."]) -> float:
    """Fourth standardised moment minus three."""
    square = np.square(noise - noise.mean())
    return _ratio(np.square(square).mean(), square.mean() ** 2) - 3


def _ratio(part: float, whole: float) -> float:
    """Their quotient; nan for noise that is zero everywhere, which has no structure."""
    return float(part / whole) if whole > 0 else math.nan


def structure(samples: Samples) -> dict[str, float]:
    """Row spectrum, lag-1 correlations and excess kurtosis of the standardised noise, generated and real."""
    numbers = {}
    for suffix, noise in (("", samples.fake), ("_real", samples.real)):
        z = noise / np.maximum(samples.sigma, 1e-6)
        numbers["row_spectrum" + suffix] = row_power_ratio(z)
        numbers["lag1_horizontal" + suffix] = lag_correlation(z, 2)
        numbers["lag1_vertical" + suffix] = lag_correlation(z, 1)
        numbers["excess_kurtosis" + suffix] = excess_kurtosis(z)
    return numbers


def scale(samples: Samples) -> dict[str, float]:
    """Generated over real standard deviation: everywhere, and in the dark, middle and bright parts."""
    parts = {
        "": np.isfinite(samples.clean),
        "_dark": samples.clean < DARK,
        "_middle": (samples.clean >= DARK) & (samples.clean < BRIGHT),
        "_bright": samples.clean >= BRIGHT,
    }
    return {
        "std_ratio" + suffix: float(samples.fake[part].std() / samples.real[part].std())
        for suffix, part in parts.items()
        if part.sum() > 1000 and samples.real[part].std() > 0
    }


EVALUATORS: tuple[Evaluator, ...] = (
    Evaluator("kl", kl_by_patch),
    Evaluator("structure", structure),
    Evaluator("scale", scale),
)


def pooled(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The numbers of several cameras as one row: means weighted by their patches; `patches` adds up.

    So the pooled `kl` is the mean over all patches, and `kl_se` its standard error. A number that some rows
    lack is the mean of those that have it.
    """
    made: dict[str, float] = {}
    for name in dict.fromkeys(name for row in rows for name in row):
        have = [(row["patches"], row[name]) for row in rows if name in row]
        total = sum(count for count, _ in have)
        if name == "patches":
            made[name] = total
        elif name == "kl_se":
            made[name] = float(np.sqrt(sum((count * value) ** 2 for count, value in have)) / total)
        else:
            made[name] = sum(count * value for count, value in have) / total
    return made


def evaluate(samples: Samples, evaluators: tuple[Evaluator, ...] = EVALUATORS) -> dict[str, float]:
    """The numbers of all evaluators on one set of samples, in one dictionary."""
    return {name: value for e in evaluators for name, value in e.run(samples).items()}
