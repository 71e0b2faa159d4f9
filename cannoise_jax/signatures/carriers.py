"""Where a plane wave runs, and at which frequency: more closely than it was found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.core.places import Site

_STEPS, _AROUND = (0.1, 0.02), 5
"""Periods in the frame by which a frequency is refined, one after the other, and how many steps to either
side."""
_STRAIGHT = 0.1
"""Periods in the frame below which a wave does not change along a line: the weakest that are found have their
frequency to so much."""


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
    return one_way(fy, fx)


def one_way(fy: float, fx: float) -> tuple[float, float]:
    """The same wave in the half of the frequencies that tell all of them apart: fx of 0 to 1/2 and fy of -1/2
    to 1/2, cycles per pixel."""
    fy, fx = (fy + 0.5) % 1 - 0.5, (fx + 0.5) % 1 - 0.5
    return (fy, fx) if fx >= 0 else (-fy, -fx)


def carrier(fy: float, fx: float, size: tuple[int, int]) -> tuple[Site, dict[str, float]]:
    """What carries a plane wave, and its cycles per step there: lines, of a wave that does not change along
    them as far as a frame of this size tells, else the pixels. What runs along the scan is a wave of pixels
    too, whatever the number of those that a row has."""
    h, w = size
    along, over, cycles = min((abs(fx) * w, "row", abs(fy)), (abs(fy) * h, "column", abs(fx)))
    if along < _STRAIGHT:
        return ("row" if over == "row" else "column"), {"frequency": float(min(cycles, 1 - cycles))}
    return "pixel", {"frequency_y": float(fy), "frequency_x": float(fx)}
