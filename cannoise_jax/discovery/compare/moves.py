"""How single pixels and whole lines move from frame to frame: the law of single jumps, whether two levels are
enough for an unsteady pixel, what a line has of the frame before, and how unlike lines are in noise."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

from cannoise_jax.discovery.frames.draws import within_codes
from cannoise_jax.physics.robust import median
from cannoise_jax.signatures import bank
from cannoise_jax.signatures.fields import helmert

FINE = 0.25
"""Steps of the codes, in standard deviations, from which on the place of a limit between two of them counts:
of a normal law 2.5 standard deviations out, a limit that moves by half a step moves counts by a third."""
JUMPS = (2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0)
"""Standard deviations from which values that lie off alone are counted, up to the next: half of one where
noise has its tails, doubled twice an octave beyond."""
SINGLE = 6.0
"""From which on such a value is an outlier."""
LEVEL_CHANCES = (0.5, 0.1, 1e-2, 1e-4)
"""Chances of what an unsteady pixel leaves beside its two levels, between which pixels are counted."""
_FEWEST = 5
"""Frames from which on more than two levels can be seen."""
LINE_LAGS = (-1, 0, 1)
"""Rows, or columns, from a line to that of the frame after whose product is taken."""


def values_of(z: Float[np.ndarray, "n ..."], frame: int) -> Float[np.ndarray, "..."]:
    """One frame, off the mean of all, from their contrasts: of unit variance."""
    frames = len(z) + 1
    factor = np.float32(np.sqrt(frames / (frames - 1)))
    return np.tensordot(helmert(frames)[:, frame].astype(np.float32), z, 1) * factor


def lone_values(
    z: Float[np.ndarray, "n h w"],
    scale: Float[np.ndarray, "h w"],
    usable: Bool[np.ndarray, "h w"],
    grain: Float[np.ndarray, "h w"] | None = None,
) -> tuple[Bool[np.ndarray, "h w"], Float[np.ndarray, "t k"]]:
    """Pixels whose noise is like the others' but for one outlying value, and how many values of every frame
    lie off alone, by how far and to which side: first those below, the nearest first. grain: step of the
    codes, in units of the noise: where it is not `FINE` values are spread over it before they are counted, so
    that no limit lies between two codes; None: not known to be of codes."""
    frames, rng = len(z) + 1, np.random.default_rng(0)
    if frames < 2:
        return np.zeros(z.shape[1:], bool), np.zeros((1, 2 * len(JUMPS)))
    fine = grain is None or not usable.any() or float(median(grain[usable])) <= FINE
    total = np.sum(z**2, 0)
    limit = scale * stats.chi2.isf(1e-3, max(frames - 2, 1))
    found, counts = np.zeros(z.shape[1:], bool), np.zeros((frames, 2 * len(JUMPS)))
    edges = np.array([*JUMPS, np.inf])
    for t in range(frames):
        moved = values_of(z, t)
        if grain is not None and not fine:
            moved = moved + grain * within_codes(moved.shape, rng)
        far = usable & (np.abs(moved) > JUMPS[0] * np.sqrt(scale)) & (total - moved**2 < limit)
        size = moved[far] / np.sqrt(scale[far])
        for side, sign in enumerate((-1, 1)):
            counts[t, side * len(JUMPS) :][: len(JUMPS)] = np.histogram(sign * size, edges)[0]
        found[far] |= np.abs(size) > SINGLE
    return found, counts


def two_levels(z: Float[np.ndarray, "n p"], scale: Float[np.ndarray, "p"]) -> Float[np.ndarray, "k"]:
    """How many unsteady pixels leave how much of their variance beside the two levels that fit them best."""
    frames = len(z) + 1
    if frames < _FEWEST or not z.size:
        return np.zeros(len(LEVEL_CHANCES) + 1)
    values = np.sort(helmert(frames).T @ z, 0)
    low = np.cumsum(values, 0)[:-1]  # they sum to zero, so that the upper ones have minus that
    count = np.arange(1, frames)[:, None]
    between = low**2 / count + low**2 / (frames - count)
    left = (np.sum(values**2, 0) - between.max(0)) / scale
    edges = [-np.inf, *(stats.chi2.isf(p, frames - 2) for p in LEVEL_CHANCES), np.inf]
    return np.histogram(left, edges)[0].astype(float)


def lines_after(
    z: Float[np.ndarray, "n h w"], kept: Bool[np.ndarray, "h w"], pairs: Bool[np.ndarray, "n"] | None = None
) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k"]]:
    """Correlation of the lines of a frame with those of the next at `LINE_LAGS`, rows first, and their
    variance where frames have nothing of each other, whatever the spectrum of the lines is. pairs: of a
    frame and the next that are looked at; None: all."""
    pairs = np.ones(len(z), bool) if pairs is None else pairs
    out, variance = [], []
    for axis in (1, 0):
        weight = np.maximum(kept.sum(axis), 1)
        profiles = np.stack([values_of(z, t).sum(axis) / weight for t in range(len(z) + 1)])
        profiles -= profiles.mean(1, keepdims=True)
        power = np.mean(np.abs(np.fft.fft(profiles, axis=1)) ** 2, 0)
        level = max(float(np.mean(profiles**2)), 1e-12)
        first, second = profiles[:-1][pairs], profiles[1:][pairs]
        side = profiles.shape[1]
        for lag in LINE_LAGS:
            a = first[:, max(-lag, 0) : side - max(lag, 0)]
            b = second[:, max(lag, 0) : side - max(-lag, 0)]
            out.append(float(np.mean(a * b)) / level)
            variance.append(float(np.sum(power**2) / np.sum(power) ** 2) / len(first))
    return np.array(out), np.array(variance)


_FAR = 3.0
"""Standard deviations to which values are brought in: noise of a line is that of most of its pixels."""


def noise_of_lines(
    z: Float[np.ndarray, "n h w"], kept: Bool[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k"]]:
    """Variance, from row to row and from column to column, of the power of their pixels' noise, over the
    square of its mean, beyond what the pixels of a line differ by; and its variance where pixels differ by
    themselves alone. What whole lines share is taken out first."""
    power = np.zeros(kept.shape)
    for contrast in z:
        power += np.minimum(np.abs(bank.without_lines(contrast)), np.float32(_FAR)) ** 2 * kept
    power /= len(z)
    out, variance = [], []
    for axis in (1, 0):
        count = np.maximum(kept.sum(axis), 1)
        own = power.sum(axis) / count
        mean = max(float(own.mean()), 1e-9)
        within = np.sum(power**2, axis) / count - own**2
        chance = max(float(np.mean(within / count)), 1e-12)
        out.append((float(np.var(own, ddof=1)) - chance) / mean**2)
        variance.append(2 * (chance / mean**2) ** 2 / own.size)
    return np.array(out), np.array(variance)
