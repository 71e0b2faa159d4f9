"""Where a plane wave runs, and at which frequency: more closely than it was found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.core.places import Site

_STEPS, _AROUND = (0.1, 0.02), 5
"""Periods in the frame by which a frequency is refined, one after the other, and how many steps to either
side."""


def refined(fields: Sequence[Float[np.ndarray, "n h w"]], near: tuple[float, float]) -> tuple[float, float]:
    """The frequency (fy, fx) of the most power of all fields, weighed by their noise, within a step of the
    grid on which it was found: a wave that is drawn a quarter of a period off over the frame is none that was
    recorded."""
    h, w = fields[0].shape[1:]
    fy, fx = near
    for step in _STEPS:
        y, x = (f + step / n * np.arange(-_AROUND, _AROUND + 1) for f, n in ((fy, h), (fx, w)))
        down, across = (
            np.exp(-2j * np.pi * np.outer(f, np.arange(n))).astype(np.complex64) for f, n in ((y, h), (x, w))
        )
        power = np.zeros((y.size, x.size))
        for v in (v for values in fields for v in values):
            power += np.abs(down @ v @ across.T) ** 2
        i, j = np.unravel_index(int(np.argmax(power)), power.shape)
        fy, fx = float(y[i]), float(x[j])
    return fy, fx


def raster_frequency(fy: float, fx: float, width: int) -> float:
    """Cycles per pixel of the scan whose aliases are the plane wave (fy, fx): f = fx + n / width nearest to
    fy."""
    turns = np.round(fx * width - fy)
    f = abs((turns + fy) / width)
    return float(min(f, 1 - f) if f <= 1 else f % 0.5)


def carrier(fy: float, fx: float, size: tuple[int, int]) -> tuple[Site, float]:
    """What carries a plane wave, and its cycles per step there: the scan, whose waves run on from the end of
    a row to the start of the next, or lines, where it is nearer to one that does not change along them."""
    h, w = size
    run_on = abs(fx * w - fy - np.round(fx * w - fy))
    along, over, cycles = min((abs(fx) * w, "row", abs(fy)), (abs(fy) * h, "column", abs(fx)))
    if along < run_on / 2:
        return ("row" if over == "row" else "column"), float(min(cycles, 1 - cycles))
    return "raster", raster_frequency(fy, fx, w)
