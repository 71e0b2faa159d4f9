"""Pixels whose level stands out in the darks: hot ones."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import special, stats

from cannoise_jax.discovery.fields import Fields
from cannoise_jax.discovery.statistics.patterns import pixel_sums
from cannoise_jax.discovery.statistics.score import Probe, Score
from cannoise_jax.discovery.statistics.shape import DARK

_SHARES = (2e-5, 1e-4, 5e-4, 2e-3)
HEATS = tuple(np.exp(np.linspace(np.log(1.5), np.log(200), 14)))
"""Mean heights that are tried, in standard deviations of a pixel's level."""


class Heat(NamedTuple):
    """Law of the heat of a pixel: exponential of this mean, DN or ('thermal') DN per second, in a share of
    the pixels, none in the others."""

    share: float
    mean: float
    scaling: str


class Known(NamedTuple):
    """What is known of the heat of every pixel: the chance that it is hot, and mean and variance of its heat
    if it is, `[H, W]`."""

    chance: np.ndarray
    centre: np.ndarray
    shape: np.ndarray
    unit: np.ndarray

    @property
    def mean(self) -> np.ndarray:
        """Expected heat."""
        return self.chance * self.unit * (self.centre + self.shape)

    @property
    def variance(self) -> np.ndarray:
        """Variance of the heat."""
        return np.maximum(self.power(2) - self.mean**2, 0.0)

    def power(self, k: int) -> np.ndarray:
        """Expected square (2) or, of a normal law, fourth power (4) of the heat."""
        inner = np.maximum(1 - self.shape * (self.shape + self.centre), 0.0)
        middle = (self.centre + self.shape) ** 2
        moment = middle + inner if k == 2 else middle**2 + 6 * middle * inner + 3 * inner**2
        return self.chance * self.unit**k * moment

    def draw(self, rng: np.random.Generator) -> np.ndarray:
        """Heat of every pixel, drawn from what is known."""
        hot = rng.random(self.chance.shape) < self.chance
        heat = stats.truncnorm.rvs(-self.centre[hot], np.inf, self.centre[hot], 1.0, random_state=rng)
        out = np.zeros(self.chance.shape)
        out[hot] = heat * self.unit[hot]
        return out


def known_heat(fields: tuple[Fields, ...], heat: Heat) -> Known | None:
    """What the darks tell of the heat of every pixel: of a normal value with an exponential mean, the mean is
    a normal one cut off at zero."""
    sums = pixel_sums(fields, heat.scaling, DARK)
    if sums is None:
        return None
    root = np.sqrt(sums.information)
    seen = root > 0
    safe = np.where(seen, root, 1.0)
    u, mean = sums.score / safe, heat.mean * safe
    ratio = np.where(seen, log_ratio_of(u, mean), 0.0)
    log_odds = np.log(max(heat.share, 1e-12)) - np.log1p(-min(heat.share, 0.5)) + ratio
    centre = np.where(seen, u - 1 / mean, -1 / mean)
    # Mean of a standard normal above -centre: the inverse of Mills' ratio.
    shape = np.exp(stats.norm.logpdf(centre) - stats.norm.logcdf(centre))
    return Known(np.where(seen, special.expit(log_odds), 0.0), centre, shape, 1 / safe)


def log_ratio_of(u: np.ndarray, mean: np.ndarray | float) -> np.ndarray:
    """Log density of a standard normal value plus an exponential one of this mean over the normal's alone."""
    log_ratio = (
        0.5 / np.square(mean)
        - u / mean
        - np.log(mean)
        + stats.norm.logcdf(u - 1 / mean)
        - stats.norm.logpdf(u)
    )
    return np.clip(log_ratio, -50, 600)


def heat_again(looked: Score, first: tuple[Fields, ...], second: tuple[Fields, ...]) -> Score | None:
    """The strength of hot pixels on other frames: the heat that the frames that found them expect of every
    pixel, times how much of it shows again. None where nothing shows it."""
    known = known_heat(first, looked.payload)
    sums = pixel_sums(second, looked.payload.scaling, DARK)
    if known is None or sums is None:
        return None
    information = float(np.sum(known.mean**2 * sums.information))
    square = float(np.sum(known.power(2)))
    if not information > 0 or not square > 0:
        return None
    again = max(float(np.sum(known.mean * sums.score)) / information, 0.0)
    # The heat of the same camera: what is not known of it is the doubt about each pixel, not the draw.
    doubt = float(np.sum(np.maximum(known.power(4) - known.power(2) ** 2, 0.0))) / square**2
    unit = looked.amplitude / (looked.payload.mean * np.sqrt(2 * max(looked.payload.share, 1e-12)))
    amplitude = unit * float(np.sqrt(square / known.mean.size))
    error = amplitude * float(np.sqrt(1 / information + again**2 * doubt / 4))
    return looked._replace(amplitude=amplitude * again, error=error)


