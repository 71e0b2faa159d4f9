"""Offsets and gains common to a row or a column: redrawn in every frame, or frozen."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from cannoise_jax.discovery.fields import Fields
from cannoise_jax.discovery.statistics.score import Probe, Score, variance_component

AXES = {"row": 2, "column": 1}
"""Axis of a [n, h, w] array that is summed over."""


SCALES = ("reference_scale", "description_scale")


LEVELS = {
    "additive": ("black_channels", "black_level", "greens", "stated_read"),
    "relative": ("greens", "shading", *SCALES),
}
"""Probes of levels, whose standard errors know pixel noise only: a pattern of lines or pixels scatters
channel means by more, so they are set aside once such a pattern is in the model. A shared offset is
part of the fitted read noise too, so a stated read noise is not judged beside it."""


class LineSums(NamedTuple):
    """Scores U and information I of one template per line: U ~ N(0, I) when nothing is there."""

    score: np.ndarray
    information: np.ndarray


def response(field: Fields, scaling: str) -> np.ndarray:
    """What the standardised field answers to a unit effect: 1/sigma (DN) or signal/sigma (fraction)."""
    return field.weight if scaling == "additive" else field.relative


def by_own_noise(score: np.ndarray, information: np.ndarray, total: np.ndarray, count: np.ndarray):
    """Scores scaled to the noise that their own pixels show instead of the modelled one.

    score, total [n, groups]: sum of response times value, and of its square; information [groups]; count:
    pixels of a group. Noise that is uneven or heavy-tailed makes sums of modelled variance 1 vary by more or
    less, which looks like shared offsets. What the sum itself adds to the squares of its pixels is taken out,
    and the mean square stays 1 to order 1/count^2. Returns the scores and how much more the responses tell
    than the modelled noise says, a factor for the information: where a strong offset is part of the modelled
    noise, its amplitude would come out too large without it.
    """
    count = np.maximum(count, 4.0)
    own = (total - (score**2 - information) / count) * (count + 2) / count
    own = np.maximum(own, 0.05 * np.maximum(information, 1e-30))
    noise = max(float(np.sum(own * count / (count + 2))), 1e-30)
    more = float(np.sum(information)) * len(score) / noise
    return score * np.sqrt(information / own * more), more


def own_share(response: np.ndarray, variance: float) -> float:
    """Share of the modelled variance that is a pixel's own: shared offsets of `variance` are in it too."""
    used = response[response > 0]
    return (
        float(np.clip(1 - variance * np.mean(used.astype(np.float64) ** 2), 0.05, 1.0)) if used.size else 1.0
    )


def line_sums(field: Fields, values: np.ndarray, axis: str, scaling: str, own: bool = True) -> LineSums:
    """Per line of `values` [n, h, w], after the mean of each field is taken out; own: see `by_own_noise`."""
    r = response(field, scaling).astype(np.float32)
    total = float(np.sum(r.astype(np.float64) ** 2))
    if total == 0:
        lines = r.shape[0 if axis == "row" else 1]
        return LineSums(np.zeros((len(values), lines)), np.zeros(lines))
    frame = np.einsum("nij,ij->n", values, r) / total
    score = np.einsum("nij,ij->ni" if axis == "row" else "nij,ij->nj", values, r).astype(np.float64)
    information = np.sum(r.astype(np.float64) ** 2, axis=AXES[axis] - 1)
    score = score - frame[:, None] * information
    if own:
        subs = "nij->ni" if axis == "row" else "nij->nj"
        squares = np.einsum(subs, (values * r) ** 2).astype(np.float64)
        count = np.sum(r > 0, axis=AXES[axis] - 1)
        score, more = by_own_noise(score, information, squares, count)
        return LineSums(score, information * (1 - information / total) * more)
    return LineSums(score, information * (1 - information / total))


def line_power(field: Fields, values: np.ndarray, axis: str) -> np.ndarray:
    """Power of the line means of `values` [n, h, w] by frequency, summed over n; white noise: 1 each."""
    sums = line_sums(field, values, axis, "additive")
    x = sums.score / np.sqrt(np.maximum(sums.information, 1e-30))
    return (np.abs(np.fft.rfft(x, axis=1)) ** 2).sum(0) / x.shape[1]


def component_score(probe, power, information, dof, scaling, where, scale_variance=0.0) -> Score:
    """The score of one variance component of offsets (DN) or factors, see `variance_component`."""
    fit = variance_component(power, information, dof, scale_variance)
    sigma = np.sqrt(fit.variance)
    error = fit.error / (2 * sigma) if sigma > 0 else np.sqrt(fit.error)
    unit = "DN" if scaling == "additive" else "1"
    cost = 0.5 * np.log(np.sum(dof))
    return Score(
        probe,
        fit.log_p,
        fit.gain,
        float(cost),
        float(sigma),
        float(error),
        float(np.sqrt(fit.shift)),
        2,
        {"sigma": (float(sigma), unit, float(error))},
        where,
        fit.variance,
    )


