"""Signatures of offsets and gains common to a row or a column that stay, the same in every recording."""

from __future__ import annotations

from functools import partial

import numpy as np

from cannoise_jax.signatures.added import draw, placed, posterior, strength
from cannoise_jax.signatures.answers import along_fields, less_lines
from cannoise_jax.signatures.behind_gain import behind_gain
from cannoise_jax.signatures.fields import Fields, quoted_at
from cannoise_jax.signatures.handed import Many, Predicted
from cannoise_jax.signatures.least import random_offsets
from cannoise_jax.signatures.line_sums import (
    Line,
    component_score,
    line_point,
    lines,
    reads_light,
    static_sums,
)
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    NO_CLOSED_FORM,
    NOT_SIMULATED,
    STATIC,
    Axes,
    Scales,
    Signature,
)


def static_score(fields: tuple[Fields, ...], *, axis: str, scaling: str) -> Score[float] | None:
    """Frozen white pattern of lines, the same in every recording. axis: of `answers`."""
    sums = static_sums(fields, axis, scaling)
    if sums is None:
        return None
    power = sums.score**2 / np.maximum(sums.information, 1e-30)
    largest = np.argsort(-power)[:8]
    where = {"axis": "row" if axis == "row" else "column", "index": sorted(int(i) for i in largest)}
    score = component_score(power, sums.information, np.ones(power.shape), scaling=scaling, where=where)
    if scaling != "exposure":
        return score
    seconds = quoted_at(fields, scaling)
    sigma, error = score.amplitude * seconds, score.error * seconds
    return score.replace(
        amplitude=sigma, error=error, shift=score.shift * seconds, parameters={"sigma": (sigma, "DN", error)}
    )


def static_absorb(
    fields: tuple[Fields, ...], score: Score[float], *, axis: str, scaling: str
) -> tuple[Fields, ...]:
    """Takes the whitening part of the estimated shared pattern out of every recording's static field."""
    sums = static_sums(fields, axis, scaling)
    if sums is None:  # no recording of the kind that shows it
        return fields
    groups = lines(axis, fields[0].mean.shape)
    kept, noise = sums.kept, sums.noise
    along = along_fields(fields, axis, scaling)
    information = groups.sums(along(scaling) * kept) / noise
    share = (1 - 1 / np.sqrt(1 + score.payload * information)) / np.maximum(information, 1e-30)

    def taken(values: np.ndarray) -> np.ndarray:
        of_lines = values if values.ndim == 1 else groups.sums(values * kept) / noise
        return (of_lines * share)[groups.of]

    return less_lines(fields, axis, scaling, along=along, taken=taken, score=sums.score, told=(kept, noise))


def frozen(
    axis: Line,
    scaling: Scales,
    *,
    name: str,
    parameter: str | None = None,
    covers: tuple[str, ...],
) -> Signature:
    """White offsets (or gains, or offsets that grow with the exposure, or that no gain changes) of lines that
    stay. parameter: the mechanism's strength."""
    growing, of_codes = scaling == "exposure", scaling == "codes"
    shape = (-1, 1) if axis == "row" else (1, -1)
    simulate = strength(parameter) if parameter else NOT_SIMULATED
    place = placed(line_point(axis, scaling, "frozen"), by_exposure=growing)

    def predict(fields: Many, score: Score) -> Predicted | None:
        sums, seconds = static_sums(fields, axis, scaling), quoted_at(fields, scaling)
        if sums is None or not seconds:
            return None
        mean, doubt = posterior(sums.score, sums.information, (score.amplitude / seconds) ** 2)
        return Predicted(scaling, mean.reshape(shape), doubt.reshape(shape))

    def pattern(fields: Many, score: Score, rng: np.random.Generator) -> np.ndarray | None:
        sums, seconds = static_sums(fields, axis, scaling), quoted_at(fields, scaling)
        if sums is None or not seconds:
            return None
        variance = (score.amplitude / seconds) ** 2
        return draw(sums.score, sums.information, variance, rng).reshape(shape) * seconds

    return Signature(
        name=name,
        kin=axis,
        axes=Axes("readout", axis, "frozen", scaling, "white"),
        reads=STATIC | reads_light(scaling),
        score=partial(static_score, axis=axis, scaling=scaling),
        absorb=partial(static_absorb, axis=axis, scaling=scaling),
        covers=covers,
        predict=predict,
        pattern=pattern,
        simulate=behind_gain(simulate) if of_codes else simulate,
        place=behind_gain(place) if of_codes else place,
        detectable=BY_SHIFT,
        least=NO_CLOSED_FORM if growing or of_codes else random_offsets(axis, scaling, frozen=True),
        drawn_once=True,
        map_of=(axis, scaling),
    )
