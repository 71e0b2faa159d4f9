"""Offsets and gains common to a row or a column: redrawn in every frame, or frozen."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.signatures.fields import Fields, map_contrasts
from cannoise_jax.signatures.least import (
    random_offsets,
)
from cannoise_jax.signatures.score import Score, variance_component
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    CONTRASTS,
    NO_LAW,
    NO_PATTERN,
    NOT_SIMULATED,
    STATIC,
    Axes,
    Many,
    Predicted,
    Scales,
    Signature,
    draw,
    placed,
    posterior,
    strength,
)

AXES = {"row": 2, "column": 1}
"""Axis of a [n, h, w] array that is summed over."""
_SUMS = {"row": ("nij,ij->ni", "ni,ij->nij"), "column": ("nij,ij->nj", "nj,ij->nij")}
"""From pixels and responses to lines, and back."""
_MOST_HELD = 2.0
"""Variance that the modelled noise of one recording may hold of an effect, in units of the fitted one: what a
few frames draw scatters about it."""


class LineSums(NamedTuple):
    """Scores U and information I of one template per line: U ~ N(0, I) when nothing is there."""

    score: np.ndarray
    information: np.ndarray


def response(field: Fields, scaling: str) -> np.ndarray:
    """What the standardised field answers to a unit effect: 1/sigma (DN) or signal/sigma (fraction)."""
    return field.weight if scaling == "additive" else field.relative


class Pixels(NamedTuple):
    """What the pixels of a group show beside the group's own offset, responses weighing them.

    information, fourth: sums of the response squared and to the fourth [groups]; within [n, groups]: sum of
    the response squared times the residual squared.
    """

    information: np.ndarray
    fourth: np.ndarray
    within: np.ndarray


def held_variance(pixels: Pixels) -> np.ndarray:
    """Variance [groups], in units of the effect, by which the modelled noise exceeds what pixels show beside
    the offsets of their groups: strong offsets were in the variance that the model was fitted to, per site of
    the mosaic, so that every other line had its own."""
    held = np.zeros(pixels.information.shape)
    for part in (slice(0, None, 2), slice(1, None, 2)):
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
    return Pixels(information, np.sum(square**2, AXES[axis] - 1), within)


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


def component_score(power, information, dof, scaling, where, scale_variance=0.0) -> Score:
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


def temporal_score(fields: tuple[Fields, ...], *, axis: str, scaling: str) -> Score | None:
    """White random offset (or gain) of every line, new in every frame."""
    sums = [
        line_sums(f, f.contrasts, axis, scaling)
        for f in fields
        if len(f.contrasts) and (f.lit or scaling == "additive")
    ]
    sums = [s for s in sums if s.information.max() > 0]
    if not sums:
        return None
    # The mean of the lines is taken out: their squares hold one degree of freedom less than there are lines.
    left = [1 - 1 / max(int(np.sum(s.information > 0)), 2) for s in sums]
    power = [(s.score**2).sum(0) / np.maximum(s.information, 1e-30) for s in sums]
    return component_score(
        np.concatenate([n * p for n, p in zip(left, power, strict=True)]),
        np.concatenate([s.information / n for n, s in zip(left, sums, strict=True)]),
        np.concatenate(
            [np.full(p.shape, n * len(s.score)) for n, p, s in zip(left, power, sums, strict=True)]
        ),
        scaling,
        {"axis": axis},
    )


def temporal_absorb(
    fields: tuple[Fields, ...], score: Score, *, axis: str, scaling: str
) -> tuple[Fields, ...]:
    """Whitens every line: the symmetric inverse root of 1 + v r r^T."""
    return tuple(
        whiten_lines(f, axis, scaling, score.payload) if f.lit or scaling == "additive" else f for f in fields
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


def static_sums(fields: tuple[Fields, ...], axis: str, scaling: str) -> LineSums | None:
    """Scores of a frozen line pattern shared by all recordings."""
    score: np.ndarray | float = 0.0
    information: np.ndarray | float = 0.0
    for f in fields:
        if f.static is None or (scaling == "signal" and not f.lit):
            continue
        s = line_sums(f, f.static[None], axis, scaling, own=False)
        if s.information.size < 2:
            continue
        score = score + np.sqrt(f.frames) * s.score[0]
        information = information + f.frames * s.information
    return LineSums(np.asarray(score), np.asarray(information)) if np.ndim(score) else None


def static_score(fields: tuple[Fields, ...], *, axis: str, scaling: str) -> Score | None:
    """Frozen white pattern of lines, the same in every recording."""
    sums = static_sums(fields, axis, scaling)
    if sums is None:
        return None
    power = sums.score**2 / np.maximum(sums.information, 1e-30)
    largest = np.argsort(-power)[:8]
    where = {"axis": axis, "index": sorted(int(i) for i in largest)}
    return component_score(power, sums.information, np.ones(power.shape), scaling, where)


def static_absorb(fields: tuple[Fields, ...], score: Score, *, axis: str, scaling: str) -> tuple[Fields, ...]:
    """Takes the whitening part of the estimated shared pattern out of every recording's static field."""
    sums = static_sums(fields, axis, scaling)
    if sums is None:  # no recording of the kind that shows it
        return fields
    tau = score.payload * sums.information
    pattern = sums.score * (1 - 1 / np.sqrt(1 + tau)) / np.maximum(sums.information, 1e-30)
    spread = pattern[:, None] if axis == "row" else pattern[None, :]
    return tuple(
        f
        if f.static is None or (scaling == "signal" and not f.lit)
        else f._replace(
            static=(f.static - np.sqrt(f.frames) * spread * response(f, scaling)).astype(np.float32)
        )
        for f in fields
    )