def sparse_log_p(counts: np.ndarray, log_ratios: list[np.ndarray]) -> float:
    """log p that a few values follow another law: log_ratios holds, for several sizes of the effect, the log
    of its density over the null's at the values. The likelihood ratio averaged over sizes and shares has mean
    one under the null, so its inverse is a p-value (Markov)."""
    logs = [
        float(np.sum(counts * np.log1p(share * np.expm1(np.minimum(ratio, 600.0)))))
        for ratio in log_ratios
        for share in _SHARES
    ]
    return min(0.0, float(np.log(len(logs)) - special.logsumexp(logs)))


def hot_score(fields: tuple[Fields, ...], *, probe: str, scaling: str) -> Score | None:
    """A few pixels far above the others in the darks, at the same places in every frame."""
    sums = pixel_sums(fields, scaling, DARK)
    if sums is None:
        return None
    seen = sums.information > 0
    u = np.where(seen, sums.score / np.sqrt(np.where(seen, sums.information, 1.0)), 0.0).ravel()
    spread = max(1.4826 * float(np.median(np.abs(u - np.median(u)))), 1.0)
    number = int(np.sum(u > 4.6 * spread))
    ratios = []
    root = float(np.sqrt(np.median(sums.information[seen])))
    best, at, share = 0.0, 1.0, 0.0
    counts, edges = np.histogram(np.clip(u / spread, -20, 400), np.linspace(-20, 400, 8401))
    used = counts > 0
    counts, centre = counts[used], ((edges[1:] + edges[:-1]) / 2)[used]
    root /= spread
    for mean in HEATS:
        log_ratio = log_ratio_of(centre, mean)
        ratios.append(log_ratio)
        f = 1e-3
        for _ in range(40):
            responsibility = f * np.exp(log_ratio) / (1 - f + f * np.exp(log_ratio))
            f = float(np.clip(np.sum(counts * responsibility) / counts.sum(), 1e-7, 0.2))
        gain = float(np.sum(counts * np.log1p(f * np.expm1(log_ratio))))
        if gain > best:
            best, at, share = gain, float(mean), f
    seconds = (
        float(np.max([f.exposure_s or 1.0 for f in fields if f.kind in DARK]))
        if scaling == "thermal"
        else 1.0
    )
    amplitude = at / root * np.sqrt(2 * share) * seconds
    events = max(share * u.size, 1.0)
    high = [int(k) for k in np.argsort(-u)[:8]]
    width = fields[0].mean.shape[1]
    return Score(
        probe,
        max(sparse_log_p(counts, ratios), -700.0),
        best,
        float(np.log(u.size)) + 2,
        float(amplitude),
        float(amplitude / np.sqrt(events)),
        float(seconds / root / np.sqrt(np.sqrt(u.size / 2))),
        2,
        {"fraction": (share, "1", float(np.sqrt(share / u.size)))},
        {"axis": "pixel", "index": [[k // width, k % width] for k in high], "pixels": number},
        Heat(share, at / root, scaling),
    )


def mask_hot(fields: tuple[Fields, ...], score: Score) -> tuple[Fields, ...]:
    """Takes the pixels whose level stands out in the darks out of every field."""
    out = np.zeros(fields[0].mean.shape, bool)
    for scaling in ("additive", "thermal"):
        sums = pixel_sums(fields, scaling, DARK)
        if sums is not None:
            out |= np.abs(sums.score / np.sqrt(np.maximum(sums.information, 1e-30))) > 4.0
    return without_pixels(fields, out)


def without_pixels(fields: tuple[Fields, ...], out: np.ndarray) -> tuple[Fields, ...]:
    """The fields without some of their pixels."""
    keep = ~out
    return tuple(
        f._replace(
            usable=f.usable & keep,
            contrasts=f.contrasts * keep,
            static=None if f.static is None else f.static * keep,
        )
        for f in fields
    )


def probes() -> tuple[Probe, ...]:
    """The probes of this signature."""
    pixel = {"enters": "readout", "varies_over": "pixel", "scales": "additive"}
    return (
        Probe(
            "hot_additive",
            "hot_pixels",
            {**pixel, "time": "frozen", "law": "sparse"},
            partial(hot_score, probe="hot_additive", scaling="additive"),
            mask_hot,
            ("hot_thermal",),
            rare=True,
        ),
        Probe(
            "hot_thermal",
            "hot_pixels",
            {**pixel, "time": "frozen", "scales": "exposure", "law": "sparse"},
            partial(hot_score, probe="hot_thermal", scaling="thermal"),
            mask_hot,
            ("hot_additive",),
            rare=True,
        ),
    )
