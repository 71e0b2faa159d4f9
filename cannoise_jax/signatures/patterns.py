"""Offsets and gains common to a frame, and frozen ones of single pixels."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from jaxtyping import Float
from scipy import special, stats

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.recordings.recording import KINDS
from cannoise_jax.signatures.added import as_map, draw_pixels, placed, posterior, strength
from cannoise_jax.signatures.answers import less_map, response, shows, stays, told
from cannoise_jax.signatures.behind_gain import behind_gain
from cannoise_jax.signatures.charge_noise import by_medians, error_of_charge, own_charge, steadied
from cannoise_jax.signatures.fields import Fields, channel_index, helmert, longest_exposure, quoted_at
from cannoise_jax.signatures.group_sums import LineSums, Pixels, by_own_noise
from cannoise_jax.signatures.handed import Addition, Found, Many, Predicted
from cannoise_jax.signatures.least import (
    frame_offsets,
    random_offsets,
)
from cannoise_jax.signatures.line_sums import component_score
from cannoise_jax.signatures.off_reference import drop_scenes, white_error
from cannoise_jax.signatures.remembered import remembered
from cannoise_jax.signatures.score import Score, variance_component
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    CONTRASTS,
    NO_CLOSED_FORM,
    NO_LAW,
    NO_PATTERN,
    NO_PLACE,
    NOT_SIMULATED,
    OFFSETS,
    STATIC,
    Axes,
    Scales,
    Signature,
)

_UNLIKE = 1e-3
"""Chance of so much more scatter of lit frames, of light that stays, below which they are left out."""
STANDS_OUT = 30.0
"""Chi-square of a pixel from which on it is hot or dead and no part of the variance of a map: one of 20
million normal values."""
FAR_OUT = 8.0
"""Standard deviations of a map and its noise from which on a pixel is no part of the map."""
_FAR_OF_LINES = 4.0
"""Standard deviations of most pixels up to which one moves its line."""
_ROUNDS = 3
"""Of rows and columns together, for pixels do not all tell alike."""
_FEWEST = 16
"""Pixels of a line from which on it has an offset of its own."""


def frame_score(fields: tuple[Fields, ...], *, scaling: str) -> Score[float] | None:
    """One random offset (or gain) per frame. Light that moves from frame to frame by more than offsets do in
    darks says nothing of offsets."""
    power, information, dof, lit = [], [], [], []
    for f in fields:
        if not len(f.contrasts) or (scaling == "signal" and not f.lit):
            continue
        r = response(f, scaling) / f.louder
        i = float(np.sum(r.astype(np.float64) ** 2))
        if i > 0:
            u = np.einsum("nij,ij->n", f.contrasts, r.astype(np.float32)).astype(np.float64)
            rest = f.contrasts - (u / i).astype(np.float32)[:, None, None] * r
            within = np.einsum("nij->n", (rest * r) ** 2).astype(np.float64)
            fourth = np.array([np.sum(r.astype(np.float64) ** 4)])
            pixels = Pixels(np.array([i]), fourth, within[:, None], np.zeros(1, int))
            u, more = by_own_noise(u[:, None], pixels, np.array([float(np.sum(r > 0))]))
            u, i = u[:, 0], i * float(more[0])
            power.append(float(np.sum(u.astype(np.float64) ** 2)) / i)
            information.append(i * f.level**2)
            dof.append(len(f.contrasts))
            lit.append(f.lit)
    # One recording alone cannot say how what its frames share scales: another has to lack it, or show less.
    if not power or sum(len(f.contrasts) > 0 for f in fields) < 2:
        return None
    powers, informations, dofs = np.array(power), np.array(information), np.array(dof)
    if scaling == "additive":
        told = ~np.array(lit) | (not _unlike(powers, informations, dofs, np.array(lit)))
        powers, informations, dofs = powers[told], informations[told], dofs[told]
    return component_score(powers, informations, dofs, scaling=scaling, where={"axis": "frame"})


def _unlike(power: np.ndarray, information: np.ndarray, dof: np.ndarray, lit: np.ndarray) -> bool:
    """Whether lit frames scatter by more than the offsets of darks explain, as light does that moves."""
    if lit.all() or not lit.any():
        return False
    variance = variance_component(power[~lit], information[~lit], dof[~lit]).variance
    scaled = power / (1 + variance * information)
    ratio = (scaled[lit].sum() / dof[lit].sum()) / max(scaled[~lit].sum() / dof[~lit].sum(), 1e-30)
    return bool(stats.f.sf(ratio, dof[lit].sum(), dof[~lit].sum()) < _UNLIKE)


def frame_absorb(fields: tuple[Fields, ...], score: Score[float], *, scaling: str) -> tuple[Fields, ...]:
    """Whitens the frame offsets."""
    out = []
    for f in fields:
        if scaling == "signal" and not f.lit:
            out.append(f)
            continue
        r = (response(f, scaling) / f.louder).astype(np.float32)
        i = float(np.sum(r.astype(np.float64) ** 2))
        kept = 1 / np.sqrt(1 + score.payload * i * f.level**2)
        u = np.einsum("nij,ij->n", f.contrasts, r) * np.float32((1 - kept) / max(i, 1e-30))
        out.append(f._replace(contrasts=f.contrasts - u[:, None, None] * r, level=f.level * float(kept)))
    return tuple(out)


def pixel_sums(fields: tuple[Fields, ...], scaling: str, kinds: tuple[str, ...]) -> LineSums | None:
    """Scores of a frozen pixel pattern shared by the recordings of these kinds. scaling 'exposure': per
    second."""
    score: np.ndarray | float = 0.0
    information: np.ndarray | float = 0.0
    for f in fields if told(fields, scaling) else ():
        if f.static is None or f.kind not in kinds or not shows(f, scaling):
            continue
        r = stays(f, "pixel", scaling)
        score = score + np.sqrt(f.frames) * f.static * r
        information = information + f.frames * r.astype(np.float64) ** 2
    return LineSums(np.asarray(score), np.asarray(information)) if np.ndim(score) else None


def beside_lines(sums: LineSums) -> Float[np.ndarray, "h w"]:
    """What pixels score, in standard deviations, beside the offsets that their rows and columns share: of
    lines that differ all pixels would be a map of more variance than that of pixels is, and once the lines
    are found too much were taken out of all else that stays. Pixels far out move a line as others do."""
    root = np.sqrt(sums.information)
    z = sums.score / np.maximum(root, 1e-15)
    seen = root > 0
    if min(z.shape) < _FEWEST or not seen.any():
        return z
    limit = _FAR_OF_LINES * max(robust_std(z[seen], 0), 1.0)

    def shared(values: np.ndarray, axis: int | None) -> Float[np.ndarray, "..."]:
        total = np.sum(sums.information, axis, keepdims=True)
        return np.sum(values * root, axis, keepdims=True) / np.maximum(total, 1e-30)

    for _ in range(_ROUNDS):
        near = np.clip(z, -limit, limit)
        z = z - root * (shared(near, 1) + shared(near, 0) - shared(near, None))
    # What the means of its lines take of a value.
    own = [sums.information / np.maximum(np.sum(sums.information, k, keepdims=True), 1e-30) for k in (0, 1)]
    left = 1 - own[0] - own[1]
    return z / np.sqrt(np.maximum(left, 0.5))


def pixel_score(fields: tuple[Fields, ...], *, scaling: str) -> Score[float] | None:
    """Frozen white pattern of pixels, the same in every recording."""
    sums = pixel_sums(fields, scaling, KINDS)
    if sums is None or (scaling == "signal" and not any(f.lit and f.static is not None for f in fields)):
        return None
    power = np.ravel(beside_lines(sums) ** 2)
    # A few pixels far out are hot or dead pixels, a pattern of their own: they must not stand for a map. A
    # map far above the noise puts every pixel out.
    seen = power[np.ravel(sums.information) > 0]
    bulk = float(median(seen)) / stats.chi2.median(1) if seen.size else 1.0
    limit = STANDS_OUT * (bulk if bulk > 2 else 1.0)
    information = np.where(power < limit, np.ravel(sums.information), 0.0)
    score = component_score(
        power,
        information,
        np.ones(power.shape),
        scaling=scaling,
        where={"axis": "pixel"},
        scale_variance=scale_variance(fields, scaling, KINDS),
    )
    if scaling != "exposure":
        return score
    # Fitted per second; quoted at the longest exposure.
    seconds = longest_exposure(fields)
    sigma, error = score.amplitude * seconds, score.error * seconds
    return score.replace(
        amplitude=sigma, error=error, shift=score.shift * seconds, parameters={"sigma": (sigma, "DN", error)}
    )


def scale_variance(fields: tuple[Fields, ...], scaling: str, kinds: tuple[str, ...]) -> float:
    """Variance of the log of the noise variance under a pooled static map: each field's comes from contrasts,
    whose squares, like those of the map itself, scatter by more where the noise has tails (noise far below a
    code is rare steps)."""
    shares, errors = [], []
    for f in fields:
        if f.static is None or f.kind not in kinds or not shows(f, scaling):
            continue
        r = stays(f, "pixel", scaling).astype(np.float64)
        shares.append(f.frames * float(np.sum(r**2)))
        tails, shared = noise_tails(f)
        contrasts = max(len(f.contrasts), 1)
        errors.append(((2 + tails * shared) / contrasts + tails / f.frames) / f.mean.size)
    total = max(sum(shares), 1e-30)
    return float(sum((s / total) ** 2 * e for s, e in zip(shares, errors, strict=True)))


@remembered("contrasts", "usable")
def noise_tails(field: Fields) -> tuple[float, float]:
    """Excess kurtosis of the noise of single frames by that of the contrasts, not below 0, and the share of
    it that a contrast keeps."""
    values = field.contrasts[:, field.usable][: field.frames - 1]
    matrix = helmert(field.frames)
    shared = float(np.mean(np.sum(matrix**4, 1))) if len(matrix) else 1.0
    square = values**2  # the fourth power is its square: any other power takes a hundred times as long
    second = float(np.mean(square)) if values.size else 0.0
    if second == 0:
        return 0.0, shared
    return max(float(np.mean(square**2)) / second**2 - 3, 0.0) / shared, shared


def pixel_absorb(fields: tuple[Fields, ...], score: Score[float], *, scaling: str) -> tuple[Fields, ...]:
    """Takes the whitening part of the estimated shared map out of every static field. Pixels that stand far
    out of the map are left as they are: they are no part of it, and what they are has to see all of them."""
    sums = pixel_sums(fields, scaling, KINDS)
    if sums is None:  # no recording of the kind that shows it
        return fields
    apart = np.abs(beside_lines(sums)) >= FAR_OUT * np.sqrt(1 + score.payload * sums.information)
    apart &= sums.information > 0
    left = less_map(fields, scaling, score.payload, apart)
    if scaling != "exposure":
        return left
    # Offsets that are not found yet are no charge: those of a column would make it louder or quieter.
    known = sums.information > 0
    steady = by_medians(fields, apart) if apart.any() else fields
    if steady is None:
        known &= ~apart
    rate = own_charge(steady or fields)
    if rate is None:
        return left
    return tuple(
        f._replace(answers=f.answers._replace(steadied=f.answers.steadied | (apart & known)))
        for f in steadied(left, rate, known, error_of_charge(fields))
    )


def own_score(fields: tuple[Fields, ...]) -> Score | None:
    """Frozen residual of each scene by itself, not shared: an error of its reference. DN rms."""
    chosen = [f for f in fields if f.kind == "scene" and f.static is not None]
    if not chosen:
        return None
    power = np.concatenate([np.ravel(f.static) ** 2 for f in chosen if f.static is not None])
    information = np.concatenate([np.ravel(f.frames * f.weight.astype(np.float64) ** 2) for f in chosen])
    return component_score(
        power,
        information,
        np.ones(power.shape),
        scaling="additive",
        where={"axis": "pixel"},
        scale_variance=scale_variance(tuple(chosen), "additive", KINDS),
    )


def frame(scaling: Scales, *, name: str, parameter: str, covers: tuple[str, ...]) -> Signature:
    """One offset (or factor of the light) of every frame."""
    additive = scaling == "additive"
    return Signature(
        name=name,
        kin="frame",
        axes=Axes("readout" if additive else "photons", "frame", "redrawn", scaling, "white"),
        reads=CONTRASTS if additive else CONTRASTS | {"signal"},
        score=partial(frame_score, scaling=scaling),
        absorb=partial(frame_absorb, scaling=scaling),
        covers=covers,
        predict=(lambda fields, score: Predicted("additive", frame=score.amplitude)) if additive else NO_LAW,
        pattern=NO_PATTERN,
        simulate=strength(parameter),
        place=placed(
            Point("readout", "signal", "frame", "redrawn")
            if additive
            else Point("photons", "mean", "frame", "redrawn", "multiply")
        ),
        detectable=BY_SHIFT,
        least=frame_offsets if additive else NO_CLOSED_FORM,
        of_frames=additive,
    )


_MOST_VARIED = 10.0
"""Standard deviation of pixels' own charge over the mean of all, from which on they are no scatter of it."""
_NONE_LEFT = 0.02
"""Share of pixels with less than no charge, up to which it is their noise that made them so."""
_SURELY_BELOW, _FEW_BELOW = 3.0, 5e-3
"""Standard errors by which a pixel has less than no charge, and the share of pixels up to which that is
chance: of normal errors it is 1.3e-3."""


