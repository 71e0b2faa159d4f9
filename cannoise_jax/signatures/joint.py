"""Frozen maps of pixels, rows and columns, all at once: what the recordings say of each beside the others.

Static parts s from which every map was taken out (see `signatures.answers`) have the covariance of white
noise. Of the maps of one place, with the variances G = diag(v) that they were taken out with and the
responses B that are left, what is left says

    u' = B^T s,  M' = B^T B,  and so of the static parts before  u = (1 - M' G)^-1 u',  M = (1 - M' G)^-1 M'

by the Woodbury identity: the scores and the information of every number of the maps, with those of other
places in the noise. From these follow the variances that are likeliest together, and for any G the
expectation G (1 + M G)^-1 u and the covariance G - G (1 + M G)^-1 M G of the maps.

Where the frames tell the sum of two maps but not which of them it is, their doubts cancel in the sum, so
draws are made of all maps of a place together, and of pixels given what was drawn of lines. Drawn apart, what
two maps could both be would be drawn twice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

from cannoise_jax.physics.robust import median
from cannoise_jax.recordings.recording import KINDS
from cannoise_jax.signatures.added import draw_pixels
from cannoise_jax.signatures.answers import along_fields, at_first
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.handed import Predicted
from cannoise_jax.signatures.line_sums import lines, static_sums
from cannoise_jax.signatures.patterns import STANDS_OUT, pixel_sums, scale_variance

_LEAST = 1e-5
"""Share of a map's variance that its doubt keeps, whatever the frames say: what single precision tells."""
_MEDIAN_OF_ONE = float(stats.chi2.median(1))
"""Median of the square of a standard normal value."""
_STEPS = 50
"""Steps of Fisher scoring at most."""
_APART = 1e6
"""Variance of numbers that are no part of a map, over that of the others."""
_FAR_LINES = 100.0
"""Square of a line, in variances of most, from which on it is no part of the variance of a map. Of columns of
Laplace's law those beyond 30, as of pixels, are a twelfth of the variance, beyond 100 a five-hundredth."""
_SHAPES = {"row": (-1, 1), "column": (1, -1)}
"""Of the values of lines, by axis, to lie along the frame."""


class FrozenMap(NamedTuple):
    """A map that was taken out: of pixels, rows or columns, how it grows, and its variance then (DN^2,
    fractions squared or (DN/s)^2)."""

    axis: str
    scaling: str
    variance: float


class Strength(NamedTuple):
    """Standard deviation of a map, its error, and the one that moves its statistic by one standard deviation
    of what it does where there is none."""

    sigma: float
    error: float
    shift: float


class _Place(NamedTuple):
    """The maps of one place: which of all they are, scores and information of every number n of theirs
    [n, k], [n, k, k], what whitening took out of each map [n, k], numbers that were no part of one [n, k]."""

    which: list[int]
    score: Float[np.ndarray, "n k"]
    information: Float[np.ndarray, "n k k"]
    taken: Float[np.ndarray, "n k"]
    apart: Bool[np.ndarray, "n k"]


def strengths(fields: tuple[Fields, ...], maps: Sequence[FrozenMap]) -> list[Strength | None]:
    """Strength of each map beside all others, by maximum likelihood; None for one that nothing tells of.
    fields: with every map taken out."""
    out: dict[int, Strength] = {}

    def settled(place: _Place, shape: tuple[int, ...]) -> np.ndarray:
        fitted = _fit(fields, maps, place)
        out.update(fitted)
        sigma = [fitted[n].sigma if n in fitted else np.sqrt(maps[n].variance) for n in place.which]
        return _posterior(place, _of_each(place, np.square(sigma)))[0]

    _place_by_place(fields, maps, settled)
    return [out.get(n) for n in range(len(maps))]


