"""One pattern over the frame, of another strength in every frame: a glow, a leak of light or a map of offsets
that swells and fades with a temperature, a supply or a lamp.

The smooth part of every contrast between frames is a few cosines of rows and columns. Where one pattern is
behind them, all contrasts point one way, their first principal component; where the frames have smooth noise
of their own (1/f noise, rows, areas), every contrast points another way. The contrasts of a recording are
independent where nothing is shared, so the pattern that one half of them shows is held against the other: of
noise alone the squares of the other half along it are chi-squared, whatever was searched.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.signatures.added import placed
from cannoise_jax.signatures.answers import response
from cannoise_jax.signatures.cosines import (
    SMALLEST,
    beside_level,
    cosine_products,
    cosine_sums,
    image_of,
    whitening,
)
from cannoise_jax.signatures.fields import Fields, quoted_at
from cannoise_jax.signatures.handed import Many
from cannoise_jax.signatures.line_sums import component_score
from cannoise_jax.signatures.score import Score, chi2_log_sf, sidak
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    CONTRASTS,
    NO_CLOSED_FORM,
    NO_LAW,
    NOT_SIMULATED,
    Axes,
    Scales,
    Signature,
)

_LEAST_NOISE = 0.05
"""Share of the variance of contrasts that is noise at least."""
_LEAST = 5
"""Contrasts from which on halves of them are compared."""
_MOST = 0.8
"""Share of what smooth structures contrasts have that lies along one pattern, from which on there is one. Six
contrasts of rows, raster lines or areas of 1/f or white noise have less than 0.63 in 99 of 100 sets, slow
waves of random phase 0.92; of one pattern ten times the noise they have 0.94 and more in every other."""


class Pattern(NamedTuple):
    """A pattern of unit rms over the frame `[H, W]`, its cosines, and the variance of its strength."""

    field: Float[np.ndarray, "h w"]
    cosines: Float[np.ndarray, "k"]
    variance: float


class _Seen(NamedTuple):
    """One recording along the cosines: sums `[n, k]` of its contrasts, and their covariance `[k, k]` where
    nothing is shared, the frame's own offset taken out of both."""

    sums: Float[np.ndarray, "n k"]
    information: Float[np.ndarray, "k k"]


def _seen(field: Fields, scaling: str) -> _Seen | None:
    """None where the recording cannot show it."""
    r = (response(field, scaling) / field.louder).astype(np.float32)
    if not len(field.contrasts) or min(field.mean.shape) < SMALLEST or not r.any():
        return None
    squares = r.astype(np.float64) ** 2
    sums, information = beside_level(cosine_sums(field.contrasts * r), cosine_products(squares))
    # What the cosines hold beyond noise was in the variance that the contrasts were divided by.
    held = float(np.mean(np.einsum("nk,nk->n", sums, np.linalg.lstsq(information, sums.T, rcond=None)[0].T)))
    noise = max(1 - (held - len(information)) / np.count_nonzero(r), _LEAST_NOISE)
    return _Seen(sums / noise, information / noise)


def _shown(fields: Many, scaling: str) -> list[_Seen]:
    return [s for f in fields if (s := _seen(f, scaling)) is not None]


class _Common(NamedTuple):
    """All recordings in the coordinates in which their noise is white: contrasts `[n, k]`, and what turns a
    direction into cosines `[k, k]`."""

    values: Float[np.ndarray, "n k"]
    back: Float[np.ndarray, "k k"]


def _common(seen: Sequence[_Seen]) -> _Common | None:
    """None where too few contrasts tell, or the frames are covered in part."""
    count = sum(len(s.sums) for s in seen)
    if count < _LEAST:
        return None
    mean = np.sum([len(s.sums) * s.information for s in seen], 0) / count
    inverse = whitening(mean)
    if inverse is None:
        return None
    values = []
    for s in seen:
        scale = float(np.trace(inverse @ s.information @ inverse.T)) / len(inverse)
        values.append(s.sums @ inverse.T / np.sqrt(max(scale, 1e-30)))
    return _Common(np.concatenate(values), inverse.T)


def _direction(values: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "k"]:
    """The one along which the values are largest."""
    return np.linalg.svd(values, full_matrices=False)[2][0]


def _share(halves: Sequence[np.ndarray], along: Sequence[np.ndarray]) -> float:
    """Of the power of both halves beyond that of noise, what lies along the pattern of the other."""
    one = sum(float(np.sum(z**2)) - len(z) for z in along)
    return one / max(sum(float(np.sum(h**2)) - h.size for h in halves), 1e-30)


