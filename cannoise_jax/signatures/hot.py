"""Pixels whose level stands out in the darks: hot ones."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from scipy import stats

from cannoise_jax.physics.core.mechanism import Scaling
from cannoise_jax.physics.robust import median
from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures.added import as_map, placed
from cannoise_jax.signatures.codes import cut_off
from cannoise_jax.signatures.core_law import NORMAL, Core
from cannoise_jax.signatures.fields import Fields, without_pixels
from cannoise_jax.signatures.handed import Addition, Asked, Found, Many, Predicted
from cannoise_jax.signatures.heat import (
    Heat,
    above_neighbours,
    follows_exposure,
    known_heat,
)
from cannoise_jax.signatures.hot_law import likely_laws, share_error
from cannoise_jax.signatures.least import (
    Law,
    Seen,
)
from cannoise_jax.signatures.patterns import pixel_sums
from cannoise_jax.signatures.rare import (
    hot_log_p,
    spread_of,
)
from cannoise_jax.signatures.recorded import Recorded
from cannoise_jax.signatures.score import LEAST_LOG_P, SHARE_OF_FEW, Score
from cannoise_jax.signatures.signature import NO_CLOSED_FORM, OFFSETS, STATIC, Axes, Scales, Signature
from cannoise_jax.signatures.sparse import hot_amplitude, hot_found

_STRONG = 1.2
"""Spread of the levels of most pixels, in standard deviations of their noise, from which on every pixel has a
level of its own and the hot ones are those that stand out from these: beside a map, not in place of it."""
_LEAST_NOISE = 0.6
"""Standard deviation of the noise of a dark, in codes, from which on the mean of a few frames is normal."""


def heat_again(
    looked: Score[Heat], first: tuple[Fields, ...], second: tuple[Fields, ...]
) -> Score[Heat] | None:
    """The strength of hot pixels on other frames: the heat that the frames that found them expect of every
    pixel, times how much of it shows again. None where nothing shows it."""
    known = known_heat(first, looked.payload)
    sums = above_neighbours(second, looked.payload.scaling)
    if known is None or sums is None:
        return None
    information = float(np.sum(known.mean**2 * sums.information))
    square = float(np.sum(known.power(2)))
    if not information > 0 or not square > 0:
        return None
    again = max(float(np.sum(known.mean * sums.score)) / information, 0.0)
    # The heat of the same camera: what is not known of it is the doubt about each pixel, not the draw.
    doubt = float(np.sum(np.maximum(known.power(4) - known.power(2) ** 2, 0.0))) / square**2
    unit = looked.amplitude / (looked.payload.mean * np.sqrt(2 * max(looked.payload.share, 1e-12)))
    amplitude = unit * float(np.sqrt(square / known.mean.size))
    # Charge of their own makes hot pixels noisier than those that the information is of.
    left = known.mean * (sums.score - again * known.mean * sums.information)
    variance = max(information, float(np.sum(left**2))) / information**2
    error = amplitude * float(np.sqrt(variance + again**2 * doubt / 4))
    return looked.replace(amplitude=amplitude * again, error=error)


def _lattice_spread(fields: tuple[Fields, ...]) -> float:
    """The standard deviation that the level of a pixel is taken to have at least, over that of its noise:
    below some half a code a few changes by a code reach further than a normal law has it."""
    darks = [f for f in fields if f.kind in DARK and f.usable.any()]
    return max((_LEAST_NOISE * f.step * float(median(f.weight[f.usable])) for f in darks), default=0.0)


_TOLD = 4.0
"""Chi-square of a typical pixel that stands out by which one law of its heat is told from the other: both are
as sure that it is hot, where it is so many standard deviations that these are no longer counted."""
_BEYOND_CUT = 4.0
"""Mean heat, in standard deviations of the levels of most pixels, from which on it is told from what a cut
at the lowest code does: half of all values cut off, means of two frames look like hot pixels of 1.25."""
_UPPER = (0.5, 0.977)
"""Quantiles of the levels of darks that are cut off, between which their upper half spreads as far as two
standard deviations: below the median they lie closer."""
_HEALTHY = 2e-6
"""Share of healthy pixels that a report counts as hot."""


def hot_score(fields: tuple[Fields, ...], *, scaling: str, cut: bool = False) -> Score[Heat] | None:
    """A few pixels far above the others in the darks, at the same places in every frame. cut: whether the
    darks are cut off at their lowest code, so that means of few frames are skewed."""
    sums = above_neighbours(fields, scaling)
    if sums is None:
        return None
    seen = sums.information > 0
    if not seen.any():
        return None
    u = np.where(seen, sums.score / np.sqrt(np.where(seen, sums.information, 1.0)), 0.0).ravel()
    bulk = spread_of(u[seen.ravel()])
    if cut:
        middle, high = np.quantile(u[seen.ravel()], _UPPER)
        bulk = max(bulk, float(high - middle) / float(stats.norm.ppf(_UPPER[1])))
    least = _lattice_spread(fields)
    own = cut or bulk > max(_STRONG, least) or any(f.answers.apart for f in fields)
    told = likely_laws(u[seen.ravel()], max(bulk, least), own)
    _, core, _, share, at, gain = told[0]
    out = (core.standard(u) > core.far(_HEALTHY)).reshape(seen.shape) & seen
    number = int(np.sum(out))
    better = follows_exposure(fields, out) or 0.0
    other_law = better > _TOLD if scaling == "additive" else better < -_TOLD
    other_law |= cut and at < _BEYOND_CUT
    root = float(np.sqrt(median(sums.information[seen]))) / core.spread
    mixture = min(f.mixture for f in told)
    seconds = (
        float(np.max([f.exposure_s or 1.0 for f in fields if f.kind in DARK]))
        if scaling == "exposure"
        else 1.0
    )
    amplitude = at / root * np.sqrt(2 * share) * seconds
    events = max(share * u.size, 1.0)
    high = [int(k) for k in np.argsort(-u)[:8]]
    width = fields[0].mean.shape[1]
    return Score(
        log_p=0.0 if other_law else max(hot_log_p(mixture, int(seen.sum())), LEAST_LOG_P),
        gain=0.0 if other_law else gain,
        penalty=max(gain - mixture, SHARE_OF_FEW),
        amplitude=float(amplitude),
        error=float(amplitude / np.sqrt(events)),
        shift=float(seconds / root / np.sqrt(np.sqrt(u.size / 2))),
        power=2,
        parameters={"fraction": (share, "1", share_error(told, u.size))},
        where={"axis": "pixel", "index": [[k // width, k % width] for k in high], "pixels": number},
        payload=Heat(share, at / root, scaling, core if bulk > _STRONG or core.law != NORMAL else Core()),
    )


def mask_hot(fields: tuple[Fields, ...], score: Score[Heat]) -> tuple[Fields, ...]:
    """Takes the pixels whose level stands out in the darks out of every field."""
    if score.payload.beside_map:
        known = known_heat(fields, score.payload)
        return fields if known is None else without_pixels(fields, known.chance > 0.5)
    return mask_off(fields)


def mask_off(fields: Many) -> Many:
    """Takes the pixels whose level is off in the darks, whatever the exposure or with it, out of every
    field."""
    out = np.zeros(fields[0].mean.shape, bool)
    for scaling in ("additive", "exposure"):
        sums = above_neighbours(fields, scaling)
        if sums is not None:
            out |= np.abs(sums.score / np.sqrt(np.maximum(sums.information, 1e-30))) > 4.0
    return without_pixels(fields, out)


def hot_map(fields: Many, score: Score[Heat], rng: np.random.Generator) -> np.ndarray | None:
    """A draw of the heat of every pixel `[H, W]`, DN (at the longest exposure where it grows with it)."""
    known = known_heat(fields, score.payload)
    if known is None:
        return None
    growing = score.payload.scaling == "exposure"
    seconds = max(f.exposure_s or 1.0 for f in fields if not f.lit) if growing else 1.0
    return known.draw(rng) * seconds


def _detectable(asked: Asked, score: Score, mechanism: str) -> float:
    """Of a few far pixels no shift in standard deviations tells how often they are found: their own p-value
    does, of all frames where those held back get a second look."""
    # Their charge grows with the exposure where the files state one.
    longest = max((f.exposure_s or 0.0 for f in asked.looks[0] if not f.lit), default=0.0)
    scaling = "exposure" if longest else "additive"
    sums = [s for s in (pixel_sums(fields, scaling, DARK) for fields in asked.looks) if s is not None]
    if not sums:
        return float("inf")
    return hot_found(np.sum([s.information for s in sums], axis=0), asked.own_log_p) * (longest or 1.0)


def _least(sets: tuple[Seen, ...]) -> Law:
    information = sum(s.frames * s.exposure**2 * s.weight for s in sets if s.known)
    return lambda shift: hot_amplitude(np.asarray(information), shift)


def standing_out(
    recorded: Recorded,
    scaling: Scales,
    *,
    name: str,
    maps: tuple[str, ...],
    covers: tuple[str, ...],
    lifted_by: tuple[str, ...],
) -> Signature:
    """A few pixels far above the others in the darks. maps: signatures of maps of all pixels, which are
    judged once the pixels that stand out from them are gone."""
    growing = scaling == "exposure"
    offsets = placed(OFFSETS)

    def predict(fields: Many, score: Score[Heat]) -> Predicted | None:
        known = known_heat(fields, score.payload)
        return None if known is None else Predicted(scaling, known.mean, known.variance)

    def simulate(found: Found) -> Addition:
        """At their places, e-/s; what does not grow with exposures that differ is an offset map, without the
        shot noise of charge."""
        if not growing and len({f.exposure_s for f in found.fields if not f.lit}) > 1:
            return offsets(found)
        pattern = np.zeros(found.fields[0].mean.shape) if found.pattern is None else found.pattern
        heat = pattern / found.gain / found.seconds
        share = float(np.clip(np.mean(heat > 0), 1e-7, 0.5))
        mean = float(heat.sum() / max((heat > 0).sum(), 1)) or 1e-6
        values = {"e_per_s": mean if growing else mean * found.seconds, "fraction": share}
        own = None if growing else Scaling(reference_exposure_s=found.seconds)
        return Addition(values, {"heat": as_map(heat / mean)}, own)

    def says(entry: dict[str, Any]) -> tuple[str, tuple[float, float]]:
        low, high = entry["amplitude"]["ci90"]
        where = "A few pixels lie far above the others in the dark, at fixed places and whatever the exposure"
        return f"{where}: {entry['amplitude']['value']:.3g} DN rms", (low, high)

    def at(score: Score[Heat], amplitude: float) -> Score[Heat]:
        """The mean heat goes with the strength."""
        heat = score.payload
        if score.amplitude > 0:
            heat = heat._replace(mean=heat.mean * amplitude / score.amplitude)
        return score.replace(amplitude=amplitude, payload=heat)

    return Signature(
        name=name,
        kin="hot",
        axes=Axes("readout", "pixel", "frozen", scaling, "sparse"),
        reads=STATIC,
        score=partial(hot_score, scaling=scaling, cut=cut_off(recorded.codes)),
        absorb=mask_hot,
        covers=covers,
        lifted_by=lifted_by,
        before=lambda score: maps if score.payload.beside_map else (),
        rare=True,
        predict=predict,
        pattern=hot_map,
        simulate=simulate,
        place=placed(OFFSETS, by_exposure=growing),
        says=None if growing else says,
        strength=heat_again,
        detectable=_detectable,
        decides=True,
        least=NO_CLOSED_FORM if growing else _least,
        at=at,
        single_pixels=True,
    )