def predicted(
    fields: tuple[Fields, ...], maps: Sequence[FrozenMap], sigma: Sequence[float]
) -> list[Predicted | None]:
    """What each map of this standard deviation adds to new frames, with the others beside it; None for one
    that nothing tells of. fields: with every map taken out."""
    out: dict[int, Predicted] = {}

    def settled(place: _Place, shape: tuple[int, ...]) -> np.ndarray:
        variance = _variances(place, sigma)
        mean, covariance = _posterior(place, _of_each(place, variance))
        for k, n in enumerate(place.which):
            doubt = np.minimum(covariance[:, k, k], variance[k]).reshape(shape)
            out[n] = Predicted(maps[n].scaling, mean[:, k].reshape(shape), doubt)
        return mean

    _place_by_place(fields, maps, settled)
    return [out.get(n) for n in range(len(maps))]


def drawn(
    fields: tuple[Fields, ...],
    maps: Sequence[FrozenMap],
    sigma: Sequence[float],
    rng: np.random.Generator,
) -> list[Float[np.ndarray, "..."] | None]:
    """One draw of all maps together, of these standard deviations and given what the recordings say; lines as
    `[H, 1]` or `[1, W]`, None for one that nothing tells of. fields: with every map taken out."""
    out: dict[int, np.ndarray] = {}

    def settled(place: _Place, shape: tuple[int, ...]) -> np.ndarray:
        values = _draw(place, _variances(place, sigma), shape if -1 not in shape else None, rng)
        out.update({n: values[:, k].reshape(shape) for k, n in enumerate(place.which)})
        return values

    _place_by_place(fields, maps, settled)
    return [out.get(n) for n in range(len(maps))]


def _place_by_place(
    fields: tuple[Fields, ...],
    maps: Sequence[FrozenMap],
    settled: Callable[[_Place, tuple[int, ...]], Float[np.ndarray, "n k"]],
) -> None:
    """Lines first, then pixels, given what lines are. settled(maps of a place, shape of one) -> what they are
    taken to be."""
    moved: list[tuple[str, np.ndarray]] = []
    taken = tuple(_as_taken(f) for f in fields)
    for axis in ("row", "column", "pixel"):
        place = _place(fields, taken, maps, axis, moved)
        if place is not None:
            values = settled(place, _SHAPES.get(axis, fields[0].mean.shape))
            moved += _taken_from(maps, place, values, axis)


def _of_each(place: _Place, variance: Float[np.ndarray, "k"]) -> Float[np.ndarray, "n k"]:
    """The variances of every number: of one that is no part of its map it says nothing, the recordings do."""
    return np.where(place.apart, _APART * variance, variance)


def _variances(place: _Place, sigma: Sequence[float]) -> np.ndarray:
    return np.array([max(sigma[n], 1e-12) ** 2 for n in place.which])


def _taken_from(
    maps: Sequence[FrozenMap], place: _Place, values: Float[np.ndarray, "n k"], axis: str
) -> list[tuple[str, np.ndarray]]:
    """What was taken out of the pixels of every line less what the line is, by scaling: theirs again."""
    rest = (place.taken - values).T
    return [
        (maps[n].scaling, by.reshape(_SHAPES[axis]))
        for n, by in zip(place.which, rest, strict=True)
        if axis != "pixel"
    ]