def temporal_score(fields: tuple[Fields, ...], *, probe: str, axis: str, scaling: str) -> Score | None:
    """White random offset (or gain) of every line, new in every frame."""
    sums = [
        line_sums(f, f.contrasts, axis, scaling)
        for f in fields
        if len(f.contrasts) and (f.lit or scaling == "additive")
    ]
    sums = [s for s in sums if s.information.max() > 0]
    if not sums:
        return None
    power = np.concatenate([((s.score**2).sum(0) / np.maximum(s.information, 1e-30)) for s in sums])
    information = np.concatenate([s.information for s in sums])
    dof = np.concatenate([np.full(s.information.shape, len(s.score)) for s in sums])
    return component_score(probe, power, information, dof, scaling, {"axis": axis})


def temporal_absorb(
    fields: tuple[Fields, ...], score: Score, *, axis: str, scaling: str
) -> tuple[Fields, ...]:
    """Whitens every line: the symmetric inverse root of 1 + v r r^T."""
    return tuple(
        _whiten_lines(f, f.contrasts, axis, scaling, score.payload) if f.lit or scaling == "additive" else f
        for f in fields
    )


def _whiten_lines(field: Fields, values: np.ndarray, axis: str, scaling: str, variance: float) -> Fields:
    """Temporal offsets fall on the static field too, with 1/T of their variance per frame. What is left to a
    line is what its pixels' own noise gives it."""

    def function(x: np.ndarray) -> np.ndarray:
        r = response(field, scaling).astype(np.float32)
        subs = ("nij,ij->ni", "ni,ij->nij") if axis == "row" else ("nij,ij->nj", "nj,ij->nij")
        information = np.sum(r.astype(np.float64) ** 2, axis=AXES[axis] - 1)
        share = own_share(r, variance)
        shrink = (1 - np.sqrt(share / (share + variance * information))) / np.maximum(information, 1e-30)
        score = np.einsum(subs[0], x, r) * shrink
        return x - np.einsum(subs[1], score.astype(np.float32), r)

    contrasts = function(values)
    static = None if field.static is None else function(field.static[None])[0]
    return field._replace(contrasts=contrasts, static=static)


def static_sums(fields: tuple[Fields, ...], axis: str, scaling: str) -> LineSums | None:
    """Scores of a frozen line pattern shared by all recordings."""
    score: np.ndarray | float = 0.0
    information: np.ndarray | float = 0.0
    for f in fields:
        if f.static is None or (scaling == "relative" and not f.lit):
            continue
        s = line_sums(f, f.static[None], axis, scaling, own=False)
        if s.information.size < 2:
            continue
        score = score + np.sqrt(f.frames) * s.score[0]
        information = information + f.frames * s.information
    return LineSums(np.asarray(score), np.asarray(information)) if np.ndim(score) else None


def static_score(fields: tuple[Fields, ...], *, probe: str, axis: str, scaling: str) -> Score | None:
    """Frozen white pattern of lines, the same in every recording."""
    sums = static_sums(fields, axis, scaling)
    if sums is None:
        return None
    power = sums.score**2 / np.maximum(sums.information, 1e-30)
    largest = np.argsort(-power)[:8]
    where = {"axis": axis, "index": sorted(int(i) for i in largest)}
    return component_score(probe, power, sums.information, np.ones(power.shape), scaling, where)


def static_absorb(fields: tuple[Fields, ...], score: Score, *, axis: str, scaling: str) -> tuple[Fields, ...]:
    """Takes the whitening part of the estimated shared pattern out of every recording's static field."""
    sums = static_sums(fields, axis, scaling)
    assert sums is not None
    tau = score.payload * sums.information
    pattern = sums.score * (1 - 1 / np.sqrt(1 + tau)) / np.maximum(sums.information, 1e-30)
    spread = pattern[:, None] if axis == "row" else pattern[None, :]
    return tuple(
        f
        if f.static is None or (scaling == "relative" and not f.lit)
        else f._replace(
            static=(f.static - np.sqrt(f.frames) * spread * response(f, scaling)).astype(np.float32)
        )
        for f in fields
    )


def probes() -> tuple[Probe, ...]:
    """The probes of this signature."""
    out = []
    for axis in ("row", "column"):
        for scaling in ("additive", "relative"):
            name = {("row", "additive"): "row_noise", ("column", "additive"): "column_noise"}.get(
                (axis, scaling)
            )
            probe = f"{axis}_{scaling}_temporal"
            out.append(
                Probe(
                    probe,
                    name,
                    {
                        "enters": "readout" if scaling == "additive" else "photons",
                        "varies_over": axis,
                        "time": "redrawn",
                        "scales": scaling,
                        "law": "white",
                    },
                    partial(temporal_score, probe=probe, axis=axis, scaling=scaling),
                    partial(temporal_absorb, axis=axis, scaling=scaling),
                    LEVELS[scaling],
                )
            )
            name = {
                ("row", "additive"): "row_fpn",
                ("column", "additive"): "column_fpn",
                ("column", "relative"): "column_gain",
            }.get((axis, scaling))
            probe = f"{axis}_{scaling}_static"
            out.append(
                Probe(
                    probe,
                    name,
                    {
                        "enters": "readout",
                        "varies_over": axis,
                        "time": "frozen",
                        "scales": scaling,
                        "law": "white",
                    },
                    partial(static_score, probe=probe, axis=axis, scaling=scaling),
                    partial(static_absorb, axis=axis, scaling=scaling),
                    LEVELS[scaling],
                )
            )
    return tuple(out)
