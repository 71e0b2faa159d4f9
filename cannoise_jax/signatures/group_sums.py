"""Sums over groups of pixels - lines, tiles, sites of a colour - by the noise that their own pixels show."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from cannoise_jax.physics.robust import median
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.signatures.answers import shows, stays, told
from cannoise_jax.signatures.fields import Fields

_FAR = 4.0
"""Distance from which on a pixel stands out, in standard deviations of what most scatter by: normal noise
loses one pixel in 16,000, and 1e-3 of its variance."""
_FEWEST = 16
"""Pixels from which on the median of a group is its own: of fewer one that stands out moves it along."""
_MEDIANS = 4.0
"""Variance of the medians of n values, in units of spread^2 / n, that counts as chance: 1.6 of normal values,
more of skewed ones."""
_MEDIAN_OFF = 0.6745
"""Median distance of a standard normal value from its mean: its quantile of 3/4."""


class LineSums(NamedTuple):
    """Scores U and information I of one template per line: U ~ N(0, I) when nothing is there."""

    score: np.ndarray
    information: np.ndarray


class SharedSums(NamedTuple):
    """Scores and information [groups] of a pattern of groups that stays, the pixels that tell of it `[H, W]`,
    and the variance of pixels beside the groups over the modelled one [groups]."""

    score: np.ndarray
    information: np.ndarray
    kept: np.ndarray
    noise: np.ndarray


class Groups(NamedTuple):
    """Which group every pixel is of `[H, W]`, and which groups are of one kin [g]: those that hold the
    same sites of the mosaic, whose noise is alike."""

    of: Int[np.ndarray, "h w"]
    kin: np.ndarray

    def sums(self, values: np.ndarray) -> Float[np.ndarray, "g"]:
        """Sum of the values of the pixels of every group."""
        return np.bincount(self.of.ravel(), values.ravel(), self.kin.size)


def grouped(of: Int[np.ndarray, "h w"]) -> Groups:
    """The groups of pixels numbered from 0. One that holds some of another's sites alone, as where diagonals
    or tiles end, is of its kin."""
    held = np.zeros(int(of.max()) + 1, np.int64)
    for site, at in enumerate(SITES):
        some = np.zeros(held.size, np.int64)
        some[of[at]] = 1 << site
        held |= some
    kinds = sorted(set(held.tolist()), key=int.bit_count, reverse=True)
    widest = {kind: next(other for other in kinds if kind & ~other == 0) for kind in kinds}
    return Groups(of, np.array([widest[kind] for kind in held.tolist()]))


def area_sums(values: Float[np.ndarray, "*n h w"], side: int) -> Float[np.ndarray, "*n a b"]:
    """Sums over areas of so many pixels a side, those at the far edges smaller."""
    rows, columns = (np.arange(0, n, side) for n in values.shape[-2:])
    return np.add.reduceat(np.add.reduceat(values, rows, -2), columns, -1)


class Pixels(NamedTuple):
    """What the pixels of a group show beside the group's own offset, responses weighing them.

    information, fourth: sums of the response squared and to the fourth [groups]; within [n, groups]: sum of
    the response squared times the residual squared; kin: see `Groups`.
    """

    information: np.ndarray
    fourth: np.ndarray
    within: np.ndarray
    kin: np.ndarray


def _alike(pixels: Pixels) -> list[np.ndarray]:
    """The groups of each kin."""
    return [pixels.kin == number for number in np.unique(pixels.kin)]


def held_variance(pixels: Pixels) -> np.ndarray:
    """Variance [groups], in units of the effect, by which the modelled noise exceeds what pixels show beside
    the offsets of their groups: strong offsets were in the variance that the model was fitted to, per site of
    the mosaic, so that groups of other sites had another."""
    held = np.zeros(pixels.information.shape)
    for part in _alike(pixels):
        i, q = pixels.information[part], pixels.fourth[part]
        several = (i > 0) & (q < 0.9 * i**2)  # one pixel is its own offset
        i, q = i[several], q[several]
        own = pixels.within[:, part][:, several] / (1 - q / i**2)
        held[part] = np.sum(i - own) / max(len(own) * float(np.sum(q)), 1e-30)
    return held


def by_own_noise(score: np.ndarray, pixels: Pixels, count: np.ndarray):
    """Scores scaled to the noise that their own pixels show instead of the modelled one.

    score [n, groups]: sum of response times value; count: pixels of a group. Noise that is uneven or
    heavy-tailed makes sums of modelled variance 1 vary by more or less, which looks like shared offsets. What
    the sum itself adds to the squares of its pixels is taken out, and the mean square stays 1 to order
    1/count^2. Returns the scores and how much more the responses of each group tell than the modelled noise
    says, a factor for the information: where a strong offset is part of the modelled noise, its amplitude
    would come out too large without it.
    """
    information = np.maximum(pixels.information, 1e-30)
    share = 1 - held_variance(pixels) * pixels.fourth / information
    share = np.maximum(share, max(0.05 * float(np.mean(share)), 1e-6))
    count = np.maximum(count, 4.0)
    own = pixels.within + share * pixels.fourth / information
    own = np.maximum(own, 0.05 * share * information) * (count + 2) / count
    return score * np.sqrt(information / own / share), 1 / share


def outlying(values: np.ndarray, response: np.ndarray, groups: Groups) -> np.ndarray:
    """Pixels far off the others of their group `[H, W]`, in units of what most scatter by: single pixels that
    stand out, as hot ones do, tell nothing of what a group shares.

    The medians of the groups count as far as they differ by more than chance: a cut about medians that are
    chance would let the means of skewed values follow them."""
    seen = response > 0
    if not seen.any():
        return seen
    number = groups.kin.size
    count = np.bincount(groups.of[seen], minlength=number)
    middle = float(median(values[seen]))
    centre = np.where(count < _FEWEST, middle, medians(values[seen], groups.of[seen], count))
    spread = max(float(median(np.abs(values - centre[groups.of])[seen])) / _MEDIAN_OFF, 1.0)
    many = count >= _FEWEST
    chance = _MEDIANS * spread**2 * float(np.sum(1 / count[many]))
    apart = float(np.sum((centre[many] - middle) ** 2))
    centre = middle + max(1 - chance / max(apart, 1e-30), 0.0) * (centre - middle)
    return seen & (np.abs(values - centre[groups.of]) > _FAR * spread)


def medians(
    values: Float[np.ndarray, "n"], of: Int[np.ndarray, "n"], count: Int[np.ndarray, "g"]
) -> Float[np.ndarray, "g"]:
    """Median of the values of every group, of so many each; of a group without any that of some other."""
    order = np.argsort(values)
    # A stable sort of short numbers is one pass over them.
    kind = np.uint16 if count.size <= 1 << 16 else of.dtype
    ranked = values[order[np.argsort(of[order].astype(kind), kind="stable")]]
    start = np.cumsum(count) - count
    low, high = (np.minimum(start + (count + k) // 2, values.size - 1) for k in (-1, 0))
    return (ranked[low] + ranked[high]) / 2


def shared_sums(
    fields: tuple[Fields, ...], groups: Groups, scaling: str, axis: str = "pixel"
) -> SharedSums | None:
    """Sums of a pattern of groups that stays and that all recordings share, the mean of each taken out; None
    where none tells of it. axis: whose answers of the static part it has.

    Pixels that stand out are left out, and the noise is what the pixels of a group show: patterns of single
    pixels, such as hot ones, are none of groups.
    """
    shown = [(f, f.static) for f in fields if f.static is not None and shows(f, scaling)]
    if not shown or groups.kin.size < 2 or not told(fields, scaling):
        return None

    pieces = []
    for f, static in shown:
        response = stays(f, axis, scaling).astype(np.float64)
        pieces.append((f.frames, static * response, np.square(response, out=response)))

    def together(kept: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        score, information = np.zeros(groups.of.shape), np.zeros(groups.of.shape)
        for frames, projected, square in pieces:
            mean = float(np.sum(projected * kept)) / max(float(np.sum(square * kept)), 1e-30)
            score += np.sqrt(frames) * (projected - mean * square)
            information += frames * square
        score *= kept
        information *= kept
        root = np.sqrt(information, out=information)
        return score / np.maximum(root, 1e-15), root

    # What is no part of a map of pixels was left as it is, far above all else, and would move the mean. The
    # noise is that which others of these lines were taken out by, in which other pixels may have stood out.
    lines = shown[0][0].answers.lines.get(axis)
    apart = [mask for f, _ in shown for mask in f.answers.apart.values()]
    before = ~np.any(apart, axis=0) if apart else np.ones(groups.of.shape, bool)
    before = before if lines is None else before & lines[0]
    values, root = together(before)
    kept = before & ~outlying(values, root, groups)
    values, root = together(kept)
    pixels = group_pixels(values[None], root, groups)
    noise = _own_noise(pixels) if lines is None else lines[1]
    return SharedSums(groups.sums(values * root) / noise, pixels.information / noise, kept, noise)


def _own_noise(pixels: Pixels) -> np.ndarray:
    """Variance of the pixels of groups beside the groups' offsets, over the modelled one [groups]: the mean
    over groups of the same sites of the mosaic. Of a group's own pixels alone it would depend on how their
    values are distributed."""
    out = np.ones(pixels.information.shape)
    for part in _alike(pixels):
        i, q = pixels.information[part], pixels.fourth[part]
        freedom = float(np.sum(i - q / np.maximum(i, 1e-30)))
        if freedom > 0:
            out[part] = max(float(np.sum(pixels.within[0, part])) / freedom, 1e-3)
    return out


def group_pixels(values: np.ndarray, response: np.ndarray, groups: Groups) -> Pixels:
    """The pixels of every group of `values` [n, h, w] beside the group's own offset."""
    square = response.astype(np.float64) ** 2
    information = groups.sums(square)
    within = []
    for v in values:
        offset = groups.sums(v * response) / np.maximum(information, 1e-30)
        within.append(groups.sums(square * (v - offset[groups.of] * response) ** 2))
    return Pixels(information, groups.sums(square**2), np.array(within), groups.kin)
