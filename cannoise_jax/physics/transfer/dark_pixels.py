"""How the charge of the pixels of a dark is distributed: ordinary ones, and hot ones beside them.

Each ordinary pixel has a dark current of its own, the sum of many small leaks, and over the pixels these are
about log-normal (Konnik and Welsh, High-level numerical simulations of noise in CCD and CMOS photosensors,
arXiv:1412.4031, section II.B). With noise beside it: z = ln(1 + s (x - m) / b) / s is standard normal, m the
median, b the width there, s the shape; s = 0 is the normal law, for darks that show no currents of their own.
A log-normal law is of the currents alone: what noise adds is known, and is no part of their tail.
Pixels that lie far below the median have another cause, which is taken to reach as far above it: a Laplace
tail. Hot pixels stand beside all these, with exponential heights.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import interpolate, optimize, special, stats

from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.blurred import blur, spaced

FAR = 6.0
"""Spreads, of a normal law or of the logarithm of a log-normal one, beyond which a pixel is not ordinary."""
_FEW = 10
"""Pixels from which a part of a law is fitted."""
_LEAST_NATS = 12.0
"""Log likelihood that a part of a law has to gain: ln n of a frame of a tenth of a megapixel."""
MOST_HOT = 0.5
"""Share of hot pixels, the largest: of more of them the others would be cold."""
_STAND_OUT = 0.25
"""Of the hot pixels of a law, how many have to be more likely hot than ordinary: of real ones half and more
are, of the tail of ordinary pixels, where it is no quite log-normal one, a twentieth to a tenth."""
_STRAY = 1e-6
"""Share of pixels that may be anywhere, so that one that is dead decides nothing."""
_CELL = 32
"""Pixels along a side whose median is the level about which pixels differ: a glow is even over them."""
_FLAT = 1e12
"""Ratio of curvatures beyond which a likelihood is flat along a parameter."""


class PixelLaw(NamedTuple):
    """Charge of pixels, in the unit of what it was fitted to.

    middle, scale, shape: m, b, s of ordinary pixels. noise, shot: what a log-normal one is seen with, its
    standard deviation at the middle and by how much its variance grows per unit (`blurred`). share, reach: of
    Laplace tails on either side. fraction, height: share of hot pixels, 0 where none stand out, and the mean
    of their heights. nats: log likelihood that these gain. errors: standard errors of logit fraction and log
    height; None where they are not told.
    """

    middle: float
    scale: float
    shape: float = 0.0
    share: float = 0.0
    reach: float = 1.0
    fraction: float = 0.0
    height: float = 1.0
    nats: float = 0.0
    errors: tuple[float, float] | None = None
    noise: float = 0.0
    shot: float = 0.0

    @property
    def variance(self) -> float:
        """Of ordinary pixels, tails left out."""
        if not self.shape:
            return self.scale**2
        grown = np.exp(self.shape**2)
        return float((self.scale / self.shape) ** 2 * grown * (grown - 1))

    @property
    def mean(self) -> float:
        """Of ordinary pixels."""
        if not self.shape:
            return self.middle
        return self.middle + float(self.scale / self.shape * np.expm1(self.shape**2 / 2))

    @property
    def width(self) -> float:
        """Standard deviation in the middle, noise included."""
        return float(np.hypot(self.scale, self.noise)) if self.shape else self.scale

    def core(self, x: np.ndarray) -> np.ndarray:
        """Density of ordinary pixels without tails, as a log-normal law has it without noise."""
        beyond = (x - self.middle) / self.scale
        if not self.shape:
            return np.exp(-0.5 * np.minimum(beyond**2, 700)) / np.sqrt(2 * np.pi) / self.scale
        stretched = 1 + self.shape * beyond
        inside = np.maximum(stretched, 1e-12)
        return stats.norm.pdf(np.log(inside) / self.shape) / inside * (stretched > 0) / self.scale

    def masses(self, edges: np.ndarray) -> np.ndarray:
        """Share of a log-normal law in each cell between edges."""
        stretched = 1 + self.shape * (edges - self.middle) / self.scale
        below = special.ndtr(np.log(np.maximum(stretched, 1e-300)) / self.shape)
        return np.diff(np.where(stretched > 0, below, 0.0))

    def ordinary(self, x: np.ndarray, blurred: np.ndarray | None = None) -> np.ndarray:
        """Density of ordinary pixels. blurred: that of the core at x, with its noise, where it is known."""
        if blurred is None:
            blurred = self._seen(x) if self.shape and self.noise else self.core(x)
        tails = np.exp(-np.minimum(np.abs(x - self.middle) / self.reach, 700)) / (2 * self.reach)
        return (1 - self.share) * blurred + self.share * tails

    def _seen(self, x: np.ndarray) -> np.ndarray:
        """Density of the core with its noise."""
        ends = float(np.min(x)) - self.width, float(np.max(x)) + self.width
        edges = spaced(*ends, self.middle, self.width)
        seen = blur(edges, edges, self.middle, self.noise, self.shot) @ self.masses(edges)
        return np.exp(np.interp(x, edges, np.log(np.maximum(seen, 1e-300))))

    def hot(self, x: np.ndarray) -> np.ndarray:
        """Density of hot pixels."""
        return 0.5 / self.height * exponential_tail(x - self.middle, self.width, self.height)

    def far_above(self, x: np.ndarray) -> Bool[np.ndarray, "..."]:
        """Whether a pixel lies beyond all ordinary ones: of few hot pixels no law is told."""
        beyond = np.expm1(self.shape * FAR) / self.shape if self.shape else FAR
        return x > self.middle + np.hypot(self.scale * beyond, FAR * self.noise * bool(self.shape))

    def is_hot(self, x: np.ndarray) -> Bool[np.ndarray, "..."]:
        """Whether a pixel is more likely hot than ordinary, or further out than such: far beyond all that was
        fitted a log-normal tail lies above an exponential one."""
        if not self.fraction:
            return np.zeros(np.shape(x), bool)
        more = self.fraction * self.hot(x) > (1 - self.fraction) * self.ordinary(x)
        more &= x > self.middle
        return x >= np.min(x, where=more, initial=np.inf)


def law_of(
    values: Float[np.ndarray, "n"], *, noise: float = 0.0, shot: float = 0.0, least: float = 0.0,
    full: int = 0, ceiling: float = 0.0,
) -> PixelLaw:  # fmt: skip
    """The law of most likelihood; the parts that do not gain enough are left out.

    noise, shot: standard deviation of the noise of a value at the median, and by how much its variance grows
    per unit. least: of the scale, where values stand on a lattice. full: pixels that are hot, of which only
    is known that they hold more than `ceiling`.
    """
    low, middle, high = np.percentile(values, (25, 50, 75))
    start = PixelLaw(float(middle), max(float(high - low) / 1.349, least, 1e-9))
    noise = min(noise, start.scale)
    share, reach = _tails(values - start.middle, start.scale)
    start = start._replace(share=share, reach=reach)
    at, counts, edges = _histogram(values, start)
    span = float(at[-1] - at[0])
    seen = blur(at, edges, start.middle, noise, shot) if noise else None
    # Lower ones are ordinary, higher ones beyond all that was seen.
    heights = np.log([0.1 * start.scale, 100 * max(span, ceiling)])

    def fitted(skewed: bool, hot: bool) -> _Fit:
        def law(p: np.ndarray) -> PixelLaw:
            scale = start.scale * float(np.exp(np.clip(p[1], -4.0, 4.0)))
            found = start._replace(middle=float(p[0]) * start.scale, scale=max(scale, least))
            if skewed:
                shape = float(np.exp(np.clip(p[2], -8.0, 2.0)))
                found = found._replace(shape=shape, noise=noise, shot=shot)
            if hot:
                share = MOST_HOT * float(special.expit(p[-2]))
                height = float(np.exp(np.clip(p[-1], *heights)))
                found = found._replace(fraction=share, height=height)
            return found

        def negative(p: np.ndarray) -> float:
            now = law(p)
            blurred = seen @ now.masses(edges) if skewed and seen is not None else now.core(at)
            density = (1 - now.fraction) * now.ordinary(at, blurred)
            full_nats = 0.0
            if hot:
                density = density + now.fraction * now.hot(at)
                full_nats = full * (np.log(now.fraction + 1e-300) - ceiling / now.height)
            return -float(np.sum(counts * np.log(density + _STRAY / span))) - full_nats

        own = np.sqrt(max(1 - (noise / start.scale) ** 2, 0.05)) if skewed else 1.0
        first = [start.middle / start.scale, np.log(own)]
        first += [np.log(min(_shape(values) / own, 2.0))] if skewed else []
        far = values[values > start.middle + FAR * start.scale] - start.middle
        share = (far.size + full) / (values.size + full)
        height = np.log(np.mean(np.r_[far, np.full(full, max(ceiling, start.scale)), 3 * start.scale]))
        first += [special.logit(np.clip(share, 1e-5, 0.2) / MOST_HOT), height] if hot else []
        options = {"xatol": 1e-4, "fatol": 1e-3, "maxiter": 4000, "maxfev": 6000}
        found = optimize.minimize(negative, np.array(first), method="Nelder-Mead", options=options)
        return _Fit(float(found.fun), law(found.x), negative, found.x)

    def better(normal: _Fit, skewed: _Fit) -> _Fit:
        return skewed if skewed.negative < normal.negative - _LEAST_NATS else normal

    # Hot pixels are what no law of ordinary ones explains, of either kind.
    bare, beside = (better(fitted(False, hot), fitted(True, hot)) for hot in (False, True))
    law = beside.law._replace(nats=np.inf if full else bare.negative - beside.negative)
    number = full + int(np.sum(counts[law.is_hot(at)]))
    # Of full pixels a law without hot ones has no place, so that these always count.
    told = number >= max(_FEW, _STAND_OUT * law.fraction * (full + values.size))
    if not full and (law.nats <= _LEAST_NATS or not told):
        return bare.law
    steps = np.full(len(beside.at), 0.05)
    steps[0] = 0.05 * law.scale / start.scale
    errors = fit_errors(hessian(beside.function, beside.at, steps))
    if errors is None and not full:
        return bare.law
    return law._replace(errors=None if errors is None else (float(errors[-2]), float(errors[-1])))


class _Fit(NamedTuple):
    """A law, minus the log likelihood that it has and as a function of parameters, and these."""

    negative: float
    law: PixelLaw
    function: Callable[[np.ndarray], float]
    at: np.ndarray


def above_level(charge: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Charge beyond that of an even light or glow: the medians of cells, and smooth between them. The mean
    level stays."""
    height, width = charge.shape
    down, across = max(height // _CELL, 1), max(width // _CELL, 1)
    if min(down, across) < 2:
        return charge
    rows = np.array_split(np.arange(height), down)
    columns = np.array_split(np.arange(width), across)
    levels = np.array([[median(charge[np.ix_(r, c)]) for c in columns] for r in rows])
    centres = tuple(np.array([part.mean() for part in parts]) for parts in (rows, columns))
    between = interpolate.RegularGridInterpolator(centres, levels, bounds_error=False, fill_value=None)
    smooth = np.stack([between((y, np.arange(width))) for y in range(height)])
    return charge - smooth + float(median(levels))


def _shape(values: np.ndarray) -> float:
    """Of a log-normal law, from three quantiles; at least a small one."""
    low, middle, high = np.percentile(values, (10, 50, 90))
    ratio = (high - middle) / max(middle - low, 1e-9 * max(abs(middle), 1.0))
    return float(np.clip(np.log(max(ratio, 1e-9)) / stats.norm.isf(0.1), 0.02, 2.0))


def _tails(beyond: np.ndarray, sigma: float) -> tuple[float, float]:
    """Share and reach of Laplace tails, from the pixels far below the median; fewer than ten, whose law is
    unknown, count as none."""
    below = -beyond[beyond < -FAR * sigma]
    if below.size < _FEW:
        return 0.0, 1.0
    reach = float(np.mean(below)) - FAR * sigma
    share = 2 * below.size / beyond.size * np.exp(min(FAR * sigma / reach, 50.0))
    return min(float(share), 0.5), reach


def _histogram(values: np.ndarray, start: PixelLaw) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres of bins that are a twentieth of a width in the middle and of a hundredth of the distance far
    out, how many values lie in each, both of those that hold any, and the edges of all."""
    core, top = 8.0, max(float(np.max(np.abs(values - start.middle))) / start.scale, 9.0) * 1.001
    out = np.geomspace(core, top, max(int(np.log(top / core) / 0.01), 2))[1:]
    edges = start.middle + start.scale * np.r_[-out[::-1], np.linspace(-core, core, 321), out]
    counts = np.histogram(values, edges)[0]
    at = (edges[1:] + edges[:-1]) / 2
    return at[counts > 0], counts[counts > 0], edges


def exponential_tail(x: np.ndarray, sigma: float, mean: float) -> np.ndarray:
    """2 mean times the density of an exponential of a given mean plus a Gaussian, without overflow."""
    argument = (sigma / mean - x / sigma) / np.sqrt(2)
    safe = np.maximum(argument, -25.0)
    bulk = np.exp(-0.5 * np.minimum((x / sigma) ** 2, 1400)) * special.erfcx(safe)
    far = 2 * np.exp(np.minimum(0.5 * (sigma / mean) ** 2 - x / mean, 0.0))
    return np.where(argument > -25.0, bulk, far)


def hessian(
    function: Callable[[np.ndarray], float], at: np.ndarray, step: np.ndarray
) -> Float[np.ndarray, "n n"]:
    """Second derivatives by central differences."""
    count = len(at)
    out = np.empty((count, count))
    unit = np.diag(step)
    for i in range(count):
        for j in range(i, count):
            corners = [
                a * b * function(at + a * unit[i] + b * unit[j]) for a in (1, -1) for b in (1, -1)
            ]  # fmt: skip
            out[i, j] = out[j, i] = sum(corners) / (4 * step[i] * step[j])
    return out


def fit_errors(curvature: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n"] | None:
    """Standard errors of parameters, from the second derivatives of minus the log-likelihood; None where it
    does not depend on one of them."""
    if not np.isfinite(curvature).all() or np.linalg.cond(curvature) > _FLAT:
        return None
    return np.sqrt(np.abs(np.diag(np.linalg.inv(curvature))))
