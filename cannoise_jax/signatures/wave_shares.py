"""What of the power of all frequencies lies in single lines: what is a wave's, and what is about it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage, stats

from cannoise_jax.physics.robust import median

PAD = 2
"""Points of the grid of frequencies for each that a frame resolves."""
_WINDOW = 10 * PAD + 1
"""Points of the padded grid that tell the level about a frequency, a side: some 100 of them independent."""
_OWN = 4 * PAD + 1
"""Points, a side, that a line itself takes."""
_TIP, _NARROW = 2 * PAD + 1, 0.7
"""Points, a side, that hold nearly all of a line, and how much of its power they do at least: of a hill of
noise it is as much as they are of its area, a third."""
_LINES, _NEXT_LINE, _SHARP = 3, 0.3, 10.0
"""Lines that are looked for one after the other, how far another one stands out at least of what is about it,
against the first, and in powers of that: rows that wander slowly have peaks of up to five."""
_COLOURED = 1.5
"""Level from which on noise is taken as coloured: three standard deviations of what white noise shows."""


def of_all(power: Float[np.ndarray, "h w"], at: tuple[int, int], terms: float) -> float:
    """Share of all power beyond that of white noise, at any frequency, that lies in the line at this point
    and in others of its strength. terms: independent powers that each point is the mean of, which say by how
    much less than the mean the median of white noise is."""
    told = power > 0  # what is set to zero is not looked at
    floor = float(median(power[told]) / (stats.gamma.median(terms) / terms))
    beyond = np.where(told, power - floor, 0.0)
    narrow, wide = (float(beyond[_window(power.shape, at, side)].sum()) for side in (_TIP, _OWN))
    if narrow < _NARROW * wide:
        return 0.0  # a hill of noise, and no line
    own, point, first = np.zeros(power.shape, bool), at, power[at]
    for _ in range(_LINES):
        own |= _window(power.shape, point)
        left = np.where(own, 0.0, power)
        y, x = np.unravel_index(int(np.argmax(left)), power.shape)
        point = (int(y), int(x))
        if left[point] < max(_NEXT_LINE * first, _SHARP * floor):
            break
    return float(beyond[own].sum() / max(beyond.sum(), beyond[own].sum(), 1e-30))


def _window(size: tuple[int, int], at: tuple[int, int], side: int = _OWN) -> Bool[np.ndarray, "h w"]:
    """Points of the padded grid that a line takes, `side` of them; along the columns the grid runs on."""
    h, w = size
    rows = np.abs((np.arange(h) - at[0] + h / 2) % h - h / 2) <= side // 2
    return rows[:, None] & (np.abs(np.arange(w) - at[1]) <= side // 2)


def of_lines(power: Float[np.ndarray, "h w"], at: tuple[int, int]) -> float:
    """Share of what whole rows or columns share, beyond white noise, that lies in the line at this point and
    in others that stand out as it does: harmonics of one source come together. 0 where it is no wave of rows
    or columns."""
    h, w = power.shape
    if at[1] > 0.6 * PAD and min(at[0], h - at[0]) > 0.6 * PAD:
        return 0.0
    shared = power[:, 0] if at[1] <= 0.6 * PAD else power[0]
    place, length = (at[0], h) if at[1] <= 0.6 * PAD else (at[1], 2 * (w - 1))
    beyond = np.maximum(shared - 1, 0)
    about, near = (n * ndimage.uniform_filter1d(beyond, n, mode="wrap") for n in (_WINDOW, _OWN))
    sharp = beyond / (1 + np.maximum(about - near, 0) / (_WINDOW - _OWN))
    own = _line(shared.size, place, length)
    for _ in range(_LINES - 1):
        left = np.where(own, 0, sharp)
        other = int(np.argmax(left))
        if left[other] < max(_NEXT_LINE * sharp[place], _SHARP):
            break
        own |= _line(shared.size, other, length)
    return float(beyond[own].sum() / max(beyond.sum(), 1e-30))


def _line(size: int, place: int, length: int) -> Bool[np.ndarray, "n"]:
    """Points of the padded grid that a line and its mirror image take."""
    near = np.arange(size)
    out = np.zeros(size, bool)
    for middle in (place, length - place):
        out |= np.abs((near - middle + length / 2) % length - length / 2) <= 2 * PAD
    return out


def around(power: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Level of the power about every frequency where it is well above that of white noise, else 1: a line
    stands out of what is about it, noise that is stronger at low frequencies does not."""

    # Beyond frequency 0 across, and beyond the highest, lies the other half of the plane: of an image the
    # power at -ky, -kx is that at ky, kx.
    more = min(_WINDOW // 2, power.shape[1] - 1)

    def sums(values: np.ndarray, side: int) -> np.ndarray:
        other = np.roll(values[::-1], 1, 0)
        plane = np.concatenate([other[:, more:0:-1], values, other[:, -2 : -2 - more : -1]], 1)
        whole = side**2 * ndimage.uniform_filter(plane, side, mode=("wrap", "nearest"))
        return whole[:, more : more + values.shape[1]]

    seen = (power > 0).astype(float)
    number = sums(seen, _WINDOW) - sums(seen, _OWN)
    level = (sums(power, _WINDOW) - sums(power, _OWN)) / np.maximum(number, 1.0)
    return np.where(level > _COLOURED, level, 1.0)
