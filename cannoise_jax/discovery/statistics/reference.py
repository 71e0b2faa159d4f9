"""The reference of the scenes against their mean: scale, shift, blur and spread."""

from __future__ import annotations

from functools import partial

import numpy as np

from cannoise_jax.discovery.fields import Fields, channel_index
from cannoise_jax.discovery.statistics import covariance
from cannoise_jax.discovery.statistics.means import project
from cannoise_jax.discovery.statistics.score import Probe, Score, chi2_log_sf, normal_log_p, unchanged

_SCENE = (
    "reference_shift",
    "reference_blur",
    "reference_spread",
    "scene_static",
    "curvature",
    "reference_scale",
    "description_scale",
)


def scale_score(fields: tuple[Fields, ...], *, probe: str, span: float, common: bool) -> Score | None:
    """Slope of every scene's mean against its reference: what all scenes share is an error of the description
    (white level, units), what they differ in one of the references."""
    values, errors, levels = [], [], []
    for f in fields:
        if f.kind != "scene" or f.static is None or f.clean is None:
            continue
        channel = channel_index(f.mean.shape)
        u = i = 0.0
        for c in range(4):
            chosen = (channel == c) & f.usable
            weight = f.weight[chosen].astype(np.float64) ** 2
            if weight.sum() == 0:
                continue
            x = f.clean[chosen] - np.average(f.clean[chosen], weights=weight)
            full = f.frames * np.sum(weight * x**2)
            if full > 0:
                slope = float(np.sum(weight * x * f.mean[chosen]) / np.sum(weight * x**2)) / span
                u, i = u + (slope - 1) * full * span**2, i + full * span**2
        if i > 0:
            values.append(u / i)
            errors.append(1 / np.sqrt(i))
            levels.append(float(np.sqrt(np.mean(f.signal**2))))
    if not values or (len(values) < 2 and not common):
        return None
    v, e = np.array(values), np.array(errors)
    mean = float(np.average(v, weights=1 / e**2))
    error = float(1 / np.sqrt(np.sum(1 / e**2)))
    level = float(np.mean(levels))
    if common:
        # The scatter between references bounds what is common to them.
        chi2 = float(np.sum(((v - mean) / e) ** 2))
        error *= max(np.sqrt(chi2 / max(len(v) - 1, 1)), 1.0)
        z = mean / error
        return Score(
            probe,
            normal_log_p(z),
            0.5 * z**2,
            5.0,
            abs(mean) * level,
            error * level,
            error * level,
            1,
            {"scale": (mean, "1", error)},
            {"axis": "signal", "range": [0.0, 1.0]},
        )
    chi2 = float(np.sum(((v - mean) / e) ** 2))
    k = int(np.argmax(np.abs(v - mean) / e))
    worst = float(np.std(v - mean)) * level
    return Score(
        probe,
        chi2_log_sf(chi2, len(v) - 1),
        chi2 / 2,
        2.5 * (len(v) - 1),
        worst,
        float(e[k]) * level,
        float(e[k]) * level,
        1,
        {"scale": (float(v[k]), "1", float(e[k]))},
        {"axis": "signal", "range": [0.0, 1.0]},
    )


def reference_templates(clean: np.ndarray, span: float, kind: str) -> list[np.ndarray]:
    """Change of the mean, DN, per unit: a shift of one pixel (down, right), or blur within the colour
    plane."""
    p = np.pad(clean.astype(np.float64), 2, mode="reflect")
    h, w = clean.shape
    up, down, left, right = p[:h, 2 : 2 + w], p[4:, 2 : 2 + w], p[2 : 2 + h, :w], p[2 : 2 + h, 4:]
    if kind == "shift":
        return [(down - up) / 4 * span, (right - left) / 4 * span]
    if kind == "blur":
        return [(up + down + left + right - 4 * clean) / 4 * span]
    p = np.pad(clean.astype(np.float64), 1, mode="reflect")
    return [
        (p[:h, 1 : 1 + w] + p[2:, 1 : 1 + w] + p[1 : 1 + h, :w] + p[1 : 1 + h, 2:] - 4 * clean) / 4 * span
    ]


