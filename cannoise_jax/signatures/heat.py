"""The heat of pixels: its law, and what darks tell of each."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import special, stats
from scipy.interpolate import make_interp_spline

from cannoise_jax.physics.robust import NOISE_OF_MEDIAN, OF_MEDIAN, median, robust_std
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures.core_law import Core
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.group_sums import LineSums, medians
from cannoise_jax.signatures.patterns import pixel_sums

MOST_SHARE = 0.5
"""Most pixels that may be hot: more are the rule, and no outliers."""


_BLOCK = 8
"""Pixels of a site of the mosaic, a side, whose median is the level around them."""


def above_neighbours(fields: tuple[Fields, ...], scaling: str) -> LineSums | None:
    """Scores and information of what every pixel of the darks has beyond the level around it, as far as such
    levels differ by more than pixels do: where the electronics glow all pixels are high, and none of them
    hot."""
    sums = pixel_sums(fields, scaling, DARK)
    return None if sums is None else less_levels(sums, levels_around(sums))


def less_levels(sums: LineSums, levels: Float[np.ndarray, "h w"]) -> LineSums:
    """The same of sums whose levels around are known."""
    seen = sums.information > 0
    if not seen.any():
        return sums
    single = sums.score / np.maximum(sums.information, 1e-30) - levels
    if np.std(levels[seen]) < robust_std(single[seen], 0):
        return sums
    return sums._replace(score=sums.score - sums.information * levels)


def levels_around(sums: LineSums, side: int = _BLOCK, curved: bool = False) -> Float[np.ndarray, "h w"]:
    """The level around every pixel as far as such levels differ by more than noise, DN or DN/s. side: of what
    is around a pixel, pixels of its site of the mosaic; curved: whether levels bend between these, as those
    of light do."""
    around = np.zeros(sums.score.shape)
    if min(around.shape) < 4 * side:
        return around
    estimate = sums.score / np.maximum(sums.information, 1e-30)
    for at in SITES:
        around[at] = _around(estimate[at], sums.information[at], side, curved)
    return around


def _around(
    values: Float[np.ndarray, "h w"], information: Float[np.ndarray, "h w"], side: int, curved: bool
) -> Float[np.ndarray, "h w"]:
    """Medians of blocks, natural splines or straight lines between their middles, shrunk by what of them is
    chance."""
    edges = [np.linspace(0, n, n // side + 1).astype(int) for n in values.shape]
    rows, columns = (np.repeat(np.arange(len(e) - 1), np.diff(e)) for e in edges)
    shape = len(edges[0]) - 1, len(edges[1]) - 1
    known = information > 0
    of, inside = (rows[:, None] * shape[1] + columns)[known], values[known]
    count = np.bincount(of, minlength=shape[0] * shape[1])
    if not inside.size:
        return np.zeros(values.shape)
    levels = np.where(count, medians(inside, of, count), 0.0)
    spread = OF_MEDIAN * np.where(count, medians(np.abs(inside - levels[of]), of, count), 0.0)
    noise = (NOISE_OF_MEDIAN * spread**2 / np.maximum(count, 1)).reshape(shape)
    levels = levels.reshape(shape)
    levels -= median(levels)
    apart = float(np.sum(np.minimum(levels**2, 1e6 * noise + 1e-30)))
    share = max(1 - 2 * float(noise.sum()) / max(apart, 1e-30), 0.0)
    if not share:
        return np.zeros(values.shape)
    out = share * levels
    for axis, (e, n) in enumerate(zip(edges, values.shape, strict=True)):
        middles = (e[1:] + e[:-1] - 1) / 2
        order, ends = (3, "natural") if curved else (1, None)
        out = make_interp_spline(middles, out, order, axis=axis, bc_type=ends)(np.arange(n))
    return out


_LINEAR = 0.05
"""Share by which the level of a hot pixel may be off its law: warm-up of a sensor, a bend of its response."""


def follows_exposure(fields: tuple[Fields, ...], far: Bool[np.ndarray, "h w"]) -> float | None:
    """By how much, chi-square of a typical pixel that stands out, levels in the darks follow the exposure
    better than they stay the same; None where no two darks of known exposures differ in that."""
    darks = [f for f in fields if f.kind in DARK and f.exposure_s is not None and f.static is not None]
    if len({f.exposure_s for f in darks}) < 2 or not far.any():
        return None
    seconds = np.array([f.exposure_s for f in darks], float)[:, None]
    sigma = np.stack([f.sigma[far] / np.sqrt(f.frames) for f in darks]).astype(np.float64)
    level = np.stack([f.static[far] for f in darks if f.static is not None]) * sigma
    weight = np.stack([f.usable[far] for f in darks]) / (sigma**2 + (_LINEAR * level) ** 2)

    def left(response: Float[np.ndarray, "r 1"]) -> Float[np.ndarray, "n"]:
        told = np.sum(weight * level * response, 0) ** 2
        return np.sum(weight * level**2, 0) - told / np.maximum(np.sum(weight * response**2, 0), 1e-30)

    return float(median(left(np.ones_like(seconds)) - left(seconds)))


class Heat(NamedTuple):
    """Law of the heat of a pixel: exponential of this mean, DN or ('exposure') DN per second, in a share of
    the pixels, none in the others. core: law of the levels of those others, in units of the noise, where
    every pixel has a level of its own."""

    share: float
    mean: float
    scaling: str
    core: Core = Core()

    @property
    def beside_map(self) -> bool:
        """Whether the other pixels have levels far beyond the noise too, a pattern that is found after."""
        return self.core != Core()


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
    a normal one cut off at zero. Beside a map a pixel is either hot or one of the map: how the others scatter
    says whether it is hot, and of how hot it is only its own noise."""
    sums = above_neighbours(fields, heat.scaling)
    if sums is None:
        return None
    core = heat.core
    root = np.sqrt(sums.information) / core.spread
    seen = root > 0
    safe = np.where(seen, root, 1.0)
    u, mean = core.standard(sums.score / safe / core.spread), heat.mean * safe
    ratio = np.where(seen, core.log_ratio(u, mean), 0.0)
    log_odds = np.log(max(heat.share, 1e-12)) - np.log1p(-min(heat.share, MOST_SHARE)) + ratio
    noise = safe * core.spread
    centre = np.where(seen, u * core.spread, 0.0) - 1 / (heat.mean * noise)
    # Mean of a standard normal above -centre: the inverse of Mills' ratio.
    shape = np.exp(stats.norm.logpdf(centre) - stats.norm.logcdf(centre))
    chance = np.where(seen, special.expit(log_odds), 0.0)
    return Known(np.round(chance) if heat.beside_map else chance, centre, shape, 1 / noise)
