"""Spots of light that move over flats, as stars do over those of twilight, found and taken out.

A spot is brighter than the average of the frames in several pixels at once, in single frames. Left in it is
noise that neighbours share, which is taken for crosstalk, and raises the gain, of its rows as well. What
changes over the whole frame is no spot: the light itself moves then, which `smoothed` says.

Every value of a spot is replaced by that of the same pixel in the next frame without one there, at the light
of its row: unlike a mean of frames, that keeps the noise that neighbours share. Where single pixels are
looked at, those that a spot moved over do not count.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage

from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.physics.transfer.hits import read_with
from cannoise_jax.recordings.lazy import LazyArray
from cannoise_jax.recordings.packing import site
from cannoise_jax.recordings.recording import Recording

_SIDE, _AROUND = 5, 31
"""Pixels along a side that are judged together, a star at the sampling of most telescopes, and along that of
what they are held against."""
_FAR, _SKIRT = 6.5, 2.5
"""Robust standard deviations of such means from which one is a spot, of a megapixel one in 10^4 frames by
chance, and down to which the places beside it belong to it."""
_SINGLE = 4.0
"""Standard deviations of its noise at which a pixel counts at most: one that jumps is no spot."""
_REACH, _RIM = 16, 2
"""Pixels that a spot may reach from where it is found, and about it that its wings are taken out."""
_FEWEST = 3
"""Frames that tell what stays from what moves."""
_MOST, _MOST_OF_ONE = 0.3, 0.1
"""Share of the pixels that spots move over at most, and that they cover in one frame: what is more is a
scene."""

_DIM = 0.05
"""Of the light, the least whose noise is told from it: parts without light have more."""


class Spots(NamedTuple):
    """A flat without its spots, and the pixels that one moves over."""

    recording: Recording
    pixels: Bool[np.ndarray, "H W"]


def without_spots(
    recording: Recording, steady: Iterable[Float[np.ndarray, "H W"]], mean: Float[np.ndarray, "H W"],
    variance: Float[np.ndarray, "H W"],
) -> Spots | None:  # fmt: skip
    """None where no spot moves. steady: the frames at one level of light, above black; mean, variance: of
    every pixel over them."""
    if recording.count < _FEWEST or min(mean.shape) < _AROUND:
        return None
    noise = np.empty(mean.shape)
    for c in range(4):  # the variance of a flat is in proportion to its light
        signal = np.maximum(site(mean, c), max(_DIM * float(median(site(mean, c))), 1e-9))
        site(noise, c)[...] = np.sqrt(median(site(variance, c) / signal) * signal)
    noise = np.maximum(noise, 1e-9)
    found = ((t, np.flatnonzero(_spots((frame - mean) / noise))) for t, frame in enumerate(steady))
    taken = {t: spots for t, spots in found if spots.size}  # places, as masks of many frames are large
    pixels = np.zeros(mean.shape, bool)
    for spots in taken.values():
        pixels.ravel()[spots] = True
    if not taken or pixels.mean() > _MOST or max(s.size for s in taken.values()) > _MOST_OF_ONE * mean.size:
        return None
    places = {t: (spots, _calm(recording, t, taken)) for t, spots in taken.items()}
    frames = LazyArray(
        partial(read_with, recording.frames, places), tuple(recording.frames.shape), np.dtype(np.uint16)
    )
    return Spots(dataclasses.replace(recording, frames=frames), pixels)


def _spots(rest: Float[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Where spots are in one frame. rest: in units of the noise, less the average of the frames, which is
    brighter where there are spots in others."""
    rest = np.clip(rest, -_SINGLE, _SINGLE)
    rest = rest - ndimage.uniform_filter(rest, _AROUND)
    # Of fewer pixels along the edges a mean has more noise, of mirrored ones more still.
    means = ndimage.uniform_filter(rest, _SIDE, mode="constant")
    means = means / np.sqrt(ndimage.uniform_filter(np.ones(rest.shape), _SIDE, mode="constant"))
    means = means / max(robust_std(means), 1e-9)
    seeds, whole = means > _FAR, np.ones((3, 3))
    if not seeds.any():
        return seeds
    near = ndimage.binary_dilation(seeds, whole, _REACH, mask=(means > _SKIRT) | seeds)
    return ndimage.binary_dilation(near, whole, _RIM)


def _calm(recording: Recording, number: int, taken: dict[int, np.ndarray]) -> np.ndarray:
    """The values to put where the spots of a frame are, along rows."""
    black = recording.black_map()
    own = np.asarray(recording.frames[number], np.float64) - black
    here = _mask(taken[number], own.shape)
    left, out = here.copy(), own.copy()
    for more in range(1, recording.count):
        after = (number + more) % recording.count
        other = np.asarray(recording.frames[after], np.float64) - black
        there = _mask(taken.get(after, _NOWHERE), own.shape)
        now = left & ~there
        out[now] = (other * _of_rows(own, other, here | there))[now]
        left &= ~now
        if not left.any():
            break
    values = np.rint(out + black)
    return np.clip(values, 0, 65535).ravel()[taken[number]].astype(np.uint16)


_NOWHERE = np.zeros(0, np.int64)


def _mask(places: Int[np.ndarray, "n"], size: tuple[int, ...]) -> Bool[np.ndarray, "H W"]:
    out = np.zeros(size, bool)
    out.ravel()[places] = True
    return out


def _of_rows(
    own: Float[np.ndarray, "H W"], other: Float[np.ndarray, "H W"], odd: Bool[np.ndarray, "H W"]
) -> Float[np.ndarray, "H W"]:
    """By what factor rows of one frame are brighter than those of another outside odd pixels, by columns of
    either parity."""
    ratio = np.ones(own.shape)
    for parity in (0, 1):
        quotient = own[:, parity::2] / np.maximum(other[:, parity::2], 1e-9)
        middle = np.ma.median(np.ma.masked_array(quotient, odd[:, parity::2]), axis=1)
        ratio[:, parity::2] = middle.filled(1.0)[:, None]
    return ratio
