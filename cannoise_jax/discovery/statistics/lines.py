"""Offsets and gains common to a row, a column or a frame: redrawn in every frame, or frozen."""

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


def line_sums(field: Fields, values: np.ndarray, axis: str, scaling: str) -> LineSums:
    """Per line of `values` [n, h, w], after the mean of each field is taken out."""
    r = response(field, scaling).astype(np.float32)
    total = float(np.sum(r.astype(np.float64) ** 2))
    if total == 0:
        return LineSums(np.zeros((len(values), 1)), np.zeros(1))
    frame = np.einsum("nij,ij->n", values, r) / total
    score = np.einsum("nij,ij->ni" if axis == "row" else "nij,ij->nj", values, r).astype(np.float64)
    information = np.sum(r.astype(np.float64) ** 2, axis=AXES[axis] - 1)
    return LineSums(score - frame[:, None] * information, information * (1 - information / total))


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


def temporal_absorb(
    fields: tuple[Fields, ...], score: Score, *, axis: str, scaling: str
) -> tuple[Fields, ...]:
    """Whitens every line: the symmetric inverse root of 1 + v r r^T."""
    return tuple(
        _whiten_lines(f, f.contrasts, axis, scaling, score.payload) if f.lit or scaling == "additive" else f
        for f in fields
    )


def _whiten_lines(field: Fields, values: np.ndarray, axis: str, scaling: str, variance: float) -> Fields:
    """Temporal offsets fall on the static field too, with 1/T of their variance per frame."""

    def function(x: np.ndarray) -> np.ndarray:
        r = response(field, scaling).astype(np.float32)
        subs = ("nij,ij->ni", "ni,ij->nij") if axis == "row" else ("nij,ij->nj", "nj,ij->nij")
        information = np.sum(r.astype(np.float64) ** 2, axis=AXES[axis] - 1)
        shrink = (1 - 1 / np.sqrt(1 + variance * information)) / np.maximum(information, 1e-30)
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
        s = line_sums(f, f.static[None], axis, scaling)
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


def frame_score(fields: tuple[Fields, ...], *, probe: str, scaling: str) -> Score | None:
    """One random offset (or gain) per frame."""
    power, information, dof = [], [], []
    for f in fields:
        if not len(f.contrasts) or (scaling == "relative" and not f.lit):
            continue
        r = response(f, scaling)
        i = float(np.sum(r.astype(np.float64) ** 2))
        if i > 0:
            u = np.einsum("nij,ij->n", f.contrasts, r.astype(np.float32))
            power.append(float(np.sum(u.astype(np.float64) ** 2)) / i)
            information.append(i)
            dof.append(len(f.contrasts))
    if len(power) < 2:
        return None
    return component_score(
        probe, np.array(power), np.array(information), np.array(dof), scaling, {"axis": "frame"}
    )


def frame_absorb(fields: tuple[Fields, ...], score: Score, *, scaling: str) -> tuple[Fields, ...]:
    """Whitens the frame offsets."""
    out = []
    for f in fields:
        if scaling == "relative" and not f.lit:
            out.append(f)
            continue
        r = response(f, scaling).astype(np.float32)
        i = float(np.sum(r.astype(np.float64) ** 2))
        shrink = (1 - 1 / np.sqrt(1 + score.payload * i)) / max(i, 1e-30)
        u = np.einsum("nij,ij->n", f.contrasts, r) * np.float32(shrink)
        out.append(f._replace(contrasts=f.contrasts - u[:, None, None] * r))
    return tuple(out)


def pixel_sums(fields: tuple[Fields, ...], scaling: str, kinds: tuple[str, ...]) -> LineSums | None:
    """Scores of a frozen pixel pattern shared by the recordings of these kinds. scaling 'thermal': per
    second."""
    score: np.ndarray | float = 0.0
    information: np.ndarray | float = 0.0
    for f in fields:
        if f.static is None or f.kind not in kinds or (scaling == "thermal" and not f.exposure_s):
            continue
        r = response(f, "relative" if scaling == "relative" else "additive")
        r = r * np.float32(f.exposure_s) if scaling == "thermal" else r
        score = score + np.sqrt(f.frames) * f.static * r
        information = information + f.frames * r.astype(np.float64) ** 2
    return LineSums(np.asarray(score), np.asarray(information)) if np.ndim(score) else None


ALL_KINDS = ("scene", "flat", "dark", "bias")


