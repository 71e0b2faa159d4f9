"""Signatures of offsets and gains common to a row or a column, redrawn in every frame."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, cast

import numpy as np

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.signatures.added import placed, strength
from cannoise_jax.signatures.answers import turns
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.group_sums import LineSums
from cannoise_jax.signatures.handed import Addition, Found, Many, Predicted, Series
from cannoise_jax.signatures.least import random_offsets
from cannoise_jax.signatures.line_sums import (
    Line,
    component_score,
    line_point,
    line_sums,
    reads_light,
    whiten_lines,
)
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    CONTRASTS,
    NO_LAW,
    NO_PATTERN,
    NOT_SIMULATED,
    Axes,
    Scales,
    Signature,
)
from cannoise_jax.signatures.together import (
    ALONE,
    ARRANGEMENTS,
    LEAST_GAIN,
    Together,
    folded,
    summed,
    unfolded,
)


class Shared(NamedTuple):
    """Variance that lines share, and which of them have one number in common."""

    variance: float
    together: Together = ALONE


def temporal_score(
    fields: tuple[Fields, ...], *, axis: str, scaling: str, together: Together | None = None
) -> Score[Shared] | None:
    """White random offset (or gain) of every line, new in every frame. Rows may be read together: which is
    told by what it explains, and is as given where the finding is looked for again. Whether there is anything
    is told by lines alone, whatever shares a number."""
    sums = [
        line_sums(f, f.contrasts, axis, scaling)
        for f in fields
        if len(f.contrasts) and (f.lit or scaling == "additive")
    ]
    sums = [s for s in sums if s.information.max() > 0]
    if not sums:
        return None
    alone = _shared_score(sums, axis, scaling, ALONE)
    if together is None:
        best = alone
        if axis == "row" and scaling == "additive":
            best = _read_in_groups(alone, [_shared_score(sums, axis, scaling, t) for t in ARRANGEMENTS])
    else:
        best = _shared_score(sums, axis, scaling, together)
    chosen = 0.0 if best.payload.together == ALONE else float(np.log(1 + len(ARRANGEMENTS)))
    return best.replace(log_p=alone.log_p, shift=alone.shift, penalty=best.penalty + chosen)


def _read_in_groups(alone: Score[Shared], groups: list[Score[Shared]]) -> Score[Shared]:
    """The arrangement that explains rows best, or rows by themselves: where they wander slowly, groups gain
    wherever the first begins, and are none."""
    best = max(groups, key=lambda s: s.gain)
    phases = [s.gain for s in groups if s.payload.together.rows == best.payload.together.rows]
    more = best.gain - alone.gain
    return best if more > LEAST_GAIN and min(phases) - alone.gain < 0.5 * more else alone


def _shared_score(sums: list[LineSums], axis: str, scaling: str, together: Together) -> Score[Shared]:
    sums = [summed(s, together) for s in sums]
    # The mean of the lines is taken out: their squares hold one degree of freedom less than there are lines.
    left = [1 - 1 / max(int(np.sum(s.information > 0)), 2) for s in sums]
    power = [(s.score**2).sum(0) / np.maximum(s.information, 1e-30) for s in sums]
    found = component_score(
        np.concatenate([n * p for n, p in zip(left, power, strict=True)]),
        np.concatenate([s.information / n for n, s in zip(left, sums, strict=True)]),
        np.concatenate(
            [np.full(p.shape, n * len(s.score)) for n, p, s in zip(left, power, sums, strict=True)]
        ),
        scaling=scaling,
        where={"axis": axis, **together.describes()},
    )
    return cast(Score[Shared], found.replace(payload=Shared(found.payload, together)))


def temporal_absorb(
    fields: tuple[Fields, ...], score: Score[Shared], *, axis: str, scaling: str
) -> tuple[Fields, ...]:
    """Whitens every line, or every group of rows: the symmetric inverse root of 1 + v r r^T."""
    variance, together = score.payload

    def whitened(field: Fields) -> Fields:
        return unfolded(whiten_lines(folded(field, together), axis, scaling, variance), together, field)

    return tuple(whitened(f) if f.lit or scaling == "additive" else f for f in fields)


def temporal_series(field: Fields, score: Score[Shared], *, axis: str, scaling: str) -> Series | None:
    """The offsets (or gains) of the lines of every contrast, as they are read together."""
    if not len(field.contrasts) or not (field.lit or scaling == "additive"):
        return None
    sums = summed(line_sums(field, field.contrasts, axis, scaling), score.payload.together)
    return Series(*sums, exponent=0.0, level=True)


def redrawn(
    axis: Line,
    scaling: Scales,
    *,
    name: str,
    parameter: str | None = None,
    covers: tuple[str, ...],
) -> Signature:
    """White offsets (or factors) of lines, new in every frame. parameter: the mechanism's strength."""
    additive = scaling == "additive"
    point = line_point(axis, scaling, "redrawn")

    def again(fields: Many, found: Score[Shared]) -> Score | None:
        return temporal_score(fields, axis=axis, scaling=scaling, together=found.payload.together)

    return Signature(
        name=name,
        kin=axis,
        axes=Axes("readout" if additive else "photons", axis, "redrawn", scaling, "white"),
        reads=CONTRASTS | reads_light(scaling),
        score=partial(temporal_score, axis=axis, scaling=scaling),
        again=again,
        absorb=partial(temporal_absorb, axis=axis, scaling=scaling),
        covers=covers,
        predict=_shared_by_line(axis) if additive else NO_LAW,
        pattern=NO_PATTERN,
        simulate=_read_together(strength(parameter), point) if parameter else NOT_SIMULATED,
        place=_read_together(placed(point), point),
        detectable=BY_SHIFT,
        least=random_offsets(axis, scaling, frozen=False),
        control=additive and axis == "row",
        series=partial(temporal_series, axis=axis, scaling=scaling),
    )