def _place(
    given: tuple[Fields, ...],
    fields: tuple[Fields, ...],
    maps: Sequence[FrozenMap],
    axis: str,
    moved: list[tuple[str, np.ndarray]],
) -> _Place | None:
    """The maps of a place. given, fields: as they are, and `_as_taken`. moved: what pixels of lines have
    beside what is left, by scaling."""
    which = [n for n, one in enumerate(maps) if one.axis == axis and one.variance > 0]
    sums = {n: _sums(fields, axis, maps[n].scaling) for n in which}
    which = [n for n in which if sums[n] is not None]
    if not which:
        return None
    scalings = [maps[n].scaling for n in which]
    shape = fields[0].mean.shape
    if axis == "pixel":
        score = np.stack([sums[n].score.ravel() for n in which], 1)
        for k, scaling in enumerate(scalings):
            for other, by in moved:
                score[:, k] += (_along(fields, scaling, other) * by).ravel()
        products = [[_along(fields, a, b).ravel() for b in scalings] for a in scalings]
        none = np.zeros(shape, bool)
        apart = np.stack([_apart(fields, s, none).ravel() for s in scalings], 1)
    else:
        first = sums[which[0]]
        groups = lines(axis, shape)
        score = np.stack([sums[n].score for n in which], 1)
        products = [
            [
                groups.sums(
                    _along(fields, maps[a].scaling, maps[b].scaling, axis) * (sums[a].kept & sums[b].kept)
                )
                / first.noise
                for b in which
            ]
            for a in which
        ]
        apart = np.zeros(score.shape, bool)
    left = np.stack([np.stack(row, -1) for row in products], -2)
    v = np.array([maps[n].variance for n in which])
    same = np.eye(len(which), dtype=bool)
    whitened = np.where(apart, 0.0, v)
    # 1 - M' G, of the symmetric form of it, whose eigenvalues lie between 0 and 1.
    root = np.sqrt(whitened)
    values, vectors = np.linalg.eigh(same - root[:, :, None] * left * root[:, None, :])
    inverse = np.einsum("nij,nj,nkj->nik", vectors, 1 / np.maximum(values, _LEAST), vectors)
    # (1 - M' G)^-1 = 1 + M' G^1/2 (1 - G^1/2 M' G^1/2)^-1 G^1/2
    more = np.einsum("nij,nj,njk,nk->nik", left, root, inverse, root)
    before = same + more
    u, m = np.einsum("nij,nj->ni", before, score), np.einsum("nij,njk->nik", before, left)
    own_left = np.einsum("nii->ni", left)
    kept = np.sqrt(np.clip(1 - whitened * own_left, _LEAST, 1))
    taken = (1 - kept) * score / np.maximum(own_left, 1e-30)
    finer = _finer(given, fields, axis, scalings)[:, None]
    return _Place(which, u * finer, 0.5 * (m + m.transpose(0, 2, 1)) * finer[:, None], taken, apart)


def _as_taken(field: Fields) -> Fields:
    """The field standardised by the noise that was known when the first map was taken out: to that alone what
    is left of the maps can be undone. A lamp that drifts is in the noise until it is found."""
    by = field.answers.finer
    if np.ndim(by) == 0:
        return field
    static = None if field.static is None else field.static / by
    return field._replace(static=static, sigma=field.sigma * by, answers=field.answers._replace(finer=1.0))


def _finer(
    given: tuple[Fields, ...], taken: tuple[Fields, ...], axis: str, scalings: Sequence[str]
) -> Float[np.ndarray, "n"]:
    """By how much more the recordings tell of every number of a place by the noise that is known now."""
    if all(a is b for a, b in zip(given, taken, strict=True)):
        return np.ones(1)
    now, then = (
        np.sum([at_first(fields, axis, (s,))[frozenset((s,))] for s in scalings], axis=0)
        for fields in (given, taken)
    )
    if axis != "pixel":
        now, then = (lines(axis, then.shape).sums(v) for v in (now, then))
    return (now / np.maximum(then, 1e-30)).ravel()


def _sums(fields: tuple[Fields, ...], axis: str, scaling: str):
    return pixel_sums(fields, scaling, KINDS) if axis == "pixel" else static_sums(fields, axis, scaling)


def _apart(fields: tuple[Fields, ...], scaling: str, none: np.ndarray) -> np.ndarray:
    return next((f.answers.apart[scaling] for f in fields if scaling in f.answers.apart), none)


def _along(
    fields: tuple[Fields, ...], scaling: str, other: str, axis: str = "pixel"
) -> Float[np.ndarray, "h w"]:
    """Sum over the recordings of what is left of the responses of pixels to patterns of two scalings."""
    return along_fields(fields, axis, scaling)(other)


def _posterior(
    place: _Place, variance: Float[np.ndarray, "*n k"]
) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, "n k k"]]:
    """Expectation and covariance of the numbers of every place."""
    root = np.sqrt(variance)
    k = np.eye(variance.shape[-1])
    known = np.linalg.inv(k + root[..., :, None] * place.information * root[..., None, :])
    covariance = root[..., :, None] * known * root[..., None, :]
    return np.einsum("nij,nj->ni", covariance, place.score), covariance


