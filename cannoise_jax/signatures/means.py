"""Known shapes in the mean: a step in offset, and what all templates in the mean share."""

from __future__ import annotations

from typing import Any

import numpy as np

from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures.added import placed, strength
from cannoise_jax.signatures.answers import as_it_stays
from cannoise_jax.signatures.fields import Fields, channel_index, least_squares
from cannoise_jax.signatures.handed import Many
from cannoise_jax.signatures.least import (
    Law,
    Seen,
    template,
)
from cannoise_jax.signatures.line_sums import static_sums
from cannoise_jax.signatures.score import KNOWN_SHAPE, Score, normal_log_p, sidak
from cannoise_jax.signatures.signature import BY_SHIFT, NO_LAW, OFFSETS, STATIC, Axes, Signature


def project(field: Fields, template: np.ndarray) -> np.ndarray:
    """Standardised template with what the recording's own mean fit takes away removed."""
    w = field.weight.astype(np.float64)
    channel = channel_index(w.shape)
    out = np.zeros(w.shape)
    for c in range(4):
        chosen = channel == c
        basis = [w[chosen]]
        if field.kind == "scene" and field.clean is not None:
            basis.append(w[chosen] * field.clean[chosen])
        b = np.stack(basis, 1)
        t = template[chosen] * w[chosen]
        out[chosen] = t - np.einsum("nk,k->n", b, least_squares(b, t))
    return out


def linear_score(
    pairs: list[tuple[Fields, np.ndarray]], *, name: str, unit: str, where: dict, payload: Any = None
) -> Score:
    """One amplitude of either sign for known standardised templates in the static fields of several
    recordings."""
    u = sum(float(np.sum(f.static * t)) * np.sqrt(f.frames) for f, t in pairs if f.static is not None)
    i = max(sum(float(np.sum(t**2)) * f.frames for f, t in pairs), 1e-30)
    z, amplitude, error = u / np.sqrt(i), u / i, 1 / np.sqrt(i)
    return Score(
        log_p=normal_log_p(z),
        gain=0.5 * z**2,
        penalty=KNOWN_SHAPE,
        amplitude=abs(amplitude),
        error=error,
        shift=error,
        power=1,
        parameters={name: (amplitude, unit, error)},
        where=where,
        payload=payload,
    )


def minus(field: Fields, standardised: np.ndarray) -> Fields:
    """The field with a standardised mean template taken out of its static part."""
    assert field.static is not None
    return field._replace(static=(field.static - np.sqrt(field.frames) * standardised).astype(np.float32))


def less_offsets(fields: tuple[Fields, ...], image: np.ndarray) -> tuple[Fields, ...]:
    """The fields with an image of offsets, DN, taken out of what stays in every recording."""
    return tuple(f if f.static is None else minus(f, project(as_it_stays(f), image)) for f in fields)


def step_score(fields: tuple[Fields, ...]) -> Score[tuple[str, float, float]] | None:
    """A step in offset between two regions: the boundary is looked for along rows and along columns."""
    dark = tuple(f for f in fields if f.kind in DARK and f.static is not None)
    if not dark:
        return None
    best: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    axis_best = "column"
    trials = 0.0
    for axis in ("row", "column"):
        sums = static_sums(dark, axis, "additive")
        if sums is None:
            continue
        total = max(float(sums.information.sum()), 1e-30)
        u, i = np.cumsum(sums.score[::-1])[::-1], np.cumsum(sums.information[::-1])[::-1]
        i = i * (1 - i / total)
        inside = np.arange(8, u.size - 8)
        inside = inside[i[inside] > 1e-6 * total]  # lines at the border may have no usable pixel
        if not inside.size:
            continue
        trials += u.size / 8
        z = u[inside] / np.sqrt(np.maximum(i[inside], 1e-30))
        k = int(np.argmax(np.abs(z)))
        if abs(z[k]) > abs(best[0]):
            best, axis_best = (
                (z[k], float(inside[k]), u[inside[k]] / i[inside[k]], 1 / np.sqrt(i[inside[k]])),
                axis,
            )
    z, at, step, error = best
    if not error:
        return None
    where = {"axis": axis_best, "index": [int(at)]}
    return Score(
        log_p=sidak(normal_log_p(z), trials),
        gain=0.5 * z**2,
        penalty=float(np.log(trials)),
        amplitude=abs(step),
        error=error,
        shift=error,
        power=1,
        parameters={"step": (step, "DN", error), "boundary": (at, "px", 1.0)},
        where=where,
        payload=(axis_best, at, step),
        spot={"boundary": (at, 4.0)},
    )


def step_absorb(fields: tuple[Fields, ...], score: Score[tuple[str, float, float]]) -> tuple[Fields, ...]:
    """Subtracts the step from every static field."""
    axis, at, step = score.payload
    rows, columns = np.indices(fields[0].mean.shape)
    template = np.where((rows if axis == "row" else columns) >= at, step, 0.0)
    # A step is one of lines, and answers as they do.
    return tuple(f if f.static is None else minus(f, project(as_it_stays(f, axis), template)) for f in fields)


def halves(*, name: str, parameter: str, covers: tuple[str, ...]) -> Signature:
    """A step in offset at a boundary that is looked for."""

    def pattern(fields: Many, score: Score, rng: np.random.Generator) -> np.ndarray:
        axis, at, step = score.payload
        size = fields[0].mean.shape
        half = np.where(np.arange(size[0 if axis == "row" else 1]) >= at, 0.5, -0.5) * np.sign(step)
        return half[:, None] if axis == "row" else half[None, :]

    def least(sets: tuple[Seen, ...]) -> Law:
        width = sets[0].weight.shape[1]
        return template(
            sets, lambda s: np.broadcast_to((np.arange(width) >= width // 2) - 0.5, s.weight.shape)
        )

    return Signature(
        name=name,
        axes=Axes("readout", "amplifier", "frozen", "additive", "step"),
        reads=STATIC,
        score=step_score,
        absorb=step_absorb,
        covers=covers,
        predict=NO_LAW,
        pattern=pattern,
        simulate=strength(parameter, unit_map=True),
        place=placed(OFFSETS, unit_map=True),
        detectable=BY_SHIFT,
        least=least,
    )
