"""Strength of effects in a few pixels at unknown places, by simulation of the likelihood ratio itself.

The test knows the share of affected pixels and the exponential law of their heights, not where they are.
Its statistic is a sum over pixels of log((1 - f) + f E_h[L(data | h) / L(data | 0)]); the shift is the change
of its mean over its null standard deviation. It is no power of the amplitude: weak pixels hardly count.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np

HOT_FRACTION = 5e-4
TELEGRAPH_FRACTION = 0.01
_NODES = np.geomspace(0.05, 14, 22)
"""Heights in units of their mean; trapezoid in log height, exponential density."""
_GRID = np.geomspace(0.1, 10, 20)
"""Mean heights, in units of what one pixel's data resolve, at which the shift is simulated."""


@dataclass(frozen=True)
class Tabulated:
    """A shift known at some amplitudes, interpolated in logs."""

    amplitudes: np.ndarray
    shifts: np.ndarray

    def shift(self, amplitude: float) -> float:
        """Shift at an amplitude, null standard deviations."""
        return float(np.exp(np.interp(np.log(amplitude), np.log(self.amplitudes), np.log(self.shifts))))

    def amplitude_at(self, multiple: float) -> float:
        """Amplitude whose shift is five times `multiple`; infinite where no simulated one reaches it."""
        if self.shifts[-1] < 5 * multiple:
            return float("inf")
        return float(np.exp(np.interp(np.log(5 * multiple), np.log(self.shifts), np.log(self.amplitudes))))


def _weights() -> np.ndarray:
    density = np.exp(-_NODES) * _NODES
    step = np.gradient(np.log(_NODES))
    return density * step / np.sum(density * step)


def _table(per_pixel: Callable[[float], tuple[float, float]], pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean heights and shifts, made to grow: (change of mean, null sd) of one pixel's log ratio -> shift."""
    found = [per_pixel(height) for height in _GRID]
    shifts = np.array([np.sqrt(pixels) * change / sd for change, sd in found])
    return _GRID, np.maximum.accumulate(np.maximum(shifts, 1e-6)) * (1 + 1e-9 * np.arange(_GRID.size))


@lru_cache(maxsize=4)
def _hot_table(pixels: int) -> tuple[np.ndarray, np.ndarray]:
    z = np.linspace(-7, 90, 4000)
    null = np.exp(-0.5 * z**2)
    null /= null.sum()

    def per_pixel(height: float) -> tuple[float, float]:
        h = height * _NODES
        log = np.log1p(-HOT_FRACTION), np.log(HOT_FRACTION * _weights()) + z[:, None] * h - 0.5 * h**2
        ratio = np.logaddexp(log[0], np.logaddexp.reduce(log[1], axis=1))
        hit = np.exp(-0.5 * (z[:, None] - h) ** 2) @ _weights()
        hit /= hit.sum()
        mean = float(null @ ratio)
        return HOT_FRACTION * float((hit - null) @ ratio), float(np.sqrt(null @ (ratio - mean) ** 2))

    return _table(per_pixel, pixels)


def hot(information: float, pixels: int) -> Tabulated:
    """Pixels that are brighter in every frame; amplitude: rms over all pixels, DN.

    information: of one pixel about its height at the longest exposure, all frames together, 1/DN^2.
    """
    heights, shifts = _hot_table(pixels)
    return Tabulated(heights * np.sqrt(2 * HOT_FRACTION / information), shifts)


@cache
def _telegraph_table(frames: int, pixels: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    number, weights = 100, _weights()
    # As many draws of every height, four times as many of none: rare high jumps decide, and drawn as often as
    # they occur they would make the table scatter by a quarter.
    kinds = np.repeat(np.arange(_NODES.size + 1), [4 * number] + [number] * _NODES.size)
    noise = rng.standard_normal((kinds.size, frames))
    jumps = rng.choice((-1, 0, 0, 1), noise.shape) * np.insert(_NODES, 0, 0.0)[kinds][:, None]
    share = np.bincount(kinds) / kinds.size
    f = TELEGRAPH_FRACTION

    def per_pixel(height: float) -> tuple[float, float]:
        z = noise + height * jumps
        logs = [np.zeros(kinds.size)]
        for h in height * _NODES:
            bumps = np.logaddexp(0, np.logaddexp(-h * (h / 2 - z), -h * (h / 2 + z)) - np.log(2))
            logs.append((bumps - np.log(2)).sum(1))
        pooled = np.logaddexp.reduce([np.log(p) + log for p, log in zip(share, logs, strict=True)])
        hit = np.logaddexp.reduce([np.log(w) + log for w, log in zip(weights, logs[1:], strict=True)])
        ratio = np.logaddexp(np.log1p(-f), np.log(f) + hit)
        # Weights turn the pool into either kind, tails included.
        quiet, loud = np.exp(-pooled), np.exp(hit - pooled)
        quiet, loud = quiet / quiet.sum(), loud / loud.sum()
        excess = (z**2).sum(1) - frames
        mean = quiet @ ratio
        # The read noise is refitted: what follows the mean variance is projected off.
        slope = quiet @ ((ratio - mean) * excess) / (2 * frames)
        rest = ratio - mean - slope * excess
        return float(f * ((loud - quiet) @ rest)), float(np.sqrt(quiet @ rest**2))

    return _table(per_pixel, pixels)


def telegraph(variance: float, frames: int, pixels: int) -> Tabulated:
    """Pixels that jump by a height up, down or not at all; amplitude: rms over pixels and frames, DN.

    variance: of a quiet pixel in a dark frame, DN^2; frames: how many such frames all recordings are worth.
    """
    heights, shifts = _telegraph_table(frames, pixels)
    return Tabulated(heights * np.sqrt(TELEGRAPH_FRACTION * variance), shifts)
