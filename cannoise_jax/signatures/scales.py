"""The scale of references against the mean of their scenes: of the description, or of single ones."""

from __future__ import annotations

from functools import partial

import numpy as np

from cannoise_jax.recordings.packing import SITES
from cannoise_jax.signatures.fields import Fields, channel_index
from cannoise_jax.signatures.handed import Addition
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
    unchanged,
)


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
        parts += _by_direction(f, span / f.unit)
        channel, own = channel_index(f.mean.shape), span / f.unit
        u = i = 0.0
        for c in range(4):
            chosen = (channel == c) & f.usable
            weight = f.weight[chosen].astype(np.float64) ** 2
            if weight.sum() == 0:
                continue
            x = f.clean[chosen] - np.average(f.clean[chosen], weights=weight)
            full = f.frames * np.sum(weight * x**2)
            if full > 0:
                slope = float(np.sum(weight * x * f.mean[chosen]) / np.sum(weight * x**2)) / own
                u, i = u + (slope - 1) * full * own**2, i + full * own**2
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
