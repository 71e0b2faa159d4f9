"""The reference of the scenes against their mean: scale, shift, blur and spread."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Literal

import numpy as np

from cannoise_jax.signatures import covariance
from cannoise_jax.signatures.added import strength
from cannoise_jax.signatures.fields import Fields
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
    Axes,
    Signature,
    by_shift,
)

_DOUBT = 1.0
"""Nats by which a camera that blurs is thought likelier than a reference that is blurred, where all else is
equal.
"""


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
        templates = reference_templates(f.clean, span / f.unit, kind)
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
