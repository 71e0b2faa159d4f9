"""How the mean bends with the light."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from cannoise_jax.physics.core.grammar import Point, amplitude_name
from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures.added import strength
from cannoise_jax.signatures.fields import Fields, channel_index, mean_of_frames, native
from cannoise_jax.signatures.handed import Addition, Found
from cannoise_jax.signatures.least import (
    template,
)
from cannoise_jax.signatures.levels import dark_levels, dark_rise
from cannoise_jax.signatures.means import linear_score, minus, project
from cannoise_jax.signatures.recorded import Recorded
from cannoise_jax.signatures.score import (
    KNOWN_SHAPE,
    Score,
    chi2_log_sf,
    normal_log_p,
)
from cannoise_jax.signatures.signature import BY_SHIFT, NO_LAW, NO_PATTERN, STATIC, Axes, Signature


class _Moments(NamedTuple):
    """Weighted moments of mean against reference in one channel of one field: basis 1, x, x^2."""

    normal: np.ndarray
    right: np.ndarray
    square: float
    channel: int


def _moments(field: Fields, clean: np.ndarray, span: float) -> list[_Moments]:
    """Moments per channel of what the mean over frames leaves after black level and a unit slope, DN."""
    assert field.static is not None
    channel = channel_index(field.mean.shape)
    weight = field.frames * field.weight.astype(np.float64) ** 2
    rest = mean_of_frames(field) - field.black[channel] - span * clean
    out = []
    for c in range(4):
        chosen = (channel == c) & field.usable
        w, x, y = weight[chosen], clean[chosen].astype(np.float64), rest[chosen].astype(np.float64)
        basis = np.stack([np.ones_like(x), x, x**2])
        normal = np.einsum("kn,n,ln->kl", basis, w, basis)
        out.append(_Moments(normal, np.einsum("kn,n,n->k", basis, w, y), float(np.sum(w * y * y)), c))
    return out


def _common_curve(moments: list[_Moments]) -> tuple[float, float, float, int]:
    """Curvature common to all fields, offset and slope common per channel; its error, and the chi-square
    and freedom of what fields differ in beyond it."""
    normal, right = np.zeros((9, 9)), np.zeros(9)
    own, rank = 0.0, 0
    for m in moments:
        at = np.array([m.channel, 4 + m.channel, 8])
        normal[np.ix_(at, at)] += m.normal
        right[at] += m.right
        values, vectors = np.linalg.eigh(m.normal)
        kept = values > 1e-9 * max(values[-1], 1e-30)
        own += float(np.sum((vectors[:, kept].T @ m.right) ** 2 / values[kept]))
        rank += int(kept.sum())
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-30))
    inverse = np.linalg.pinv(normal * np.outer(scale, scale), rcond=1e-10) * np.outer(scale, scale)
    theta = inverse @ right
    used = int(np.linalg.matrix_rank(normal * np.outer(scale, scale), tol=1e-10))
    return float(theta[8]), float(np.sqrt(inverse[8, 8])), own - float(theta @ right), rank - used


def curvature_score(fields: tuple[Fields, ...], *, span: float) -> Score[float] | None:
    """Mean of scenes and flats of known light against the square of that light. Offset and slope are common
    to all recordings where these agree; where they do not, each scene has its own, and flats say nothing."""
    scenes = [f for f in fields if f.kind == "scene" and f.static is not None and f.clean is not None]
    flats = [f for f in fields if f.kind == "flat" and f.static is not None and f.clean is not None]
    if not scenes and len({round(float(np.mean(f.clean)), 4) for f in flats if f.clean is not None}) < 4:
        return None
    known = [f for f in (*scenes, *flats) if f.clean is not None]
    high = float(max(np.max(f.clean) for f in known if f.clean is not None))
    where = {"axis": "signal", "range": [0.0, high]}
    moments = [m for f in known if f.clean is not None for m in _moments(native(f), f.clean, span)]
    for f in darks_of(fields, known):
        moments += _moments(native(f), np.zeros_like(f.mean), span)
    value, error, apart, freedom = _common_curve(moments)
    if freedom < 2 or chi2_log_sf(apart, freedom) < np.log(1e-3):
        if not scenes:
            return None
        pairs = [(f, project(f, -(f.clean**2) * span / f.unit)) for f in scenes if f.clean is not None]
        return linear_score(pairs, name="curvature", unit="1", where=where, payload=span)
    z, curvature, error = value / error, -value / span, error / span
    return Score(
        log_p=normal_log_p(z),
        gain=0.5 * z**2,
        penalty=KNOWN_SHAPE,
        amplitude=abs(curvature),
        error=error,
        shift=error,
        power=1,
        parameters={"curvature": (curvature, "1", error)},
        where=where,
        payload=span,
    )


def darks_of(fields: tuple[Fields, ...], lit: list[Fields]) -> list[Fields]:
    """The darks that fix the offset of light: the shortest, unless their level rises with the exposure so far
    that it would be another one at that of the light."""
    darks = [(f, level, e) for f, level, e in dark_levels(fields) if f.static is not None]
    shortest = min_exposure(fields)
    rise, error = dark_rise(darks)
    exposures = [f.exposure_s for f in lit]
    longest = None if None in exposures else max(e for e in exposures if e is not None)
    if rise > 3 * error:
        away = np.inf if longest is None or shortest is None else rise * max(longest - shortest, 0.0)
        if away > min(e for _, _, e in darks) / 2:
            return []
    return [f for f, _, _ in darks if f.exposure_s in (None, shortest)]


def min_exposure(fields: tuple[Fields, ...]) -> float | None:
    """Shortest stated exposure of the darks, s."""
    known = [f.exposure_s for f in fields if f.kind in DARK and f.exposure_s is not None]
    return min(known) if known else None


def curvature_absorb(fields: tuple[Fields, ...], score: Score[float]) -> tuple[Fields, ...]:
    """Subtracts the fitted curvature from the scenes: what a line in the reference leaves of it from the
    residuals, the line itself, which would pass for a wrong scale, from the mean."""
    value, span = score.parameters["curvature"][0], score.payload
    out = []
    for f in fields:
        if f.kind == "scene" and f.static is not None and f.clean is not None:
            bend = -(f.clean**2) * span / f.unit * value
            rest = project(f, bend)
            line = bend - np.divide(rest, f.weight, out=np.zeros_like(rest), where=f.weight > 0)
            f = minus(f, rest)._replace(mean=(f.mean - line).astype(np.float32))
        out.append(f)
    return tuple(out)


def bent_light(found: Found) -> Addition:
    """The curvature as a point of the grammar, for what has no mechanism."""
    loss = found.score.parameters["curvature"][0]
    power = order_of(found.score.parameters)
    point = Point("photons", "mean", "pixel", "frozen", "multiply", signal=power)
    field = np.full((1, *found.size), -np.sign(loss), np.float32)
    return Addition({amplitude_name(point): abs(loss)}, {"field": jnp.asarray(field)}, point=point)


def order_of(parameters: Mapping[str, tuple[float, str, float]]) -> float:
    """The power of the signal by which the share that is lost grows: 1 unless the score says another."""
    return parameters.get("order", (1.0, "1", 0.0))[0]


def curved(recorded: Recorded, *, name: str, parameter: str, covers: tuple[str, ...]) -> Signature:
    """A mean that bends with the light."""
    span = recorded.span
    return Signature(
        name=name,
        axes=Axes("converter", "signal", "frozen", "signal squared", "curve"),
        reads=STATIC | {"mean"},
        score=partial(curvature_score, span=span),
        absorb=curvature_absorb,
        covers=covers,
        predict=NO_LAW,
        pattern=NO_PATTERN,
        simulate=strength(parameter, signed="curvature"),
        place=bent_light,
        detectable=BY_SHIFT,
        least=lambda sets: template(sets, lambda s: s.signal**2 / span),
    )