def _none_below(fields: Many, level: Float[np.ndarray, "h w"]) -> bool:
    """Whether levels of pixels about this mean, DN/s, are such as charges have: none surely below zero."""
    sums = pixel_sums(fields, "exposure", KINDS)
    if sums is None or not (seen := sums.information > 0).any():
        return False
    above = sums.score[seen] / sums.information[seen] + level[seen]
    return bool(np.mean(above * np.sqrt(sums.information[seen]) < -_SURELY_BELOW) < _FEW_BELOW)


def _above_none(beyond: Float[np.ndarray, "h w"], variation: float) -> Float[np.ndarray, "h w"]:
    """The map by the ranks of its values as a log-normal one of this standard deviation about a mean of one,
    less that: a normal law of charges that vary so would have many below none."""
    shape = np.sqrt(np.log1p(variation**2))
    normal = special.ndtri((stats.rankdata(beyond) - 0.5) / beyond.size).reshape(beyond.shape)
    return np.expm1(shape * normal - shape**2 / 2)


def _within(own: Addition, found: Found, growing: Addition) -> Addition | None:
    """The charge of all pixels with what each of them has beyond its mean, `own`, so that it brings its shot
    noise; None where that cannot be charge: too many pixels would have less than none."""
    rate, strength = growing.values.get("e_per_s", 0.0), next(iter(own.values.values()))
    gains = [f.gain for f in found.fields if f.unit == 1]  # strengths hold at the lowest gain
    if not (gains and np.all(gains[0] > 0) and found.longest > 0 and rate > 0):
        return None
    if "pixels" in growing.maps or not own.maps:
        return None
    field = np.squeeze(np.asarray(own.maps["field"], np.float64), 0)
    beyond = strength * field / (gains[0][channel_index(field.shape)] * found.longest * rate)
    variation = float(np.std(beyond))
    if not 0 < variation < _MOST_VARIED:
        return None
    if np.mean(beyond < -1) > _NONE_LEFT:
        if not _none_below(found.fields, rate * gains[0][channel_index(field.shape)]):
            return None
        # What a tail adds to the mean of all pixels is charge as well.
        more = max(1 + float(np.mean(beyond)), 1.0)
        rate, variation = rate * more, variation / more
        beyond = _above_none(beyond, variation)
    maps = {**growing.maps, "pixels": as_map(beyond / variation)}
    return growing._replace(values={**growing.values, "e_per_s": rate, "variation": variation}, maps=maps)