def pixel_score(fields: tuple[Fields, ...], *, probe: str, scaling: str) -> Score | None:
    """Frozen white pattern of pixels, the same in every recording."""
    sums = pixel_sums(fields, scaling, ALL_KINDS)
    if sums is None:
        return None
    power = np.ravel(sums.score**2 / np.maximum(sums.information, 1e-30))
    # A few pixels far out are hot or dead pixels, a pattern of their own: they must not stand for a map.
    limit = 30.0
    information = np.where(power < limit, np.ravel(sums.information), 0.0)
    score = component_score(
        probe,
        power,
        information,
        np.ones(power.shape),
        scaling,
        {"axis": "pixel"},
        scale_variance(fields, scaling, ALL_KINDS),
    )
    if scaling != "thermal":
        return score
    # Fitted per second; quoted at the longest exposure.
    seconds = max(f.exposure_s or 0.0 for f in fields)
    sigma, error = score.amplitude * seconds, score.error * seconds
    return score._replace(
        amplitude=sigma, error=error, shift=score.shift * seconds, parameters={"sigma": (sigma, "DN", error)}
    )


def scale_variance(fields: tuple[Fields, ...], scaling: str, kinds: tuple[str, ...]) -> float:
    """Variance of the log of the noise variance under a pooled static map: each field's comes from
    contrasts."""
    shares, errors = [], []
    for f in fields:
        if f.static is None or f.kind not in kinds or (scaling == "thermal" and not f.exposure_s):
            continue
        r = response(f, "relative" if scaling == "relative" else "additive").astype(np.float64)
        r = r * f.exposure_s if scaling == "thermal" and f.exposure_s else r
        shares.append(f.frames * float(np.sum(r**2)))
        errors.append(2 / max(len(f.contrasts), 1) / f.mean.size)
    total = max(sum(shares), 1e-30)
    return float(sum((s / total) ** 2 * e for s, e in zip(shares, errors, strict=True)))


def pixel_absorb(fields: tuple[Fields, ...], score: Score, *, scaling: str) -> tuple[Fields, ...]:
    """Takes the whitening part of the estimated shared map out of every static field."""
    sums = pixel_sums(fields, scaling, ALL_KINDS)
    assert sums is not None
    tau = score.payload * sums.information
    pattern = sums.score * (1 - 1 / np.sqrt(1 + tau)) / np.maximum(sums.information, 1e-30)
    out = []
    for f in fields:
        if f.static is None or (scaling == "thermal" and not f.exposure_s):
            out.append(f)
            continue
        r = response(f, "relative" if scaling == "relative" else "additive")
        r = r * np.float32(f.exposure_s) if scaling == "thermal" else r
        out.append(f._replace(static=(f.static - np.sqrt(f.frames) * pattern * r).astype(np.float32)))
    return tuple(out)


def own_score(fields: tuple[Fields, ...], *, probe: str) -> Score | None:
    """Frozen residual of each scene by itself, not shared: an error of its reference. DN rms."""
    chosen = [f for f in fields if f.kind == "scene" and f.static is not None]
    if not chosen:
        return None
    power = np.concatenate([np.ravel(f.static) ** 2 for f in chosen if f.static is not None])
    information = np.concatenate([np.ravel(f.frames * f.weight.astype(np.float64) ** 2) for f in chosen])
    return component_score(
        probe,
        power,
        information,
        np.ones(power.shape),
        "additive",
        {"axis": "pixel"},
        scale_variance(tuple(chosen), "additive", ALL_KINDS),
    )


def own_absorb(fields: tuple[Fields, ...], score: Score) -> tuple[Fields, ...]:
    """A scene whose reference is wrong says nothing static: its static field is dropped."""
    return tuple(f._replace(static=None) if f.kind == "scene" else f for f in fields)


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
    for scaling, name in (("additive", "offset_drift"), ("relative", "illumination_drift")):
        probe = f"frame_{scaling}"
        out.append(
            Probe(
                probe,
                name,
                {
                    "enters": "readout" if scaling == "additive" else "photons",
                    "varies_over": "frame",
                    "time": "redrawn",
                    "scales": scaling,
                    "law": "white",
                },
                partial(frame_score, probe=probe, scaling=scaling),
                partial(frame_absorb, scaling=scaling),
                SCALES if scaling == "relative" else (),
            )
        )
    for scaling, name in (("additive", "dsnu"), ("relative", "prnu"), ("thermal", "dsnu")):
        probe = f"pixel_{scaling}_static"
        out.append(
            Probe(
                probe,
                name,
                {
                    "enters": "pixel",
                    "varies_over": "pixel",
                    "time": "frozen",
                    "scales": scaling,
                    "law": "white",
                },
                partial(pixel_score, probe=probe, scaling=scaling),
                partial(pixel_absorb, scaling=scaling),
                LEVELS["relative" if scaling == "relative" else "additive"],
            )
        )
    out.append(
        Probe(
            "scene_static",
            "reference_error",
            {
                "enters": "reference",
                "varies_over": "pixel",
                "time": "frozen",
                "scales": "scene",
                "law": "white",
            },
            partial(own_score, probe="scene_static"),
            own_absorb,
            SCALES,
        )
    )
    return tuple(out)
