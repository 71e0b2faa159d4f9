"""A few pixels that answer to the light by another share than all others, and are not dead.

Pixels that are half covered to find the focus, filters of another kind, and defects miss a part of the
light, or gain some; a map of sensitivities, which all pixels have a little of, describes them no better than
none. Each is judged beside the spread of all pixels and its own noise, in all flats together. What a hit
leaves in the mean of a few frames is in single ones, charge of a hot pixel is in the darks, and the shadow
of dust covers many pixels side by side: none of them is the pixel's own share of the light.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage, stats

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.signatures.added import placed
from cannoise_jax.signatures.defects import LOST
from cannoise_jax.signatures.fields import Fields, native, stays_dn, without_pixels
from cannoise_jax.signatures.handed import Many
from cannoise_jax.signatures.plain import plain
from cannoise_jax.signatures.score import LEAST_LOG_P, SHARE_OF_FEW, Score
from cannoise_jax.signatures.signature import CONTRASTS, STATIC, Axes, Signature

_FAR = 8.0
"""Standard deviations, of noise and of the spread of all pixels, by which a pixel stands out."""
_LEAST = 0.05
"""Share of the light, more or less, from which on a pixel is of another kind: smaller ones are the tail of a
map of sensitivities, and rings of dust."""
_ALIKE = 0.5
"""By how much of it a pixel's share may differ from flat to flat, and what of it may be in the darks."""
_AS_LONG = 0.5
"""Of the exposure of a flat, from which on a dark shows the charge that the flat holds."""
_STEADY = 8.0
"""Standard deviations by which the noise of a pixel may exceed that of the others: hits and jumps do."""
_BESIDE = 3
"""Others of the 5 x 5 pixels about one that may stand out too: more are the shadow of something."""
_IN_TAIL = 0.005
"""Share of the pixels beyond which the tail of a map is measured."""
_AREA, _CROWDED = 31, 1e-4
"""Pixels along a side of the area about one, and the chance below which there are too many of them in it."""
_HEALTHY = 0.01
"""Pixels of a frame that stand out by chance, at most."""


class Response(NamedTuple):
    """By what share of the light every pixel answers more, or less, than the others; its standard error,
    which the spread of all pixels is in; and the pixels that are told apart."""

    share: Float[np.ndarray, "h w"]
    error: Float[np.ndarray, "h w"]
    sites: Bool[np.ndarray, "h w"]


def response_of(fields: Many) -> Response | None:
    """Of every pixel in all flats together; None where none tells."""
    flats = [f for f in fields if f.kind == "flat" and f.static is not None and f.frames > 1]
    if not flats:
        return None
    by_flat = [_shares(f) for f in flats]
    information = np.sum([i for _, i in by_flat], 0)
    known = information > 0
    if not known.any():
        return None
    share = np.sum([s * i for s, i in by_flat], 0) / np.maximum(information, 1e-30)
    noise = 1 / np.sqrt(np.maximum(information, 1e-30))
    own = max(robust_std(share[known]), _tail(share[known])) ** 2 - float(median(noise[known])) ** 2
    error = np.hypot(noise, np.sqrt(max(own, 0.0)))
    limit = np.maximum(_FAR * error, _LEAST)
    off = known & (np.abs(share) > 0.5 * limit)
    sites = known & (np.abs(share) > limit) & (share > -LOST) & ~_of_areas(off)
    for f, (one, told) in zip(flats, by_flat, strict=True):
        sees = told * share**2 > _FAR**2
        sites &= ~sees | (
            np.abs(one - share) < _ALIKE * np.abs(share) + _FAR / np.sqrt(np.maximum(told, 1e-30))
        )
        level, as_long = _level_in_darks(f, fields)
        sites &= level < _ALIKE * np.abs(share) * np.maximum(f.signal, 1e-6)
        # Charge only adds, and more of it in a longer flat of the same lamp, as light does.
        sites &= as_long | (share < 0)
    sites &= _steady(flats, share)
    return Response(share, error, sites)


def _tail(share: Float[np.ndarray, "n"]) -> float:
    """Standard deviation by how far the tail of a map reaches, on the side where it reaches less far: pixels
    of another kind are on one, and a map may have longer tails than a normal one."""
    low, middle, high = np.quantile(share, (_IN_TAIL, 0.5, 1 - _IN_TAIL))
    return float(min(middle - low, high - middle) / stats.norm.isf(_IN_TAIL))


