"""Offsets and gains of columns that turn their sign from row to row: what the columns of even rows, which
circuits of their own read, have apart from those of odd rows."""

from __future__ import annotations

import numpy as np

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.signatures.added import draw, placed, posterior, strength
from cannoise_jax.signatures.answers import BY_TURNS, turns
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.handed import Many, Predicted
from cannoise_jax.signatures.least import random_offsets
from cannoise_jax.signatures.line_maps import static_absorb, static_score
from cannoise_jax.signatures.line_sums import reads_light, static_sums
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.signature import BY_SHIFT, STATIC, Axes, Scales, Signature


def _turned(fields: Many) -> Many:
    """The fields with the sign of what stays turned in every other row; twice gives them back."""

    def own(f: Fields) -> Fields:
        return f if f.static is None else f._replace(static=f.static * turns(len(f.static))[:, None])

    return tuple(own(f) for f in fields)


def columns(scaling: Scales, *, name: str, parameter: str, covers: tuple[str, ...]) -> Signature:
    """White offsets, or gains, of columns that turn from row to row and stay. parameter: the mechanism's
    strength."""
    enters = Point("photons", "mean", "pixel", "frozen", "multiply")
    point = enters if scaling == "signal" else Point("readout", "signal", "pixel", "frozen")

    def score(fields: Many) -> Score[float] | None:
        return static_score(_turned(fields), axis=BY_TURNS, scaling=scaling)

    def absorb(fields: Many, found: Score[float]) -> Many:
        return _turned(static_absorb(_turned(fields), found, axis=BY_TURNS, scaling=scaling))

    def predict(fields: Many, found: Score) -> Predicted | None:
        sums = static_sums(_turned(fields), BY_TURNS, scaling)
        if sums is None:
            return None
        mean, doubt = posterior(sums.score, sums.information, found.amplitude**2)
        return Predicted(scaling, mean * turns(len(fields[0].mean))[:, None], doubt[None])

    def pattern(fields: Many, found: Score, rng: np.random.Generator) -> np.ndarray | None:
        sums = static_sums(_turned(fields), BY_TURNS, scaling)
        if sums is None:
            return None
        drawn = draw(sums.score, sums.information, found.amplitude**2, rng)
        return drawn * turns(len(fields[0].mean))[:, None]

    return Signature(
        name=name,
        kin=BY_TURNS,
        axes=Axes("readout", "column", "frozen", scaling, "white"),
        reads=STATIC | reads_light(scaling),
        score=score,
        absorb=absorb,
        covers=covers,
        predict=predict,
        pattern=pattern,
        simulate=strength(parameter),
        place=placed(point),
        detectable=BY_SHIFT,
        least=random_offsets("column", scaling, frozen=True),
        drawn_once=True,
    )
