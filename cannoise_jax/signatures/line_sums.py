"""Sums over rows and columns, and the score of one variance of their offsets."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Literal

import numpy as np

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.transfer.noise_of_lines import Line
from cannoise_jax.signatures.answers import less_shared, response, through
from cannoise_jax.signatures.fields import Fields, map_contrasts
from cannoise_jax.signatures.group_sums import (
    Groups,
    LineSums,
    Pixels,
    SharedSums,
    by_own_noise,
    grouped,
    held_variance,
    shared_sums,
)
from cannoise_jax.signatures.score import Score, variance_component

AXES = {"row": 2, "column": 1}
"""Axis of a [n, h, w] array that is summed over."""
_SUMS = {"row": ("nij,ij->ni", "ni,ij->nij"), "column": ("nij,ij->nj", "nj,ij->nij")}
"""From pixels and responses to lines, and back."""
_MOST_HELD = 2.0
"""Variance that the modelled noise of one recording may hold of an effect, in units of the fitted one: what a
few frames draw scatters about it."""


def reads_light(scaling: str) -> frozenset[str]:
    """What of the fields beside the frames a factor of the light reads."""
    return frozenset({"signal"}) if scaling == "signal" else frozenset()


def line_point(axis: Line, scaling: str, time: Literal["frozen", "redrawn"]) -> Point:
    """Where what lines share stands in the grammar: a factor of the light, or an offset of the read-out."""
    if scaling == "signal":
        return Point("photons", "mean", axis, time, "multiply")
    return Point("readout", "signal", axis, time)


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
    unit = "DN" if scaling in ("additive", "codes") else "1"
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
        drawn=_draws(information, dof, fit.variance),
    )


def _draws(information: np.ndarray, dof: np.ndarray, variance: float) -> float:
    """Number of draws of equal weight that tell as much of a variance: each weighs by what it tells."""
    weight = (information / (1 + variance * information)) ** 2
    return float(np.sum(dof * weight) ** 2 / max(float(np.sum(dof * weight**2)), 1e-300))


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

    return less_shared(map_contrasts(field, function), axis, through(field, axis, function))


@lru_cache(maxsize=8)
def lines(axis: str, size: tuple[int, int]) -> Groups:
    """The pixels of every row or column."""
    return grouped(np.indices(size)[0 if axis == "row" else 1])


def static_sums(fields: tuple[Fields, ...], axis: str, scaling: str) -> SharedSums | None:
    """Scores of a frozen line pattern shared by all recordings."""
    if not fields:
        return None
    sums = shared_sums(fields, lines(axis, fields[0].mean.shape), scaling, axis)
    if sums is None:
        return None
    total = max(float(np.sum(sums.information)), 1e-30)
    return sums._replace(information=sums.information * (1 - sums.information / total))