def _fit(fields: tuple[Fields, ...], maps: Sequence[FrozenMap], place: _Place) -> dict[int, Strength]:
    """The variances of the maps of a place that are likeliest together."""
    start = np.array([maps[n].variance for n in place.which])
    told = np.einsum("nii->ni", place.information).min(1) > 0
    limit = STANDS_OUT if maps[place.which[0]].axis == "pixel" else _FAR_LINES
    variance = start.copy()
    for _ in range(_STEPS):
        mean, covariance = _posterior(place, variance)
        # Scores and information with all maps in the noise.
        u = mean / variance
        m = (variance * np.eye(len(variance)) - covariance) / (variance[:, None] * variance)
        power, own = u**2, np.maximum(np.einsum("nii->ni", m), 1e-30)
        # A few far out are no part of a map, by the scale of most: by that of all they would be.
        ratio = power / own
        bulk = median(ratio[told], 0) / _MEDIAN_OF_ONE if told.any() else 1.0
        far = ((ratio > limit * bulk) | place.apart).any(1)
        used = told & ~far
        if not used.any():
            return {}
        slope = 0.5 * np.sum(power[used] - own[used], 0)
        fisher = 0.5 * np.einsum("nij,nij->ij", m[used], m[used])
        # In logarithms no variance falls below 0; half a step at most is no overshoot.
        by = np.linalg.lstsq(fisher * variance[:, None] * variance, slope * variance, rcond=None)[0]
        by = np.clip(by, -1.0, 1.0)
        variance = np.maximum(variance * np.exp(by), 1e-8 * start)
        if np.max(np.abs(by)) < 1e-4:
            break
    # Of the logarithms: variances of unlike units lie many powers of ten apart.
    inverse = np.linalg.pinv(fisher * variance[:, None] * variance) * variance[:, None] * variance
    out = {}
    for k, n in enumerate(place.which):
        information = place.information[used, k, k]
        alone = 0.5 * float(np.sum(information**2))
        noise = scale_variance(fields, maps[n].scaling, KINDS) if maps[n].axis == "pixel" else 0.0
        wider = 1 + noise * float(np.sum(own[used, k])) ** 2 / (2 * float(np.sum(own[used, k] ** 2)))
        wide = 1 + noise * float(np.sum(information)) ** 2 / (2 * float(np.sum(information**2)))
        error, shift = np.sqrt(wider * inverse[k, k]), (wide / alone) ** 0.25
        sigma = float(np.sqrt(variance[k])) if variance[k] > 1e-6 * start[k] else 0.0
        out[n] = Strength(sigma, float(error / (2 * sigma) if sigma > 0 else np.sqrt(error)), float(shift))
    return out


def _draw(
    place: _Place,
    variance: Float[np.ndarray, "k"],
    frame: tuple[int, ...] | None,
    rng: np.random.Generator,
) -> Float[np.ndarray, "n k"]:
    """A draw of the numbers of a place, one map after the other, each given those before it. frame: of
    pixels, whose neighbours may be alike."""
    mean, covariance = _posterior(place, _of_each(place, variance))
    out = np.zeros(mean.shape)
    for k in range(len(variance)):
        expected, doubt = mean[:, k], covariance[:, k, k]
        if k:
            known = covariance[:, :k, :k] + _LEAST * variance[:k] * np.eye(k)
            weight = np.linalg.solve(known, covariance[:, :k, k, None])[..., 0]
            expected = expected + np.sum(weight * (out - mean)[:, :k], 1)
            doubt = doubt - np.sum(weight * covariance[:, :k, k], 1)
        doubt = np.clip(doubt, _LEAST * variance[k], variance[k])
        if frame is None:
            out[:, k] = expected + np.sqrt(doubt) * rng.standard_normal(doubt.shape)
        else:
            information = np.maximum(1 / doubt - 1 / variance[k], 0)
            shown = ((expected / doubt).reshape(frame), information.reshape(frame))
            out[:, k] = draw_pixels(*shown, float(variance[k]), rng).ravel()
    return out
