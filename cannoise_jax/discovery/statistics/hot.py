"""Pixels whose level stands out in the darks: hot ones."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import special, stats

from cannoise_jax.discovery.fields import Fields
from cannoise_jax.discovery.statistics.patterns import pixel_sums
from cannoise_jax.discovery.statistics.rare import (
    CENTRES,
    FAR,
    HEATS,
    hot_log_p,
    level_counts,
    log_mixture,
    log_ratio_of,
    spread_of,
)
from cannoise_jax.discovery.statistics.score import Probe, Score
from cannoise_jax.discovery.statistics.shape import DARK

_MOST_SHARE = 0.5
_STRONG = 2.0
"""Spread of the levels of most pixels, in standard deviations of their noise, from which on every pixel has a
level of its own and the hot ones are those that stand out from these: beside a map, not in place of it."""
_LEAST_NOISE = 0.6
"""Standard deviation of the noise of a dark, in codes, from which on the mean of a few frames is normal."""


class Heat(NamedTuple):
    """Law of the heat of a pixel: exponential of this mean, DN or ('thermal') DN per second, in a share of
    the pixels, none in the others. spread: standard deviation of the levels of those others, in units of the
    noise, where every pixel has a level of its own; else 1."""

    share: float
    mean: float
    scaling: str
    spread: float = 1.0

    @property
    def beside_map(self) -> bool:
        """Whether the other pixels have levels far beyond the noise too, a pattern that is found after."""
        return self.spread > 1


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
    a normal one cut off at zero. Beside a map a pixel is either hot or one of the map."""
    sums = pixel_sums(fields, heat.scaling, DARK)
    if sums is None:
        return None
    root = np.sqrt(sums.information) / heat.spread
    seen = root > 0
    safe = np.where(seen, root, 1.0)
    u, mean = sums.score / safe / heat.spread**2, heat.mean * safe
    ratio = np.where(seen, log_ratio_of(u, mean), 0.0)
    log_odds = np.log(max(heat.share, 1e-12)) - np.log1p(-min(heat.share, _MOST_SHARE)) + ratio
    centre = np.where(seen, u - 1 / mean, -1 / mean)
    # Mean of a standard normal above -centre: the inverse of Mills' ratio.
    shape = np.exp(stats.norm.logpdf(centre) - stats.norm.logcdf(centre))
    chance = np.where(seen, special.expit(log_odds), 0.0)
    return Known(np.round(chance) if heat.beside_map else chance, centre, shape, 1 / safe)


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


def _fitted(counts: np.ndarray) -> tuple[float, float, float]:
    """Share and mean height of most likelihood, and the nats that they gain."""
    used = counts > 0
    n, u = counts[used], CENTRES[used]

    def step(share: float, ratio: np.ndarray) -> tuple[float, np.ndarray]:
        hot = n * special.expit(special.logit(share) + ratio)
        return float(np.clip(np.sum(hot) / n.sum(), 1e-7, _MOST_SHARE)), hot

    def gained(share: float, ratio: np.ndarray) -> float:
        return float(np.sum(n * np.logaddexp(np.log1p(-share), np.log(share) + ratio)))

    best, at, share = 0.0, 1.0, 0.0
    for mean in HEATS:
        ratio, f = log_ratio_of(u, mean), 1e-3
        for _ in range(40):
            f = step(f, ratio)[0]
        gain = gained(f, ratio)
        if gain > best:
            best, at, share = gain, float(mean), f
    if not share:
        return 0.0, at, 0.0
    for _ in range(40):
        share, hot = step(share, log_ratio_of(u, at))
        inner = u - 1 / at
        height = inner + np.exp(stats.norm.logpdf(inner) - stats.norm.logcdf(inner))
        at = max(float(np.sum(hot * height) / np.sum(hot)), HEATS[0])
    return share, at, gained(share, np.minimum(log_ratio_of(u, at), FAR))


def _lattice_spread(fields: tuple[Fields, ...]) -> float:
    """The standard deviation that the level of a pixel is taken to have at least, over that of its noise:
    below some half a code a few changes by a code reach further than a normal law has it."""
    darks = [f for f in fields if f.kind in DARK and f.usable.any()]
    return max((_LEAST_NOISE * f.step * float(np.median(f.weight[f.usable])) for f in darks), default=0.0)


def hot_score(fields: tuple[Fields, ...], *, probe: str, scaling: str) -> Score | None:
    """A few pixels far above the others in the darks, at the same places in every frame."""
    sums = pixel_sums(fields, scaling, DARK)
    if sums is None:
        return None
    seen = sums.information > 0
    if not seen.any():
        return None
    u = np.where(seen, sums.score / np.sqrt(np.where(seen, sums.information, 1.0)), 0.0).ravel()
    bulk = spread_of(u[seen.ravel()])
    spread = max(bulk, _lattice_spread(fields))
    number = int(np.sum(u > 4.6 * spread))
    root = float(np.sqrt(np.median(sums.information[seen]))) / spread
    counts = level_counts(u[seen.ravel()] / spread)
    share, at, gain = _fitted(counts)
    mixture = float(log_mixture(counts))
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
        max(hot_log_p(mixture, int(seen.sum())), -700.0),
        gain,
        max(gain - mixture, 2.0),
        float(amplitude),
        float(amplitude / np.sqrt(events)),
        float(seconds / root / np.sqrt(np.sqrt(u.size / 2))),
        2,
        {"fraction": (share, "1", float(np.sqrt(share / u.size)))},
        {"axis": "pixel", "index": [[k // width, k % width] for k in high], "pixels": number},
        Heat(share, at / root, scaling, bulk if bulk > _STRONG else 1.0),
    )


def before_maps(scores: list[Score]) -> list[Score]:
    """Scores, strongest first; hot pixels alone where they stand out from a map of levels that would come
    first: a map is judged when they are out of it."""
    hot = [s for s in scores if isinstance(s.payload, Heat) and s.payload.beside_map]
    return hot if hot and scores[0].probe in ("pixel_additive_static", "pixel_thermal_static") else scores


def mask_hot(fields: tuple[Fields, ...], score: Score) -> tuple[Fields, ...]:
    """Takes the pixels whose level stands out in the darks out of every field."""
    if score.payload.beside_map:
        known = known_heat(fields, score.payload)
        return fields if known is None else without_pixels(fields, known.chance > 0.5)
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
