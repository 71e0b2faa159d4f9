"""Effects in a few pixels at unknown places: the amplitude that shifts their likelihood ratio, and the one
that their signature finds.

The likelihood-ratio test knows which share of the pixels is affected and the law of their heights, not where
they are: the sum over pixels of log(1 - f + f L), L the ratio of the densities of a pixel's data with and
without the effect, averaged over the heights. A map of as much rms in every pixel would need several times
the amplitude to be seen: few pixels far out are rarer under the null than many a little out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float
from scipy import optimize, special, stats

from cannoise_jax.physics.robust import median
from cannoise_jax.signatures.rare import (
    EDGES,
    FAR_JUMPS,
    hot_log_p,
    jump_log_ratio,
    level_counts,
    log_mixture,
    log_ratio_of,
    sparse_log_p,
)

HOT_SHARE = 5e-4
"""Share of hot pixels for which the least height is quoted."""
TELEGRAPH_SHARE = 0.01
"""Shares of the pixels within what sensors show: hot 1e-4 to 1e-3, telegraph one in a hundred or more."""
_REACH = (0.05, 40.0)
"""Heights, standard deviations of the noise, among which the least is looked for."""
_DRAWS = 120
"""Draws at each height."""
_CAMERAS = 25
"""Cameras that are drawn, each with hot pixels of its own."""


def hot_amplitude(information: Float[np.ndarray, "h w"], shift: float) -> float:
    """Rms amplitude, DN, of pixels with exponential heights that shifts their likelihood ratio by so many
    null standard deviations.

    information: of every pixel about its height, all frames together, DN^-2.
    """
    seen = information[information > 0]
    if not seen.size:
        return float("inf")
    root = float(np.sqrt(np.mean(seen)))

    def reached(mean: float) -> float:
        u = np.linspace(-9, 25 * max(mean, 1.0), 40000)
        ratio = np.log1p(HOT_SHARE * np.expm1(np.clip(log_ratio_of(u, mean), -700, 600)))
        null = stats.norm.pdf(u)
        hit = null * np.exp(np.clip(log_ratio_of(u, mean), -700, 600))
        null, hit = null / null.sum(), hit / hit.sum()
        centre = float(null @ ratio)
        spread = float(np.sqrt(null @ (ratio - centre) ** 2))
        return float(np.sqrt(seen.size) * HOT_SHARE * ((hit - null) @ ratio) / spread)

    mean = _where(reached, shift)
    return mean / root * float(np.sqrt(2 * HOT_SHARE))


def telegraph_amplitude(frames: Sequence[tuple[float, int]], pixels: int, shift: float) -> float:
    """Rms amplitude, DN, over pixels and frames, of pixels that jump up, down or not at all from frame to
    frame, with exponential heights, that shifts their likelihood ratio by so many null standard deviations.

    frames: of every recording 1 / variance of a pixel, DN^-2, and how many frames. The read noise is fitted
    too: what follows the summed square of all pixels alike is taken out.
    """
    best = max((w for w, _ in frames), default=0.0)
    scale = np.concatenate([np.full(n, np.sqrt(w / max(best, 1e-30))) for w, n in frames])
    scale = scale[scale > 0.15]
    if not best > 0 or scale.size < 2:
        return float("inf")
    nodes = np.geomspace(0.04, 14, 24)
    density = nodes * np.exp(-nodes)
    density /= density.sum()
    # Draws of quiet pixels and, as many of each, of every height: the rare high ones decide.
    rng = np.random.default_rng(0)
    height = np.concatenate([np.zeros(4 * _DRAWS), np.repeat(nodes, _DRAWS)])
    noise = rng.standard_normal((height.size, scale.size))
    jumps = rng.choice((-1.0, 0.0, 0.0, 1.0), noise.shape) * height[:, None] * scale
    part = np.append(4.0, np.ones(nodes.size)) / (nodes.size + 4)

    def reached(mean: float) -> float:
        z = noise + mean * jumps
        logs = np.zeros((nodes.size + 1, height.size))  # of the densities over that of a quiet pixel
        for k, node in enumerate(nodes, 1):
            size = mean * node * scale
            up, down = (np.exp(np.minimum(size * (sign * z - 0.5 * size), 600.0)) for sign in (1, -1))
            logs[k] = np.sum(np.log(0.5 + 0.25 * (up + down)), axis=1)
        drawn = special.logsumexp(logs, axis=0, b=part[:, None])
        hit = special.logsumexp(logs[1:], axis=0, b=density[:, None])
        ratio = np.logaddexp(np.log1p(-TELEGRAPH_SHARE), np.log(TELEGRAPH_SHARE) + hit)
        quiet, loud = (w / w.sum() for w in (np.exp(-drawn), np.exp(hit - drawn)))
        squares = np.sum((z**2 - 1) * scale**2, axis=1)
        centred = ratio - quiet @ ratio
        common = float(quiet @ (centred * squares)) / (2 * float(np.sum(scale**4)))
        rest = centred - common * squares
        spread = np.sqrt(float(quiet @ rest**2))
        return float(np.sqrt(pixels) * TELEGRAPH_SHARE * ((loud - quiet) @ rest) / max(spread, 1e-30))

    mean = _where(reached, shift)
    return mean * float(np.sqrt(TELEGRAPH_SHARE / best))


def _where(reached: Callable[[float], float], shift: float) -> float:
    """Mean height, in units of what the data of a pixel resolve, at which a shift is reached; infinite where
    none reaches it."""
    low, high = np.log(_REACH)
    if reached(float(np.exp(high))) < shift:
        return float("inf")
    return float(np.exp(optimize.brentq(lambda m: reached(float(np.exp(m))) - shift, low, high, xtol=2e-3)))


def hot_found(information: Float[np.ndarray, "h w"], log_p: float) -> float:
    """Rms amplitude, DN, of hot pixels of which every other camera falls below this log p of
    their signature."""
    seen = information[information > 0]
    if not seen.size:
        return float("inf")
    quiet = np.diff(stats.norm.cdf(EDGES))
    cameras = []
    for rng in np.random.default_rng(0).spawn(_CAMERAS):
        height = rng.exponential(size=max(rng.binomial(seen.size, HOT_SHARE), 1))
        height /= np.sqrt(np.sum(height**2) / seen.size)
        cameras.append((height, rng.standard_normal(height.size)))

    def typical(amplitude: float) -> float:
        found = []
        for height, noise in cameras:
            counts = (seen.size - height.size) * quiet + level_counts(amplitude * height + noise)
            found.append(hot_log_p(float(log_mixture(counts)), seen.size))
        return float(median(found))

    return _found(typical, log_p) / float(np.sqrt(median(seen)))


def telegraph_found(frames: Sequence[int], sigma: float, pixels: int, log_p: float) -> float:
    """Rms amplitude, DN, of telegraph pixels of which every other camera falls below this log p of their
    signature. frames: of every dark; sigma: of a quiet pixel in one, DN."""
    n = sum(frames) - len(frames)
    if n < 2:
        return float("inf")
    edges = np.linspace(np.log(1e-3), np.log(1e6), 1201)
    centre = np.exp((edges[1:] + edges[:-1]) / 2)
    ratios = [jump_log_ratio(centre, n, mean) for mean in FAR_JUMPS]
    quiet = np.diff(stats.chi2.cdf(np.exp(edges), n))
    cameras = []
    for rng in np.random.default_rng(0).spawn(_CAMERAS):
        height = rng.exponential(size=max(rng.binomial(pixels, TELEGRAPH_SHARE), 1))
        height /= np.sqrt(np.sum(height**2) / 2 / pixels)
        parts = [(height.size, t) for t in frames]
        jumps = [height[:, None] * rng.choice((-1.0, 0.0, 0.0, 1.0), size) for size in parts]
        cameras.append((jumps, [rng.standard_normal(size) for size in parts]))

    def typical(amplitude: float) -> float:
        found = []
        for jumps, noise in cameras:
            values = [amplitude * j + z for j, z in zip(jumps, noise, strict=True)]
            squares = sum(np.sum((v - v.mean(1, keepdims=True)) ** 2, axis=1) for v in values)
            seen = np.histogram(np.log(squares), edges)[0]
            found.append(sparse_log_p((pixels - len(values[0])) * quiet + seen, ratios))
        return float(median(found))

    return _found(typical, log_p) * sigma


def _found(typical: Callable[[float], float], log_p: float) -> float:
    """Amplitude, in standard deviations of a pixel, whose typical log p is this one; infinite beyond ten."""
    low, high = np.log(1e-3), np.log(10.0)
    if typical(float(np.exp(high))) > log_p:
        return float("inf")
    return float(np.exp(optimize.brentq(lambda a: typical(float(np.exp(a))) - log_p, low, high, xtol=1e-2)))
