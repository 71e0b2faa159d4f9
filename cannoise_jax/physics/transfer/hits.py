"""Particle hits in darks: found, counted, and taken out before anything is measured.

A cosmic ray, or decay in the glass, leaves charge in one to some ten pixels of one frame. Left in, hits are
correlated noise (pink, smoothed), loud pixels and rows, and dark current. A hit pixel is far above what it is
in the other frames, whose noise and whose dark charge say how far it may be; values as far below do not come
from particles, so where such occur too (telegraph pixels, heavy tails) only what exceeds them counts.

Every value of a hit, the rim about it included, is replaced by that of the same pixel in the next frame, with
the difference of the row offsets: unlike a mean of frames, that keeps the noise. Where single pixels are
looked at, those that were hit do not count.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage, stats

from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.recordings.lazy import LazyArray
from cannoise_jax.recordings.metadata import chunks
from cannoise_jax.recordings.packing import site
from cannoise_jax.recordings.recording import DARK, Recording

_CHUNK_BYTES = 1 << 23
"""Of frames that are read at once."""
_FAR = 8.0
"""Standard deviations of a pixel's noise that a hit is above its other values. Of an electron a frame, the
most skewed of dark charge that matters, none lies as far out in 10^8."""
_NEAR = 2.5
"""Standard deviations above which a neighbour of a hit pixel belongs to the hit."""
_REACH = 16
"""Pixels from a hit pixel that its track may reach."""
_HOT, _FEWEST_HOT = 10.0, 20
"""Standard deviations above the level from which a pixel's dark charge is told from its offset, and how many
of such pixels tell its shot noise."""
_SHOT = 4.0
"""Standard deviations that the shot noise of a DN of charge is taken for, as a variance, where nothing tells
it: the gain, DN/e-, of a noise of a quarter of an electron, below what sensors read out with."""
_PRIOR = 8.0
"""Degrees of freedom that the expected noise of a pixel counts for beside its own few frames."""
_DEEPEST, _MIRRORED = 0.98, 1.25
"""Quantile of the depths of values far below, and how often it values far above have to be to be hits."""
_BEYOND_DOUBT = 3.0
"""How often that, where too few values far above show that they have no mirror image."""
_OF_TWO = 5 / 8
"""Of the standard deviations that one pixel has to lie above its others, what each of two neighbours has to
in the same frame: by chance two of 10^6 pixels do in 16 frames once in 10^5 darks."""
_ENOUGH = 6
"""Frames from which the two highest values of a pixel can be spared to tell its noise."""
_BY_CHANCE = 1e-5
"""Chance of as many far above as there are, were those far below as many."""
_OVERLAP = 2.0
"""Pairs of hits, half of the square of their number, and how often a hit overlaps another within four times
its own area."""
_MOST = 0.05
"""Share of a frame that particles hit at most: what is more is another exposure, a ghost or a light."""
_MOST_PIXELS = 0.5
"""Share of the pixels up to which those that were hit in any frame need not count."""
_ROUNDS = 3
"""Pixels hit in several frames show one after the other."""


class Hits(NamedTuple):
    """Particle hits of one recording. charge: DN of each above what its pixels have else. exposure: pixels
    times frames in which they could be seen. pixels: which were hit in any frame; none where they are so many
    that too few would be left to count."""

    charge: Float[np.ndarray, "n"]
    exposure: int
    pixels: Bool[np.ndarray, "H W"]


def without_hits(recording: Recording) -> tuple[Recording, Hits | None]:
    """The recording with the values that particles hit replaced, and the hits; itself, and None, for what is
    no repeated dark."""
    if recording.kind not in DARK or recording.count < 2:
        return recording, None
    exposure = recording.count * int(np.prod(recording.size))
    found, hit = [np.zeros(0)], np.zeros(recording.size, bool)
    patched = recording
    for _ in range(_ROUNDS):
        seen = _seen(patched)
        if seen is None:
            break
        places, charge = seen
        frames = LazyArray(
            partial(read_with, patched.frames, places), tuple(patched.frames.shape), np.dtype(np.uint16)
        )
        patched = dataclasses.replace(patched, frames=frames)
        found.append(charge)
        for pixels, _ in places.values():
            hit.ravel()[pixels] = True
    return patched, Hits(np.concatenate(found), exposure, hit & (hit.mean() < _MOST_PIXELS))


class _Rest(NamedTuple):
    """Of every pixel: the frame in which it is highest (or lowest), by how much, DN, above the mean of its
    other frames, that mean, and the variance of those (0 where they are too few). again: by how much the next
    highest value is, where those others are without it too; else 0."""

    frame: Int[np.ndarray, "H W"]
    away: Float[np.ndarray, "H W"]
    again: Float[np.ndarray, "H W"]
    mean: Float[np.ndarray, "H W"]
    variance: Float[np.ndarray, "H W"]


_Places = dict[int, tuple[np.ndarray, np.ndarray]]
"""By frame: pixels, counted along rows, and the values to put there."""


def _seen(recording: Recording) -> tuple[_Places, Float[np.ndarray, "n"]] | None:
    """Where the recording was hit, with what else to put there, and the charge of every hit, DN."""
    step = _step(recording)
    # One after the other, as frames may be large.
    lowest, highest = _extremes(recording)
    down = lowest()
    below = -down.away / _noise(recording, down, step)
    deep = below[below > _FAR]
    del lowest, down, below
    up = highest()
    noise = _noise(recording, up, step)
    far = _of_particles(up, up.away / noise, up.again / noise, deep)
    shares = np.bincount(up.frame[far], minlength=recording.count) / far.size
    if not shares.any() or shares.max() > _MOST:
        return None
    areas: dict[int, np.ndarray] = {}
    for number in map(int, np.flatnonzero(shares)):
        rest = _frame(recording, number) - up.mean
        areas[number] = _area(rest - median(rest), noise, far & (up.frame == number))
    taken = {number: np.flatnonzero(area) for number, area in areas.items()}
    places: _Places = {}
    charges: list[np.ndarray] = []
    for number, area in areas.items():
        own = _frame(recording, number)
        calm = _calm(recording, number, taken, own, area)
        labels, count = ndimage.label(area, np.ones((3, 3)))
        charges.append(np.asarray(ndimage.sum_labels(own - calm, labels, np.arange(1, count + 1))))
        values = np.clip(own + np.rint((calm - own) / step) * step, 0, 65535)
        places[number] = taken[number], values.ravel()[taken[number]].astype(np.uint16)
    return places, np.concatenate(charges)


def _of_particles(
    up: _Rest, above: np.ndarray, again: np.ndarray, deep: np.ndarray
) -> Bool[np.ndarray, "H W"]:
    """Which pixels were hit, by how many standard deviations the highest value of each lies above its others,
    the next highest too, and how many the lowest of those that lie far below."""
    far = above > _FAR
    # Particles hit the same pixels twice by chance alone; pixels that jump do it again, and as high.
    twice = again > _FAR
    (_, times), (_, number) = ndimage.label(twice, np.ones((3, 3))), ndimage.label(far, np.ones((3, 3)))
    if stats.poisson.sf(times - 1, _OVERLAP * number * float(far.mean())) < _BY_CHANCE:
        deep = np.concatenate([deep, above[twice]])
        far = far & ~twice
    least = max(_MIRRORED * float(np.quantile(deep, _DEEPEST)), _FAR) if len(deep) else _FAR
    if stats.binom.sf(far.sum() - 1, far.sum() + len(deep), 0.5) > _BY_CHANCE:
        least *= _BEYOND_DOUBT
    return (above > least) | _in_pairs(up.frame, above > least * _OF_TWO)


def _in_pairs(frame: Int[np.ndarray, "H W"], high: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """Which of the high pixels have a neighbour that is high in the same frame."""
    where = np.pad(np.where(high, frame, -1), 1, constant_values=-1)
    height, width = high.shape
    beside = np.zeros(high.shape, bool)
    for y, x in ((0, 1), (1, 0), (1, 1), (1, -1)):
        same = (where == np.roll(where, (y, x), (0, 1))) & (where >= 0)
        both = same | np.roll(same, (-y, -x), (0, 1))
        beside |= both[1 : height + 1, 1 : width + 1]
    return beside


def _frame(recording: Recording, number: int) -> Float[np.ndarray, "H W"]:
    return np.asarray(recording.frames[number : number + 1])[0].astype(np.float64)


def _step(recording: Recording) -> float:
    """Spacing of the codes of the first frame, DN."""
    codes = np.unique(np.asarray(recording.frames[:1]))
    return float(np.gcd.reduce(np.diff(codes))) if len(codes) > 1 else 1.0


def _extremes(recording: Recording) -> tuple[Callable[[], _Rest], Callable[[], _Rest]]:
    """The lowest and the highest value of every pixel beside its others, each once it is asked for; frames
    brought to one level."""
    size, count = recording.size, recording.count
    spared = 2 if count >= _ENOUGH else 1  # also the next highest: a pixel may be hit twice
    total, square = np.zeros(size), np.zeros(size)
    most, least = (np.full((spared, *size), sign * np.inf) for sign in (-1, 1))
    highest, lowest = (np.zeros(size, np.int32) for _ in range(2))
    level = float(median(np.asarray(recording.frames[:1])))
    at = 0
    for part in chunks(recording.frames, _CHUNK_BYTES):
        for frame in part:
            values = frame - float(median(frame))
            total += values
            square += values**2
            highest[values > most[0]] = at
            lowest[values < least[0]] = at
            if spared > 1:
                np.maximum(most[1], np.minimum(most[0], values), out=most[1])
                np.minimum(least[1], np.maximum(least[0], values), out=least[1])
            np.maximum(most[0], values, out=most[0])
            np.minimum(least[0], values, out=least[0])
            at += 1
    others = count - spared

    def rest(values: np.ndarray, frame: np.ndarray) -> _Rest:
        mean = (total - values.sum(0)) / others
        squares = square - (values**2).sum(0) - others * mean**2
        again = values[1] - mean if spared > 1 else np.zeros(size)
        return _Rest(frame, values[0] - mean, again, mean + level, np.maximum(squares, 0.0) / others)

    return partial(rest, least, lowest), partial(rest, most, highest)


def _noise(recording: Recording, rest: _Rest, step: float) -> Float[np.ndarray, "H W"]:
    """Standard deviation of the noise of every pixel, DN: that of the bulk and of the shot noise of its own
    dark charge, or what its other frames show."""
    noise = np.empty(recording.size)
    change = _frame(recording, 1) - _frame(recording, 0)
    dof = recording.count - 2.0
    channels = []
    for c in range(4):
        bulk = max(robust_std(site(change, c)) ** 2 / 2, step**2 / 4)
        mean, own = site(rest.mean, c), site(rest.variance, c)
        middle = float(median(own))
        own = own * (bulk / middle if middle > 0 else 1.0)  # the highest are not among them
        # Of a pixel below the level as of one above: telegraph pixels are either, and have to look alike.
        channels.append((bulk, own, np.abs(mean - median(mean))))
    known = [charge > _HOT * np.sqrt(bulk) for bulk, _, charge in channels]
    slopes = [
        (own - bulk)[hot] / charge[hot] for (bulk, own, charge), hot in zip(channels, known, strict=True)
    ]
    for c, (bulk, own, charge) in enumerate(channels):
        expected = bulk + _shot(slopes[c], np.concatenate(slopes), np.sqrt(bulk)) * charge
        used = (_PRIOR * expected + dof * own) / (_PRIOR + dof)
        site(noise, c)[...] = np.sqrt(np.maximum(used, expected))
    return noise


def _shot(own: np.ndarray, every: np.ndarray, sigma: float) -> float:
    """DN of variance for a DN of dark charge, from what the hot pixels of a channel show, else those of all
    channels; where those are too few, so much that none of them passes for hit."""
    for slopes in (own, every):
        if len(slopes) >= _FEWEST_HOT:
            return max(float(median(slopes)), 0.0)
    return _SHOT * sigma


def _area(
    away: Float[np.ndarray, "H W"], noise: Float[np.ndarray, "H W"], seeds: Bool[np.ndarray, "H W"]
) -> Bool[np.ndarray, "H W"]:
    """Pixels of hits: those far above, what joins them and is above as well, and a rim of one pixel, into
    which their charge spreads."""
    whole = np.ones((3, 3))
    reached = ndimage.binary_dilation(seeds, whole, _REACH, mask=(away > _NEAR * noise) | seeds)
    return ndimage.binary_dilation(reached, whole)


def _calm(
    recording: Recording, number: int, taken: dict[int, np.ndarray], own: np.ndarray, area: np.ndarray
) -> Float[np.ndarray, "H W"]:
    """The frame with the next one that was not hit there in place of the area, at the level of its rows."""
    out, left = own.copy(), area.copy()
    for more in range(1, recording.count):
        after = (number + more) % recording.count
        here = left.copy()
        if after in taken:
            here.ravel()[taken[after]] = False
        other = _frame(recording, after)
        out[here] = (other + _row_steps(own, other, area))[here]
        left &= ~here
        if not left.any():
            break
    return out


def _row_steps(own: np.ndarray, other: np.ndarray, area: np.ndarray) -> Float[np.ndarray, "H W"]:
    """By how much rows of one frame lie above those of another outside an area, DN, by columns of either
    parity; hits of the other frame do not count."""
    out = np.empty(own.shape)
    for parity in (0, 1):
        change = np.ma.masked_array((own - other)[:, parity::2], area[:, parity::2])
        out[:, parity::2] = np.ma.median(change, axis=1).filled(0.0)[:, None]
    return out


def read_with(frames: Any, places: _Places, index: Any) -> np.ndarray:
    """Part of the frames with other values in some places."""
    first, *more = index if isinstance(index, tuple) else (index,)
    numbers = np.arange(len(frames))[first]
    out = np.array(frames[first], np.uint16)
    for image, number in zip(out.reshape(-1, *out.shape[-2:]), np.atleast_1d(numbers).tolist(), strict=True):
        if number in places:
            pixels, values = places[number]
            image.reshape(-1)[pixels] = values
    return out[tuple(more)] if numbers.ndim == 0 else out[(slice(None), *more)]
