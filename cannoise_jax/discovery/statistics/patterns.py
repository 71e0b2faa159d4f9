"""Offsets and gains common to a frame, and frozen ones of single pixels."""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy import stats

from cannoise_jax.discovery.fields import Fields
from cannoise_jax.discovery.statistics.lines import (
    LEVELS,
    SCALES,
    LineSums,
    Pixels,
    by_own_noise,
    component_score,
    response,
)
from cannoise_jax.discovery.statistics.score import Probe, Score

ALL_KINDS = ("scene", "flat", "dark", "bias")


def frame_score(fields: tuple[Fields, ...], *, probe: str, scaling: str) -> Score | None:
    """One random offset (or gain) per frame."""
    power, information, dof = [], [], []
    for f in fields:
        if not len(f.contrasts) or (scaling == "relative" and not f.lit):
            continue
        r = response(f, scaling)
        i = float(np.sum(r.astype(np.float64) ** 2))
        if i > 0:
            u = np.einsum("nij,ij->n", f.contrasts, r.astype(np.float32)).astype(np.float64)
            rest = f.contrasts - (u / i).astype(np.float32)[:, None, None] * r
            within = np.einsum("nij->n", (rest * r) ** 2).astype(np.float64)
            pixels = Pixels(np.array([i]), np.array([np.sum(r.astype(np.float64) ** 4)]), within[:, None])
            u, more = by_own_noise(u[:, None], pixels, np.array([float(np.sum(r > 0))]))
            u, i = u[:, 0], i * float(more[0])
            power.append(float(np.sum(u.astype(np.float64) ** 2)) / i)
            information.append(i)
            dof.append(len(f.contrasts))
    # One recording alone cannot say how what its frames share scales: another has to lack it, or show less.
    if not power or sum(len(f.contrasts) > 0 for f in fields) < 2:
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


def pixel_score(fields: tuple[Fields, ...], *, probe: str, scaling: str) -> Score | None:
    """Frozen white pattern of pixels, the same in every recording."""
    sums = pixel_sums(fields, scaling, ALL_KINDS)
    if sums is None or (scaling == "relative" and not any(f.lit and f.static is not None for f in fields)):
        return None
    power = np.ravel(sums.score**2 / np.maximum(sums.information, 1e-30))
    # A few pixels far out are hot or dead pixels, a pattern of their own: they must not stand for a map. A
    # map far above the noise puts every pixel out.
    seen = power[np.ravel(sums.information) > 0]
    bulk = float(np.median(seen)) / stats.chi2.median(1) if seen.size else 1.0
    limit = 30.0 * (bulk if bulk > 2 else 1.0)
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
    if sums is None:  # no recording of the kind that shows it
        return fields
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
