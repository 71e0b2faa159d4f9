"""The reference of the scenes against their mean: scale, shift, blur and spread."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Literal

import numpy as np

from cannoise_jax.recordings.packing import SITES
from cannoise_jax.signatures import covariance
from cannoise_jax.signatures.added import strength
from cannoise_jax.signatures.fields import Fields, channel_index
from cannoise_jax.signatures.means import project
from cannoise_jax.signatures.off_reference import drop_blurred, drop_scenes, near_filter
from cannoise_jax.signatures.recorded import Recorded
from cannoise_jax.signatures.score import ONE_OF_SEVERAL, ONE_PARAMETER, Score, chi2_log_sf, normal_log_p
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    NO_CLOSED_FORM,
    NO_LAW,
    NO_PATTERN,
    NO_PLACE,
    NOT_SIMULATED,
    STATIC,
    Addition,
    Axes,
    Signature,
    by_shift,
    unchanged,
)

_DOUBT = 1.0
"""Nats by which a camera that blurs is thought likelier than a reference that is blurred, where all else is
equal.
"""


def scale_score(
    fields: tuple[Fields, ...], *, span: float, common: bool, rounded: float = 0.0
) -> Score | None:
    """Slope of every scene's mean against its reference: what all scenes share is an error of the description
    (white level, units), what they differ in one of the references. rounded: how far the stated black level,
    from which the reference counts, may be rounded, DN."""
    values, errors, levels = [], [], []
    parts: list[tuple[float, float]] = []
    for f in fields:
        if f.kind != "scene" or f.static is None or f.clean is None:
            continue
        parts += _by_direction(f, span)
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
        # The scatter between references bounds what is common to them, and that between rows, columns and
        # what is left of them what is common to a scene: a wrong scale is of all light.
        chi2 = float(np.sum(((v - mean) / e) ** 2))
        error *= max(np.sqrt(chi2 / max(len(v) - 1, 1)), _scatter(parts), 1.0)
        z = max(abs(mean) - rounded / span, 0.0) / error
        return Score(
            log_p=normal_log_p(z),
            gain=0.5 * z**2,
            penalty=ONE_PARAMETER,
            amplitude=abs(mean) * level,
            error=error * level,
            shift=error * level,
            power=1,
            parameters={"scale": (mean, "1", error)},
            where={"axis": "signal", "range": [0.0, 1.0]},
        )
    chi2 = float(np.sum(((v - mean) / e) ** 2))
    k = int(np.argmax(np.abs(v - mean) / e))
    worst = float(np.std(v - mean)) * level
    return Score(
        log_p=chi2_log_sf(chi2, len(v) - 1),
        gain=chi2 / 2,
        penalty=ONE_OF_SEVERAL * (len(v) - 1),
        amplitude=worst,
        error=float(e[k]) * level,
        shift=float(e[k]) * level,
        power=1,
        parameters={"scale": (float(v[k]), "1", float(e[k]))},
        where={"axis": "signal", "range": [0.0, 1.0]},
    )


def _by_direction(field: Fields, span: float) -> list[tuple[float, float]]:
    """Slope of a scene against its reference, less one, and its standard error: of the means of its rows, of
    its columns, and of what is left."""
    assert field.clean is not None and field.static is not None
    mean = field.mean + field.static * field.sigma / np.float32(np.sqrt(field.frames))
    sums = np.zeros((3, 3))
    for at in SITES:
        used = field.usable[at]
        weight = np.where(used, field.weight[at].astype(np.float64) ** 2, 0.0)
        if weight.sum() == 0:
            continue
        light = span * field.clean[at].astype(np.float64)
        rest = mean[at] - light
        light, rest = (np.where(used, v - np.average(v, weights=weight), 0.0) for v in (light, rest))
        rows, columns = (
            np.broadcast_to(
                light.sum(a, keepdims=True) / np.maximum(used.sum(a, keepdims=True), 1), light.shape
            )
            for a in (1, 0)
        )
        for k, part in enumerate((rows, columns, light - rows - columns)):
            sums[k] += [float(np.sum(weight * part * v)) for v in (rest, light, part)]
    return [
        (of_rest / of_light, float(np.sqrt(own / field.frames)) / of_light)
        for of_rest, of_light, own in sums
        if of_light > 0
    ]


def _scatter(parts: list[tuple[float, float]]) -> float:
    """How much more slopes scatter about their mean than their errors say."""
    if len(parts) < 2:
        return 1.0
    v, e = np.array(parts).T
    chi2 = float(np.sum(((v - np.average(v, weights=e**-2)) / e) ** 2))
    return float(np.sqrt(chi2 / (len(v) - 1)))


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


def reference_score(fields: tuple[Fields, ...], *, kind: str, span: float, edge: str) -> Score[float] | None:
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
        if kind == "spread":
            shared_u, shared_i = shared_u + float(u[0]), shared_i + float(normal[0, 0])
            continue
        beta = np.linalg.lstsq(normal, u, rcond=None)[0]
        chi2 += float(u @ beta)
        dof += len(beta)
        values.append(float(np.hypot(*beta)) if len(beta) == 2 else float(abs(beta[0])))
        errors.append(float(np.sqrt(np.trace(np.linalg.pinv(normal)) / len(beta))))
    unit = "px" if kind == "shift" else "1"
    where = {"axis": "edge", "edge": edge, "recordings": [f.name for f in chosen]}
    if kind == "spread":
        z = shared_u / np.sqrt(shared_i)
        error = float(1 / np.sqrt(shared_i))
        return Score(
            log_p=normal_log_p(z),
            gain=0.5 * z**2,
            penalty=ONE_PARAMETER,
            amplitude=abs(shared_u / shared_i),
            error=error,
            shift=error,
            power=1,
            parameters={"fraction": (shared_u / shared_i, "1", error)},
            where=where,
            payload=float(np.sqrt(np.mean(np.square(changes)))),
        )
    k = int(np.argmax(values))
    return Score(
        log_p=chi2_log_sf(chi2, dof),
        gain=chi2 / 2,
        penalty=ONE_OF_SEVERAL * dof,
        amplitude=values[k],
        error=errors[k],
        shift=errors[k],
        power=1,
        parameters={kind: (values[k], unit, errors[k])},
        where=where,
        payload=changes[k],
    )


def scaled(recorded: Recorded, *, name: str, common: bool, covers: tuple[str, ...]) -> Signature:
    """A wrong scale: of the description (`common` to all scenes), or of single references."""
    return Signature(
        name=name,
        axes=Axes("reference", "channel" if common else "frame", "frozen", "signal", "scale"),
        reads=STATIC | {"mean", "signal"},
        score=partial(scale_score, span=recorded.span, common=common, rounded=recorded.tolerance),
        absorb=unchanged,
        covers=covers,
        predict=NO_LAW,
        pattern=NO_PATTERN,
        simulate=(lambda found: Addition(bare=True, fitted_black=True)) if common else NOT_SIMULATED,
        place=NO_PLACE,
        detectable=BY_SHIFT,
        least=NO_CLOSED_FORM,
    )


def moved(recorded: Recorded, *, name: str, covers: tuple[str, ...]) -> Signature:
    """References that are shifted."""
    return Signature(
        name=name,
        axes=Axes("reference", "edge", "frozen", "signal", "shift"),
        reads=STATIC,
        score=partial(reference_score, kind="shift", span=recorded.span, edge="shift"),
        absorb=drop_scenes,
        covers=covers,
        predict=NO_LAW,
        pattern=NO_PATTERN,
        simulate=NOT_SIMULATED,
        place=NO_PLACE,
        detectable=BY_SHIFT,
        least=NO_CLOSED_FORM,
        off=near_filter,
        speaks_for=frozenset({"scene"}),
    )


def blurred(
    recorded: Recorded,
    kind: Literal["blur", "spread"],
    *,
    name: str,
    error: str,
    camera: str,
    parameter: str,
    partner: str,
    template: covariance.Template,
    covers: tuple[str, ...],
) -> Signature:
    """Scenes that are blurred against their references, within each colour ('blur') or over the neighbours of
    the mosaic ('spread'): by the reference, mechanism `error`, or by the `camera`, which then correlates the
    noise as well: `partner` is the signature of that, `template` its lags."""

    def readings(score: Score, scores: Mapping[str, Score]) -> tuple[tuple[str | None, float], ...]:
        """The noise correlation that goes with the fitted blur decides who did it."""
        out: list[tuple[str | None, float]] = [(error, score.evidence - _DOUBT)]
        other = scores.get(partner)
        if other is not None:
            measured, doubt = next(iter(other.parameters.values()))[0], other.error
            z, shift = measured / doubt, score.amplitude / doubt
            out.append((camera, score.evidence + z * shift - 0.5 * shift**2))
        return tuple(out)

    def quoted(score: Score[float], mechanism: str) -> Score[float]:
        """As an error of the reference in the unit of that: rms change of the reference, DN. As a blur by the
        camera its amplitude is the share that is given away."""
        if mechanism != error:
            return score
        rms = score.payload
        return score.replace(
            amplitude=score.amplitude * rms, error=score.error * rms, shift=score.shift * rms
        )

    law, edge = ("shot", camera) if kind == "spread" else ("white", kind)
    return Signature(
        name=name,
        axes=Axes("pixel" if kind == "spread" else "reference", "edge", "frozen", "signal", kind),
        reads=STATIC,
        score=partial(reference_score, kind=kind, span=recorded.span, edge=edge),
        absorb=lambda fields, score: drop_blurred(fields, score, template, law),
        covers=covers,
        readings=readings,
        reads_as=(error, camera),
        predict=NO_LAW,
        pattern=NO_PATTERN,
        simulate=lambda found: strength(parameter)(found) if found.mechanism == camera else None,
        place=NO_PLACE,
        detectable=by_shift(quoted),
        least=NO_CLOSED_FORM,
        quoted=quoted,
        off=near_filter,
        speaks_for=frozenset({"scene"}),
    )