def _unit(cosines: Float[np.ndarray, "k"], size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """The pattern of these cosines at unit rms, and its cosines."""
    field = image_of(cosines, size)
    rms = max(float(np.sqrt(np.mean(field**2))), 1e-30)
    return (field / rms).astype(np.float32), cosines / rms


def _powers(seen: _Seen, cosines: Float[np.ndarray, "k"]) -> tuple[Float[np.ndarray, "n"], float]:
    """Squares of the contrasts along a pattern, in units of their noise, and the information of each."""
    told = max(float(cosines @ seen.information @ cosines), 1e-30)
    return (seen.sums @ cosines) ** 2 / told, told


def _scored(told: Sequence[tuple[np.ndarray, float]], scaling: str, unit: float) -> Score[Any]:
    """The variance of a strength. unit: what a strength of one is quoted as."""
    return component_score(
        np.array([float(squares.sum()) for squares, _ in told]),
        np.array([each for _, each in told]) / unit**2,
        np.array([float(len(squares)) for squares, _ in told]),
        scaling="additive" if scaling == "exposure" else scaling,
        where={"axis": "block", "bbox": None},
    )


def modulated_score(fields: Many, *, scaling: Scales) -> Score[Pattern] | None:
    """One pattern in the contrasts between frames, its strength new in each. Amplitude: rms over the frame
    and over frames, of what grows with the exposure at the longest one."""
    seen = _shown(fields, scaling)
    common = _common(seen)
    if common is None:
        return None
    size, first = fields[0].mean.shape, np.arange(len(common.values)) % 2 == 0
    halves = [common.values[first], common.values[~first]]
    ways = [_direction(h) for h in halves]
    theirs = [_unit(common.back @ way, size)[1] for way in ways]
    told, ends = [], np.cumsum([len(s.sums) for s in seen])
    for s, in_first in zip(seen, np.split(first, ends[:-1]), strict=True):
        (of_first, a), (of_second, b) = (_powers(s, m) for m in theirs)
        told.append((np.where(in_first, of_second, of_first), (a + b) / 2))
    unit = quoted_at(fields, scaling)
    score = _scored(told, scaling, unit)
    against = [other @ way for other, way in zip(halves[::-1], ways, strict=True)]
    log_p = sidak(min(chi2_log_sf(float(z @ z), len(z)) for z in against), 2)
    # What only one half has, so that both together have no strength, is no pattern of all.
    one = score.amplitude > 0 and _share(halves, against) > _MOST
    field, cosines = _unit(common.back @ _direction(common.values), size)
    return score.replace(
        log_p=log_p if one else 0.0,
        gain=score.gain if one else 0.0,
        payload=Pattern(field, cosines, score.payload / unit**2),
    )


def modulated_again(fields: Many, found: Score[Pattern], *, scaling: Scales) -> Score[Pattern] | None:
    """The strength of the same pattern on other frames."""
    seen = _shown(fields, scaling)
    if not seen:
        return None
    unit, pattern = quoted_at(fields, scaling), found.payload
    score = _scored([_powers(s, pattern.cosines) for s in seen], scaling, unit)
    return score.replace(payload=pattern._replace(variance=score.payload / unit**2))


def modulated_absorb(fields: Many, score: Score[Pattern], *, scaling: Scales) -> Many:
    """The pattern projected out of the contrasts, and what it leaves in the mean of the frames whitened."""
    return tuple(_less(f, score.payload, scaling) for f in fields)


def _less(field: Fields, pattern: Pattern, scaling: str) -> Fields:
    r = response(field, scaling).astype(np.float32)
    template = r * pattern.field
    power = float(np.sum(template.astype(np.float64) ** 2))
    if not power > 0:
        return field
    contrasts, static = field.contrasts, field.static
    if len(contrasts):
        seen = (template / field.louder).astype(np.float32)
        along = np.einsum("nij,ij->n", contrasts, seen) / float(np.sum(seen.astype(np.float64) ** 2))
        contrasts = (contrasts - along[:, None, None] * seen).astype(np.float32)
    if static is not None:
        left = 1 / np.sqrt(1 + pattern.variance * power)
        along = float(np.sum(static * template)) / power
        static = (static - (1 - left) * along * template).astype(np.float32)
    return field._replace(contrasts=contrasts, static=static)


def swelling(*, name: str, scaling: Scales, covers: tuple[str, ...]) -> Signature:
    """One pattern of another strength in every frame."""
    light = scaling == "signal"

    def pattern(fields: Many, score: Score[Pattern], rng: np.random.Generator) -> np.ndarray:
        return score.payload.field * score.amplitude

    point = Point("photons", "mean", "pixel", "modulated", "multiply")
    return Signature(
        name=name,
        kin="modulated",
        axes=Axes("photons" if light else "readout", "block", "modulated", scaling, "one pattern"),
        reads=CONTRASTS | (frozenset({"signal"}) if light else frozenset()),
        score=partial(modulated_score, scaling=scaling),
        again=partial(modulated_again, scaling=scaling),
        absorb=partial(modulated_absorb, scaling=scaling),
        covers=covers,
        predict=NO_LAW,
        pattern=pattern,
        simulate=NOT_SIMULATED,
        place=placed(
            point if light else Point("readout", "signal", "pixel", "modulated"),
            by_exposure=scaling == "exposure",
        ),
        detectable=BY_SHIFT,
        least=NO_CLOSED_FORM,
    )