def pixel(
    scaling: Scales,
    *,
    name: str,
    parameter: str,
    covers: tuple[str, ...],
    charge_of: tuple[str, ...] = (),
) -> Signature:
    """A frozen offset (or gain, or dark current, or offset that no gain changes) of every pixel. charge_of:
    mechanisms of charge that grows with the exposure alike in all pixels, of which it is the part of each."""
    growing, light, of_codes = scaling == "exposure", scaling == "signal", scaling == "codes"
    point = Point("photons", "mean", "pixel", "frozen", "multiply") if light else OFFSETS

    def predict(fields: Many, score: Score) -> Predicted | None:
        sums = pixel_sums(fields, scaling, KINDS)
        seconds = quoted_at(fields, scaling)
        if sums is None or not seconds:
            return None
        variance = (score.amplitude / seconds) ** 2
        return Predicted(scaling, *posterior(sums.score, sums.information, variance))

    def pattern(fields: Many, score: Score, rng: np.random.Generator) -> np.ndarray | None:
        sums = pixel_sums(fields, scaling, KINDS)
        if sums is None:
            return None
        variance = score.amplitude**2
        if not growing:
            return draw_pixels(sums.score, sums.information, variance, rng)
        seconds = longest_exposure(fields)
        return draw_pixels(sums.score, sums.information, variance / seconds**2, rng) * seconds

    def as_charge(add: Callable[[Found], Addition]) -> Callable[[Found], Addition]:
        def added(found: Found) -> Addition:
            own = add(found)
            return own._replace(into={id: partial(_within, own, found) for id in charge_of})

        return added

    simulate = as_charge(strength(parameter, by_exposure=growing))
    place = as_charge(placed(point, by_exposure=growing))
    return Signature(
        name=name,
        kin="pixel",
        axes=Axes("pixel", "pixel", "frozen", scaling, "white"),
        reads=STATIC | CONTRASTS | {"signal"} if light else STATIC | CONTRASTS,
        score=partial(pixel_score, scaling=scaling),
        absorb=partial(pixel_absorb, scaling=scaling),
        covers=covers,
        predict=predict,
        pattern=pattern,
        simulate=behind_gain(simulate) if of_codes else simulate,
        place=behind_gain(place) if of_codes else place,
        detectable=BY_SHIFT,
        least=NO_CLOSED_FORM if growing or of_codes else random_offsets("pixel", scaling, frozen=True),
        drawn_once=True,
        map_of=("pixel", scaling),
    )


def scenes(*, name: str, covers: tuple[str, ...]) -> Signature:
    """What stays in each scene by itself: an error of its reference."""
    return Signature(
        name=name,
        axes=Axes("reference", "pixel", "frozen", "scene", "white"),
        reads=STATIC | CONTRASTS,
        score=own_score,
        absorb=drop_scenes,
        covers=covers,
        predict=NO_LAW,
        pattern=NO_PATTERN,
        simulate=NOT_SIMULATED,
        place=NO_PLACE,
        detectable=BY_SHIFT,
        least=NO_CLOSED_FORM,
        drawn_once=True,
        off=white_error,
        speaks_for=frozenset({"scene"}),
    )
