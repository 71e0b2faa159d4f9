"""A smooth pattern that stays in the darks, of a shape that nothing else has: light that leaks in, a gradient
of the temperature, charge of an earlier picture.

It is followed by few cosines. What of it varies along rows and along columns at once is no pattern of lines,
so that of those it is judged; all of it is taken out. It comes before areas and lines of charge, which such a
pattern would be cut into, and waits for all that has a form of its own: light that falls off from one corner
or edge is a glow.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from cannoise_jax.physics.robust import robust_std
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures.added import placed
from cannoise_jax.signatures.answers import as_it_stays
from cannoise_jax.signatures.cosines import (
    OF_LINES,
    SMALLEST,
    beside_level,
    cosine_products,
    cosine_sums,
    image_of,
    whitening,
)
from cannoise_jax.signatures.falls import glow_templates
from cannoise_jax.signatures.fields import quoted_at
from cannoise_jax.signatures.group_sums import area_sums
from cannoise_jax.signatures.handed import Many
from cannoise_jax.signatures.line_sums import LineSums
from cannoise_jax.signatures.means import minus, project
from cannoise_jax.signatures.patterns import pixel_sums
from cannoise_jax.signatures.score import KNOWN_SHAPE, ONE_OF_SEVERAL, Score, chi2_log_sf, normal_log_p
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    NO_CLOSED_FORM,
    NO_LAW,
    NOT_SIMULATED,
    OFFSETS,
    STATIC,
    Axes,
    Scales,
    Signature,
)

_FAR = 4.0
"""Robust standard deviations beside those around it from which on a pixel tells nothing of what is smooth."""
_ONE_FALL = 0.8
"""Share of it that one fall of light from a corner or edge may explain, beyond which it is left to a glow."""
_AREA, _SMOOTH = 8, 0.7
"""Pixels of the side of areas, and share of what they differ by that a smooth pattern accounts for at least.
Of white areas of 8 pixels it is 0.23 in a frame of 96 x 128."""
_WAITS = 1e-3
"""Share of what it gains that counts as evidence: it is found before what it precedes, or last."""


class Smooth(NamedTuple):
    """The pattern `[H, W]`, DN at the longest exposure where it grows with that, and its cosines."""

    field: Float[np.ndarray, "h w"]
    cosines: Float[np.ndarray, "k"]


class _Told(NamedTuple):
    """Sums of the darks along the cosines, their covariance by noise and maps of pixels, and what makes them
    independent; the cosines that fit best, and their image `[H, W]`; all of a pattern as it is quoted.
    smooth: share of what areas differ by that the image holds."""

    sums: Float[np.ndarray, "k"]
    information: Float[np.ndarray, "k k"]
    white: Float[np.ndarray, "k k"]
    cosines: Float[np.ndarray, "k"]
    image: Float[np.ndarray, "h w"]
    smooth: float


def _told(fields: Many, scaling: Scales) -> _Told | None:
    """None where no dark tells."""
    sums = pixel_sums(fields, scaling, DARK)
    if sums is None or min(sums.information.shape) < SMALLEST or not sums.information.any():
        return None
    unit = quoted_at(fields, scaling)
    sums = LineSums(sums.score / unit, sums.information / unit**2)
    root = np.sqrt(sums.information)
    seen, spread = _of_pixels(sums.score / np.maximum(root, 1e-15))
    seen &= root > 0
    level = _levels(sums, seen)
    along, products = _along(sums, seen, level)
    information = products / spread**2
    white = whitening(information)
    if white is None:
        return None
    along = along / spread**2
    cosines = white.T @ (white @ along)
    image = image_of(cosines, root.shape)
    before, after = (_of_areas(sums, seen, level + more) / spread**2 for more in (0.0, image))
    smooth = 1 - (after - 1) / max(before - 1, 1e-30)
    return _Told(along, information, white, cosines, image, smooth)


def _of_areas(sums: LineSums, seen: np.ndarray, level: np.ndarray) -> float:
    """Mean square of the sums of small areas about a level, in units of the noise of pixels."""
    score, information = (
        area_sums(values * seen, _AREA)
        for values in (sums.score - sums.information * level, sums.information)
    )
    told = information > 0
    return float(np.mean(score[told] ** 2 / information[told]))


def _of_pixels(z: Float[np.ndarray, "h w"]) -> tuple[Bool[np.ndarray, "h w"], float]:
    """Pixels that do not stand out of those around them of their site, and by how much most pixels scatter
    beside what is smooth."""
    framed = np.pad(z, 2, mode="reflect")
    around = (framed[:-4, 2:-2] + framed[4:, 2:-2] + framed[2:-2, :-4] + framed[2:-2, 4:]) / 4
    own = (z - around) / np.sqrt(1.25)
    near = np.abs(own) < _FAR * max(robust_std(own, 0.0), 1.0)
    return near, max(float(np.sqrt(np.mean(own[near] ** 2))), 1.0)


def _levels(sums: LineSums, seen: np.ndarray) -> Float[np.ndarray, "h w"]:
    """Mean of the pixels of every site of the mosaic."""
    out = np.zeros(seen.shape)
    for at in SITES:
        told = max(float(np.sum(sums.information[at] * seen[at])), 1e-30)
        out[at] = float(np.sum(sums.score[at] * seen[at])) / told
    return out


def _along(sums: LineSums, seen: np.ndarray, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    kept = sums.information * seen
    along, products = beside_level(
        cosine_sums(((sums.score - sums.information * level) * seen)[None]), cosine_products(kept)
    )
    return along[0], products


@lru_cache(maxsize=4)
def _falls(size: tuple[int, int]) -> Float[np.ndarray, "t k"]:
    """Cosines of the falls of light from corners and edges."""
    even = cosine_products(np.ones(size))
    sums = np.concatenate([cosine_sums(fall.reshape(1, *size)) for fall in glow_templates(size)[1]])
    sums, products = beside_level(sums, even)
    return np.linalg.solve(products, sums.T).T


def _one_fall(told: _Told, each: Float[np.ndarray, "k"], size: tuple[int, int]) -> float:
    """Share of the power that one fall of light explains best."""
    falls = _falls(size) @ told.information @ told.white.T
    along = np.maximum(falls @ each, 0.0) ** 2 / np.sum(falls**2, 1)
    return float(along.max()) / max(float(each @ each), 1e-30)


def smooth_score(fields: Many, *, scaling: Scales) -> Score[Smooth] | None:
    """What stays in darks and is smooth, rows and columns aside. Amplitude: rms over the frame."""
    told = _told(fields, scaling)
    if told is None:
        return None
    each = told.white @ told.sums
    own, size = each[OF_LINES:], fields[0].mean.shape
    power = float(own @ own)
    others = told.smooth < _SMOOTH or _one_fall(told, each, size) > _ONE_FALL
    # What noise alone adds to the mean square of the pattern: a product of cosines has one of a quarter.
    noise = float(np.sum(told.white**2)) / 4
    amplitude = float(np.sqrt(max(float(np.mean(told.image**2)) - noise, 0.0)))
    error = amplitude / max(float(np.sqrt(each @ each)), 1.0)
    gain = 0.0 if others else max(0.5 * (power - own.size) - ONE_OF_SEVERAL * own.size, 0.0)
    return Score(
        log_p=0.0 if others else chi2_log_sf(power, own.size),
        gain=gain,
        penalty=(1 - _WAITS) * gain + KNOWN_SHAPE,
        amplitude=amplitude,
        error=error,
        shift=float(np.sqrt(noise)),
        power=1,
        parameters={"sigma": (amplitude, "DN", error)},
        where={"axis": "block", "bbox": None},
        payload=Smooth(told.image.astype(np.float32), told.cosines),
    )


def smooth_again(fields: Many, found: Score[Smooth], *, scaling: Scales) -> Score[Smooth] | None:
    """The strength of the same pattern on other frames."""
    told = _told(fields, scaling)
    if told is None:
        return None
    cosines = found.payload.cosines
    information = max(float(cosines @ told.information @ cosines), 1e-30)
    share, z = float(cosines @ told.sums) / information, float(cosines @ told.sums) / np.sqrt(information)
    amplitude, error = max(share, 0.0) * found.amplitude, found.amplitude / np.sqrt(information)
    return found.replace(
        log_p=normal_log_p(z, 1),
        gain=0.5 * max(z, 0.0) ** 2,
        penalty=KNOWN_SHAPE,
        amplitude=amplitude,
        error=error,
        shift=error,
        parameters={"sigma": (amplitude, "DN", error)},
    )


def smooth_absorb(fields: Many, score: Score[Smooth], *, scaling: Scales) -> Many:
    """Subtracts the pattern from the darks."""
    longest, out = quoted_at(fields, scaling), []
    for f in fields:
        if f.static is None or f.kind not in DARK:
            out.append(f)
            continue
        share = (f.exposure_s or 0.0) / longest if scaling == "exposure" else 1.0
        out.append(minus(f, project(as_it_stays(f), share * score.payload.field)))
    return tuple(out)


def staying(*, name: str, scaling: Scales, covers: tuple[str, ...], before: tuple[str, ...]) -> Signature:
    """A smooth pattern of the darks. before: signatures that it comes before."""

    def pattern(fields: Many, score: Score[Smooth], rng: np.random.Generator) -> np.ndarray:
        return score.payload.field

    return Signature(
        name=name,
        kin="smooth",
        axes=Axes("readout", "block", "frozen", scaling, "smooth"),
        reads=STATIC,
        score=partial(smooth_score, scaling=scaling),
        again=partial(smooth_again, scaling=scaling),
        absorb=partial(smooth_absorb, scaling=scaling),
        covers=covers,
        before=lambda score: before,
        predict=NO_LAW,
        pattern=pattern,
        simulate=NOT_SIMULATED,
        place=placed(OFFSETS, by_exposure=scaling == "exposure"),
        detectable=BY_SHIFT,
        least=NO_CLOSED_FORM,
    )
