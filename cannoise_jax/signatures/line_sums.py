"""Sums over rows and columns, and the score of one variance of their offsets."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

from cannoise_jax.recordings.packing import SITES
from cannoise_jax.signatures.fields import Fields, map_contrasts
from cannoise_jax.signatures.score import Score, variance_component

AXES = {"row": 2, "column": 1}
"""Axis of a [n, h, w] array that is summed over."""
_SUMS = {"row": ("nij,ij->ni", "ni,ij->nij"), "column": ("nij,ij->nj", "nj,ij->nij")}
"""From pixels and responses to lines, and back."""
_MOST_HELD = 2.0
"""Variance that the modelled noise of one recording may hold of an effect, in units of the fitted one: what a
few frames draw scatters about it."""
_FAR = 4.0
"""Distance from which on a pixel stands out, in standard deviations of what most scatter by: normal noise
loses one pixel in 16,000, and 1e-3 of its variance."""
_FEWEST = 16
"""Pixels from which on the median of a group is its own: of fewer one that stands out moves it along."""
_MEDIANS = 4.0
"""Variance of the medians of n values, in units of spread^2 / n, that counts as chance: 1.6 of normal values,
more of skewed ones."""
_MEDIAN_OFF = 0.6745
"""Median distance of a standard normal value from its mean."""


class LineSums(NamedTuple):
    """Scores U and information I of one template per line: U ~ N(0, I) when nothing is there."""

    score: np.ndarray
    information: np.ndarray


def response(field: Fields, scaling: str) -> np.ndarray:
    """What the standardised field answers to a unit effect: 1/sigma (DN), seconds/sigma (DN/s) or
    signal/sigma (fraction)."""
    if scaling == "exposure":
        return field.weight * np.float32(field.exposure_s or 0.0)
    return field.weight if scaling == "additive" else field.relative


def shows(field: Fields, scaling: str) -> bool:
    """Whether what stays in a recording tells of an effect that scales so."""
    told = {"signal": field.lit, "exposure": bool(field.exposure_s)}.get(scaling, True)
    return told and field.static is not None


class Pixels(NamedTuple):
    """What the pixels of a group show beside the group's own offset, responses weighing them.

    information, fourth: sums of the response squared and to the fourth [groups]; within [n, groups]: sum of
    the response squared times the residual squared; kin: number of the groups that hold the same sites of the
    mosaic, whose noise is alike [groups].
    """

    information: np.ndarray
    fourth: np.ndarray
    within: np.ndarray
    kin: np.ndarray


def _alike(pixels: Pixels) -> list[np.ndarray]:
    """The groups of each kin."""
    return [pixels.kin == number for number in np.unique(pixels.kin)]


def same_sites(groups: np.ndarray) -> np.ndarray:
    """Number of the kin of each group: groups that hold the same sites of the mosaic. One that holds some of
    another's alone, as where diagonals or tiles end, is of its kin."""
    held = np.zeros(int(groups.max()) + 1, np.int64)
    for site, at in enumerate(SITES):
        some = np.zeros(held.size, np.int64)
        some[groups[at]] = 1 << site
        held |= some
    kinds = sorted(set(held.tolist()), key=int.bit_count, reverse=True)
    widest = {kind: next(other for other in kinds if kind & ~other == 0) for kind in kinds}
    return np.array([widest[kind] for kind in held.tolist()])


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


def line_pixels(values: np.ndarray, response: np.ndarray, axis: str) -> Pixels:
    """The pixels of every line of `values` [n, h, w] beside the line's own offset."""
    to_lines, to_pixels = _SUMS[axis]
    square = response.astype(np.float64) ** 2
    information = square.sum(AXES[axis] - 1)
    offset = np.einsum(to_lines, values, response) / np.maximum(information, 1e-30)
    rest = values - np.einsum(to_pixels, offset.astype(np.float32), response)
    within = np.einsum(to_lines, rest**2, response**2).astype(np.float64)
    return Pixels(information, np.sum(square**2, AXES[axis] - 1), within, np.arange(information.size) % 2)


