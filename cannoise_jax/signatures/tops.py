"""Pixels that stand out of a recording, and what lies on one side of each more than on the other."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from cannoise_jax.physics.robust import robust_std
from cannoise_jax.signatures.fields import Fields, each_frame
from cannoise_jax.signatures.remembered import remembered

REACH = 10
"""Pixels behind, and before, that are looked at."""
_FAR = 7.0
"""Standard deviations of noise and pattern from which on a pixel stands out."""
_AROUND = (4, 2)
"""Pixels along and across within which none stands out farther."""
_BROAD, _LONG = 0.25, 0.5
"""Of its height, what pixels next to one that stands out have at most, across the tail and along it: tracks
and areas have no profile."""
_BESIDE = (-4, -3, 3, 4)
"""Lines whose difference of both sides is what a slope of the level makes of it."""
NOISE = 2 + 2 / len(_BESIDE)
"""Variance of such a difference, in that of a pixel."""
_MOST = 20_000
"""Pixels of a recording that are looked at, those that stand out the farthest."""


class Tops(NamedTuple):
    """Pixels of one recording that stand out: place `[n]` (pixel in reading order), sum of products of their
    height with the differences at every distance `[n, k]`, and of their squared heights `[n]`."""

    place: Int[np.ndarray, "n"]
    products: Float[np.ndarray, "n k"]
    power: Float[np.ndarray, "n"]


def standing(f: Fields, axis: int) -> Tops:
    """The pixels that stand out of the mean of the frames, and of single frames."""
    images = [] if f.static is None else [(f.static, max(_local_spread(f), 1.0))]
    if f.frames > 2:
        images += [(frame, 1.0) for frame in each_frame(f, static=False)]
    found = [_of_image(f, image, spread, axis) for image, spread in images]
    return Tops(*(np.concatenate(part) for part in zip(*found, strict=True))) if found else _no_tops()


def _local_spread(f: Fields) -> float:
    """Standard deviation of the mean of most pixels, of what those a few lines away do not share."""
    assert f.static is not None
    by = _BESIDE[-1]
    apart = (f.static[by:] - f.static[:-by], f.static[:, by:] - f.static[:, :-by])
    both = (f.usable[by:] & f.usable[:-by], f.usable[:, by:] & f.usable[:, :-by])
    return min((robust_std(d[u]) / 2**0.5 for d, u in zip(apart, both, strict=True) if u.any()), default=1.0)


def _no_tops() -> Tops:
    return Tops(np.zeros(0, int), np.zeros((0, REACH)), np.zeros(0))


def _of_image(f: Fields, image: Float[np.ndarray, "h w"], spread: float, axis: int) -> Tops:
    size = image.shape
    v, sigma = image * f.usable, f.sigma
    if axis:
        v, sigma = v.T, sigma.T
    height, width = v.shape
    y, x = np.nonzero(np.abs(v) > _FAR * spread)
    along, across = _AROUND
    inside = (y >= REACH) & (y < height - REACH) & (x >= _BESIDE[-1]) & (x < width - _BESIDE[-1])
    y, x = y[inside], x[inside]
    if y.size > _MOST:
        most = np.argsort(-np.abs(v[y, x]), kind="stable")[:_MOST]
        y, x = y[most], x[most]
    if not y.size:
        return _no_tops()
    top = np.abs(v[y, x])
    beside, ends = (np.array([[-1], [1]]) * step for step in ((0, 1), (1, 0)))
    broad = np.abs(v[y[:, None] + beside[:, 0], x[:, None] + beside[:, 1]]).max(1) > _BROAD * top
    broad |= np.abs(v[y[:, None] + ends[:, 0], x[:, None] + ends[:, 1]]).max(1) > _LONG * top
    highest = ~broad
    for dy in range(-along, along + 1):
        for dx in range(-across, across + 1):
            highest &= np.abs(v[y + dy, x + dx]) <= top
    y, x = y[highest], x[highest]
    k, unit = np.arange(1, REACH + 1), sigma[y, x][:, None]

    def one_sided(aside: int) -> np.ndarray:
        behind, before = (y[:, None] + k, (x + aside)[:, None]), (y[:, None] - k, (x + aside)[:, None])
        return (v[behind] * sigma[behind] - v[before] * sigma[before]) / unit

    apart = one_sided(0) - sum(one_sided(n) for n in _BESIDE) / len(_BESIDE)
    top = v[y, x] / spread
    place = x * size[1] + y if axis else y * size[1] + x
    return Tops(place, top[:, None] * apart / spread, top**2)


_reads = remembered("static", "contrasts", "usable", "sigma")
TOPS = (_reads(partial(standing, axis=0)), _reads(partial(standing, axis=1)))