def _read_together(
    adds: Callable[[Found], Addition | None], point: Point
) -> Callable[[Found], Addition | None]:
    """What a finding adds, at its place in the grammar where rows are read together."""

    def simulate(found: Found) -> Addition | None:
        more, together = adds(found), found.score.payload.together
        if more is None or together == ALONE:
            return more
        return more._replace(point=dataclasses.replace(point, group=together.rows, phase=together.phase))

    return simulate


def by_turns(*, name: str, parameter: str, covers: tuple[str, ...]) -> Signature:
    """White offsets of rows, new in every frame, whose sign turns from column to column: what even and odd
    columns of a row differ by. parameter: the mechanism's strength."""

    def score(fields: Many, together: Together | None = None) -> Score | None:
        turned = tuple(f._replace(contrasts=f.contrasts * turns(f.mean.shape[1])) for f in fields)
        return temporal_score(turned, axis="row", scaling="additive", together=together)

    def beside(found: Found) -> dict[str, float]:
        together = found.score.payload.together
        return {} if together == ALONE else {"rows": together.rows, "before": together.phase}

    def absorb(fields: Many, found: Score) -> Many:
        turned = tuple(_turned(f) for f in fields)
        left = temporal_absorb(turned, found, axis="row", scaling="additive")
        # Whatever rows share elsewhere turns with its columns: of that nothing was taken out.
        return tuple(_turned(g)._replace(answers=f.answers) for f, g in zip(fields, left, strict=True))

    return Signature(
        name=name,
        axes=Axes("readout", "row", "redrawn", "additive", "white"),
        reads=CONTRASTS,
        score=score,
        again=lambda fields, found: score(fields, found.payload.together),
        absorb=absorb,
        covers=covers,
        predict=NO_LAW,
        pattern=NO_PATTERN,
        simulate=strength(parameter, beside=beside),
        place=_read_together(placed(_BY_TURNS), _BY_TURNS),
        detectable=BY_SHIFT,
        least=random_offsets("row", "additive", frozen=False),
        series=lambda field, found: temporal_series(
            field._replace(contrasts=field.contrasts * turns(field.mean.shape[1])),
            found,
            axis="row",
            scaling="additive",
        ),
    )


_BY_TURNS = Point("readout", "signal", "row", "redrawn", interleave=2)


def _turned(field: Fields) -> Fields:
    """The field with the sign of every other column turned; twice gives it back."""
    sign = turns(field.mean.shape[1])
    static = None if field.static is None else field.static * sign
    return field._replace(contrasts=field.contrasts * sign, static=static)


def _shared_by_line(axis: str):
    def predict(fields: Many, score: Score[Shared]) -> Predicted | None:
        if score.payload.together != ALONE:
            return None
        sigma = score.amplitude
        return Predicted("additive", row=sigma) if axis == "row" else Predicted("additive", column=sigma)

    return predict