def alone(field: Fields, held: np.ndarray, variance: float, scaling: str) -> Fields:
    """The field standardised by the noise of single pixels: what the modelled variance holds of a shared
    effect of this fitted variance, both in units of the effect, is taken out of it. It cannot fall below that
    of rounding. held: `[H, W]` or broadcasting."""
    r = response(field, scaling).astype(np.float64)
    least = np.minimum(field.step**2 / 12 * field.weight.astype(np.float64) ** 2, 1)
    left = np.maximum(1 - np.clip(held, 0, _MOST_HELD * variance) * r**2, least)
    root = np.where(r > 0, np.sqrt(left), 1.0).astype(np.float32)
    return field._replace(
        sigma=field.sigma * root,
        shot=np.minimum(field.shot / root**2, 1.0).astype(np.float32),
        contrasts=field.contrasts / root,
        static=None if field.static is None else field.static / root,
    )


def line_sums(field: Fields, values: np.ndarray, axis: str, scaling: str, own: bool = True) -> LineSums:
    """Per line of `values` [n, h, w], after the mean of each field is taken out; own: see `by_own_noise`."""
    r = response(field, scaling).astype(np.float32)
    total = float(np.sum(r.astype(np.float64) ** 2))
    if total == 0:
        lines = r.shape[0 if axis == "row" else 1]
        return LineSums(np.zeros((len(values), lines)), np.zeros(lines))
    frame = np.einsum("nij,ij->n", values, r) / total
    score = np.einsum(_SUMS[axis][0], values, r).astype(np.float64)
    information = np.sum(r.astype(np.float64) ** 2, axis=AXES[axis] - 1)
    score = score - frame[:, None] * information
    left = information * (1 - information / total)
    if own:
        score, more = by_own_noise(score, line_pixels(values, r, axis), np.sum(r > 0, axis=AXES[axis] - 1))
        left = left * more
    return LineSums(score, left)


def line_power(field: Fields, values: np.ndarray, axis: str) -> np.ndarray:
    """Power of the line means of `values` [n, h, w] by frequency, summed over n; white noise: 1 each."""
    sums = line_sums(field, values, axis, "additive")
    x = sums.score / np.sqrt(np.maximum(sums.information, 1e-30))
    return (np.abs(np.fft.rfft(x, axis=1)) ** 2).sum(0) / x.shape[1]


def component_score(
    power: np.ndarray,
    information: np.ndarray,
    dof: np.ndarray,
    *,
    scaling: str,
    where: dict[str, Any],
    scale_variance: float = 0.0,
) -> Score[float]:
    """The score of one variance component of offsets (DN) or factors, see `variance_component`."""
    fit = variance_component(power, information, dof, scale_variance)
    sigma = np.sqrt(fit.variance)
    error = fit.error / (2 * sigma) if sigma > 0 else np.sqrt(fit.error)
    unit = "DN" if scaling == "additive" else "1"
    cost = 0.5 * np.log(np.sum(dof))
    return Score(
        log_p=fit.log_p,
        gain=fit.gain,
        penalty=float(cost),
        amplitude=float(sigma),
        error=float(error),
        shift=float(np.sqrt(fit.shift)),
        power=2,
        parameters={"sigma": (float(sigma), unit, float(error))},
        where=where,
        payload=fit.variance,
    )


def whiten_lines(field: Fields, axis: str, scaling: str, variance: float) -> Fields:
    """Temporal offsets fall on the static field too, with 1/T of their variance per frame. What is left to a
    line is what its pixels' own noise gives it."""
    if len(field.contrasts):
        pixels = line_pixels(field.contrasts, response(field, scaling).astype(np.float32), axis)
        held = held_variance(pixels)
        field = alone(field, held[:, None] if axis == "row" else held[None, :], variance, scaling)
    r = response(field, scaling).astype(np.float32)
    to_lines, to_pixels = _SUMS[axis]
    information = np.sum(r.astype(np.float64) ** 2, axis=AXES[axis] - 1)
    shrink = (1 - 1 / np.sqrt(1 + variance * information)) / np.maximum(information, 1e-30)

    def function(x: np.ndarray) -> np.ndarray:
        score = np.einsum(to_lines, x, r) * shrink
        return x - np.einsum(to_pixels, score.astype(np.float32), r)

    return map_contrasts(field, function)