def _of_areas(off: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels about which more are off than chance puts there: in shadows, rings and reflections."""

    def about(side: int) -> np.ndarray:
        return ndimage.convolve(off.astype(np.int32), np.ones((side, side), np.int32), mode="constant") - off

    beside = about(5)
    crowded = stats.poisson.sf(about(_AREA) - 1, _AREA**2 * off.mean()) < _CROWDED
    # Those of a grid, which may be in a part of the frame alone, have none of them near.
    return (beside > _BESIDE) | ((beside > 0) & crowded)


def _shares(f: Fields) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Of one flat, and what it knows of each: one over its variance."""
    root = np.where(f.usable, np.sqrt(f.frames) * np.maximum(f.signal, 0.0) / f.sigma, 0.0).astype(np.float64)
    share = np.where(root > 0, f.static / np.maximum(root, 1e-6), 0.0)
    # Where they are many the surface of their channel lies lower by them.
    for at in SITES:
        told = root[at] > 0
        if told.any():
            share[at] -= median(share[at][told])
    return np.where(root > 0, share, 0.0), root**2


def _level_in_darks(flat: Fields, fields: Many) -> tuple[Float[np.ndarray, "h w"], bool]:
    """By how much, DN, every pixel lies off in a dark of nearly the exposure of the flat: what is charge; and
    whether that dark is long enough to show it."""
    darks = [native(f) for f in fields if not f.lit and f.static is not None and f.group == flat.group]
    if not darks:
        return np.zeros(flat.mean.shape), False
    long = flat.exposure_s or 0.0
    dark = min(darks, key=lambda f: abs(np.log(max(f.exposure_s or 0.0, 1e-6) / max(long, 1e-6))))
    off = stays_dn(dark)
    of_longer = min(long / dark.exposure_s, 1.0) if long and dark.exposure_s else 1.0
    # What is noise is nothing that the pixel has.
    noise = 3 * dark.sigma / np.sqrt(dark.frames)
    level = np.where(dark.usable, of_longer * np.maximum(np.abs(off) - noise, 0.0), np.inf) / flat.unit
    return level, bool(long and (dark.exposure_s or 0.0) >= _AS_LONG * long)


def _steady(flats: list[Fields], share: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Whether the noise of every pixel is that of the others, but for the light that it gains."""
    number = sum(len(f.contrasts) for f in flats)
    squares = np.sum([np.einsum("nij,nij->ij", f.contrasts, f.contrasts) for f in flats], 0)
    return squares < (number + _STEADY * np.sqrt(2 * number)) * np.maximum(1 + share, 1.0)


def other_score(fields: Many) -> Score[np.ndarray] | None:
    """A few pixels of another response. Amplitude: rms of their shares over all pixels."""
    found = response_of(fields)
    if found is None:
        return None
    return _scored(found, np.where(found.sites, found.share, 0.0))


def other_again(fields: Many, looked: Score[np.ndarray]) -> Score[np.ndarray] | None:
    """The same pixels on other frames: how much of their shares shows again."""
    found = response_of(fields)
    return None if found is None else _scored(found, looked.payload)


def _scored(found: Response, expected: Float[np.ndarray, "h w"]) -> Score[np.ndarray]:
    """The strength of pixels of these shares; log p of as many that stand out by chance."""
    chosen = expected != 0
    weight = np.where(chosen, found.error**-2.0, 0.0)
    known = float(np.sum(weight * expected**2))
    again = float(np.sum(weight * expected * found.share)) / known if known > 0 else 0.0
    rms = float(np.sqrt(np.mean(expected**2)))
    error = rms / np.sqrt(known) if known > 0 else float(median(found.error)) / np.sqrt(chosen.size)
    number = int(chosen.sum())
    shares = found.share[chosen]
    typical = float(median(shares)) if number else 0.0
    return Score(
        log_p=max(float(stats.poisson.logsf(number - 1, _HEALTHY)), LEAST_LOG_P) if number else 0.0,
        gain=0.5 * max(again, 0.0) ** 2 * known,
        penalty=SHARE_OF_FEW + number * float(np.log(chosen.size / max(number, 1))),
        amplitude=max(again, 0.0) * rms,
        error=error,
        shift=error,
        power=1,
        parameters={
            "sigma": (max(again, 0.0) * rms, "1", error),
            "fraction": (number / chosen.size, "1", float(np.sqrt(max(number, 1))) / chosen.size),
            "share": (typical, "1", float(np.median(found.error[chosen])) if number else error),
        },
        where={"axis": "pixel", "index": np.argwhere(chosen)[:8].tolist(), "pixels": number},
        payload=expected,
    )


def without_them(fields: Many, score: Score[np.ndarray]) -> Many:
    """The fields without these pixels: their noise is of another light as well."""
    return without_pixels(fields, score.payload != 0)


def other(*, name: str, covers: tuple[str, ...], lifted_by: tuple[str, ...]) -> Signature:
    """Pixels of another response, which no name describes."""

    def pattern(fields: Many, score: Score[np.ndarray], rng: np.random.Generator) -> np.ndarray:
        return score.payload

    def kind(score: Score[np.ndarray]) -> str:
        share, of_all = score.parameters["share"][0], score.parameters["fraction"][0]
        how = f"{100 * abs(share):.2g} % {'more' if share > 0 else 'less'}"
        return f"{100 * of_all:.2g} % of the pixels respond differently to light: typically {how}"

    return plain(
        name=name,
        axes=Axes("photons", "pixel", "frozen", "signal", "sparse"),
        reads=STATIC | CONTRASTS | {"signal"},
        score=other_score,
        again=other_again,
        absorb=without_them,
        covers=covers,
        lifted_by=lifted_by,
        pattern=pattern,
        place=placed(Point("photons", "mean", "pixel", "frozen", "multiply")),
        kind=kind,
        single_pixels=True,
        drawn_once=True,
        rare=True,
    )