def _light(scaling: str) -> frozenset[str]:
    return frozenset({"signal"}) if scaling == "signal" else frozenset()


def redrawn(
    axis: str,
    scaling: Scales,
    *,
    name: str,
    parameter: str | None = None,
    covers: tuple[str, ...] = (),
) -> Signature:
    """White offsets (or factors) of lines, new in every frame. parameter: the mechanism's strength."""
    additive = scaling == "additive"
    point = (
        Point("readout", "signal", axis, "redrawn")  # type: ignore[arg-type]
        if additive
        else Point("photons", "mean", axis, "redrawn", "multiply")  # type: ignore[arg-type]
    )
    return Signature(
        name=name,
        kin=axis,
        axes=Axes("readout" if additive else "photons", axis, "redrawn", scaling, "white"),
        reads=CONTRASTS | _light(scaling),
        score=partial(temporal_score, axis=axis, scaling=scaling),
        absorb=partial(temporal_absorb, axis=axis, scaling=scaling),
        covers=covers,
        predict=_shared_by_line(axis) if additive else NO_LAW,
        pattern=NO_PATTERN,
        simulate=strength(parameter) if parameter else NOT_SIMULATED,
        place=placed(point),
        detectable=BY_SHIFT,
        least=random_offsets(axis, scaling, frozen=False),
    )


def _shared_by_line(axis: str):
    return lambda fields, score: Predicted(**{axis: score.amplitude})


def frozen(
    axis: str,
    scaling: Scales,
    *,
    name: str,
    parameter: str | None = None,
    covers: tuple[str, ...] = (),
) -> Signature:
    """White offsets (or gains) of lines that stay. parameter: the mechanism's strength."""
    point = (
        Point("readout", "signal", axis, "frozen")  # type: ignore[arg-type]
        if scaling == "additive"
        else Point("photons", "mean", axis, "frozen", "multiply")  # type: ignore[arg-type]
    )
    shape = (-1, 1) if axis == "row" else (1, -1)

    def predict(fields: Many, score: Score) -> Predicted | None:
        sums = static_sums(fields, axis, scaling)
        if sums is None:
            return None
        mean, doubt = posterior(sums.score, sums.information, score.amplitude**2)
        return Predicted(mean.reshape(shape), doubt.reshape(shape), scaling)

    def pattern(fields: Many, score: Score, rng: np.random.Generator) -> np.ndarray | None:
        sums = static_sums(fields, axis, scaling)
        return (
            None
            if sums is None
            else draw(sums.score, sums.information, score.amplitude**2, rng).reshape(shape)
        )

    return Signature(
        name=name,
        kin=axis,
        axes=Axes("readout", axis, "frozen", scaling, "white"),
        reads=STATIC | _light(scaling),
        score=partial(static_score, axis=axis, scaling=scaling),
        absorb=partial(static_absorb, axis=axis, scaling=scaling),
        covers=covers,
        predict=predict,
        pattern=pattern,
        simulate=strength(parameter) if parameter else NOT_SIMULATED,
        place=placed(point),
        detectable=BY_SHIFT,
        least=random_offsets(axis, scaling, frozen=True),
    )