def outlying(values: np.ndarray, response: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Pixels far off the others of their group `[H, W]`, in units of what most scatter by: single pixels that
    stand out, as hot ones do, tell nothing of what a group shares.

    The medians of the groups count as far as they differ by more than chance: a cut about medians that are
    chance would let the means of skewed values follow them."""
    seen = response > 0
    if not seen.any():
        return seen
    flat, number = np.where(seen, groups, -1), int(groups.max()) + 1
    count = np.bincount(groups[seen], minlength=number)
    middle = float(np.median(values[seen]))
    centre = np.asarray(ndimage.median(values, flat, np.arange(number)))
    centre = np.where(count < _FEWEST, middle, centre)
    spread = max(float(np.median(np.abs(values - centre[groups])[seen])) / _MEDIAN_OFF, 1.0)
    many = count >= _FEWEST
    chance = _MEDIANS * spread**2 * float(np.sum(1 / count[many]))
    apart = float(np.sum((centre[many] - middle) ** 2))
    centre = middle + max(1 - chance / max(apart, 1e-30), 0.0) * (centre - middle)
    return seen & (np.abs(values - centre[groups]) > _FAR * spread)


def shared_sums(fields: tuple[Fields, ...], groups: np.ndarray, scaling: str) -> LineSums | None:
    """Scores and information [groups] of a pattern of groups that stays and that all recordings share, the
    mean of each taken out; None where none tells of it.

    Pixels that stand out are left out, and the noise is what the pixels of a group show: patterns of single
    pixels, such as hot ones, are none of groups.
    """
    shown = [(f, f.static) for f in fields if f.static is not None and shows(f, scaling)]
    if not shown or groups.max() < 1:
        return None

    def together(kept: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        score, information = np.zeros(groups.shape), np.zeros(groups.shape)
        for f, static in shown:
            r = response(f, scaling).astype(np.float64) * kept
            rest = static - float(np.sum(static * r)) / max(float(np.sum(r**2)), 1e-30) * r
            score += np.sqrt(f.frames) * rest * r
            information += f.frames * r**2
        root = np.sqrt(information)
        return score / np.maximum(root, 1e-15), root

    values, root = together(1.0)
    values, root = together(~outlying(values, root, groups))
    pixels = group_pixels(values[None], root, groups)
    score = np.bincount(groups.ravel(), (values * root).ravel(), pixels.information.size)
    noise = _own_noise(pixels)
    return LineSums(score / noise, pixels.information / noise)


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


def group_pixels(values: np.ndarray, response: np.ndarray, groups: np.ndarray) -> Pixels:
    """The pixels of every group of `values` [n, h, w] beside the group's own offset."""
    flat, number = groups.ravel(), int(groups.max()) + 1
    square = response.astype(np.float64) ** 2
    information = np.bincount(flat, square.ravel(), number)
    within = []
    for v in values:
        offset = np.bincount(flat, (v * response).ravel(), number) / np.maximum(information, 1e-30)
        within.append(np.bincount(flat, (square * (v - offset[groups] * response) ** 2).ravel(), number))
    fourth = np.bincount(flat, (square**2).ravel(), number)
    return Pixels(information, fourth, np.array(within), same_sites(groups))


def static_sums(fields: tuple[Fields, ...], axis: str, scaling: str) -> LineSums | None:
    """Scores of a frozen line pattern shared by all recordings."""
    if not fields:
        return None
    sums = shared_sums(fields, np.indices(fields[0].mean.shape)[0 if axis == "row" else 1], scaling)
    if sums is None:
        return None
    total = max(float(np.sum(sums.information)), 1e-30)
    return LineSums(sums.score, sums.information * (1 - sums.information / total))