def reference_score(fields: tuple[Fields, ...], *, probe: str, kind: str, span: float) -> Score | None:
    """Scenes against the derivatives of their references: a shift or blur per scene, crosstalk common
    to all."""
    chosen = [f for f in fields if f.kind == "scene" and f.static is not None and f.clean is not None]
    if not chosen:
        return None
    chi2, dof, values, errors, changes = 0.0, 0, [], [], []
    shared_u = shared_i = 0.0
    for f in chosen:
        assert f.clean is not None and f.static is not None
        templates = reference_templates(f.clean, span, kind)
        t = np.array([project(f, g).ravel() for g in templates]) * np.sqrt(f.frames)
        changes.append(float(np.sqrt(np.mean(np.square(templates)))))
        normal = np.einsum("kn,ln->kl", t, t)
        u = np.einsum("kn,n->k", t, f.static.ravel().astype(np.float64))
        if kind == "crosstalk":
            shared_u, shared_i = shared_u + float(u[0]), shared_i + float(normal[0, 0])
            continue
        beta = np.linalg.lstsq(normal, u, rcond=None)[0]
        chi2 += float(u @ beta)
        dof += len(beta)
        values.append(float(np.hypot(*beta)) if len(beta) == 2 else float(abs(beta[0])))
        errors.append(float(np.sqrt(np.trace(np.linalg.pinv(normal)) / len(beta))))
    unit = "px" if kind == "shift" else "1"
    where = {"axis": "edge", "edge": kind, "recordings": [f.name for f in chosen]}
    if kind == "crosstalk":
        z = shared_u / np.sqrt(shared_i)
        error = float(1 / np.sqrt(shared_i))
        return Score(
            probe,
            normal_log_p(z),
            0.5 * z**2,
            5.0,
            abs(shared_u / shared_i),
            error,
            error,
            1,
            {"fraction": (shared_u / shared_i, "1", error)},
            where,
            float(np.sqrt(np.mean(np.square(changes)))),
        )
    k = int(np.argmax(values))
    return Score(
        probe,
        chi2_log_sf(chi2, dof),
        chi2 / 2,
        2.5 * dof,
        values[k],
        errors[k],
        errors[k],
        1,
        {kind: (values[k], unit, errors[k])},
        where,
        changes[k],
    )


def quoted(score: Score, mechanism: str) -> Score:
    """A blur that is read as an error of the reference in the unit of that: rms change of the reference, DN.
    As a blur by the camera its amplitude is the share that is given away."""
    if mechanism != "reference_error" or score.probe not in ("reference_blur", "reference_spread"):
        return score
    rms = score.payload
    return score._replace(amplitude=score.amplitude * rms, error=score.error * rms, shift=score.shift * rms)


def drop_scenes(fields: tuple[Fields, ...], score: Score) -> tuple[Fields, ...]:
    """A scene whose reference is wrong says nothing static."""
    return tuple(f._replace(static=None) if f.kind == "scene" else f for f in fields)


def drop_blurred(fields: tuple[Fields, ...], score: Score) -> tuple[Fields, ...]:
    """Drops the scenes' static fields and whitens the correlation that a blur inside the camera leaves."""
    template, law = (
        ("crosstalk", "shot") if score.probe == "reference_spread" else ("in_camera_denoising", "white")
    )
    return covariance.absorb(
        drop_scenes(fields, score), score._replace(payload=(template, law, score.amplitude))
    )


def probes(span: float) -> tuple[Probe, ...]:
    """The probes of this signature."""
    frozen = {"time": "frozen"}
    return (
        Probe(
            "reference_scale",
            "reference_error",
            {**frozen, "enters": "reference", "varies_over": "frame", "scales": "signal", "law": "scale"},
            partial(scale_score, probe="reference_scale", span=span, common=False),
            unchanged,
            ("reference_scale", "description_scale"),
        ),
        Probe(
            "description_scale",
            "bookkeeping",
            {**frozen, "enters": "reference", "varies_over": "channel", "scales": "signal", "law": "scale"},
            partial(scale_score, probe="description_scale", span=span, common=True),
            unchanged,
            ("reference_scale", "description_scale"),
        ),
        Probe(
            "reference_shift",
            "misregistration",
            {**frozen, "enters": "reference", "varies_over": "edge", "scales": "signal", "law": "shift"},
            partial(reference_score, probe="reference_shift", kind="shift", span=span),
            drop_scenes,
            _SCENE,
        ),
        Probe(
            "reference_blur",
            "reference_error",
            {**frozen, "enters": "reference", "varies_over": "edge", "scales": "signal", "law": "blur"},
            partial(reference_score, probe="reference_blur", kind="blur", span=span),
            drop_blurred,
            (*_SCENE, "lags_in_camera_denoising", "lags_in_camera_denoising_8"),
        ),
        Probe(
            "reference_spread",
            "crosstalk",
            {**frozen, "enters": "pixel", "varies_over": "edge", "scales": "signal", "law": "spread"},
            partial(reference_score, probe="reference_spread", kind="crosstalk", span=span),
            drop_blurred,
            (*_SCENE, "lags_crosstalk"),
        ),
    )
