"""What recordings can and cannot be measured on: values near the ends of the codes, darks cut off at zero,
scenes that move, and a stated black level that the darks contradict."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.physics.transfer.black import black_level, reference_dark
from cannoise_jax.physics.transfer.fit import median_quotient
from cannoise_jax.physics.transfer.frames import FrameStatistics, frame_statistics
from cannoise_jax.physics.transfer.views import pixel_variance, unspoilt
from cannoise_jax.recordings.packing import ALL, site
from cannoise_jax.recordings.recording import DARK, Recording

LINEAR = 0.7
"""Share of the white level up to which flats enter the line (EMVA 1288, section 6)."""
_FROM_RAIL = 4.0
"""Standard deviations of its noise that a pixel's mean has to lie below the code at which values pile up: of
pixels nearer to it those that never touched it have lost the upper end of their noise. One value in thirty
thousand is beyond."""
_ALMOST_ALL = 0.99
"""Share of the pixels of a flat that have to lie below the rail for a map of them: hot pixels do not."""
_CUT, _BELOW = 0.01, 2.33
"""Share of the values of a dark at its lowest code beyond which it is cut off, and how many standard
deviations below its level a normal law has so much: cut there it keeps 98.5 % of its width, cut further in it
loses more than an interval of 90 % holds."""
_LOOKED_AT, _PART = 16, 0.25
"""Frames in which values at 0 are looked for, and the share of a frame within which they lie where noise that
is cut off has not made them."""
MOVES = 0.1
"""Share of the change between frames of a scene that is none of noise beyond which it tells no gain: that is
off by as much, several times what an interval of 90 % holds."""
STILL = "the scene or its light moves: record flats, or scenes that stand still"
_MIDDLE = 512
"""Pixels to either side of the middle of the frame within which all changes are looked at."""
_CHANGES, _FEWEST = 15, 4
"""Changes from frame to frame that are looked at, and from which on most of them are those of noise."""
_UPRIGHT = 0.5
"""Share of the change between frames that whole columns have in common, beyond which it is none of noise:
column noise lies below that of pixels, let alone with their shot noise."""
_HALF = 0.5
"""Share of the pixels of a scene that have to be below the rail for it to tell whether it moves."""
_APART = 4
"""Pixels of the mosaic: crosstalk and smoothing reach less far."""
_OUTSIDE = 3.0
"""Standard deviations of the noise of a dark by which a black level has to lie outside the levels of all
darks to be none of theirs: medians of a frame, rounded to codes, lie nearer."""
_MATTERS = 1e-3
"""Of the level of a flat: an error of the black level up to which PRNU and gain are off by as little."""


def lit_of(statistics: Sequence[FrameStatistics]) -> list[FrameStatistics]:
    """The flats, or the scenes where there are none."""
    flats = [s for s in statistics if s.recording.kind == "flat"]
    return flats or [s for s in statistics if s.recording.kind == "scene"]


def moved(lit: Sequence[FrameStatistics], c: int) -> str:
    """Why scenes among what is lit tell no gain in one channel; empty where none moves."""
    scenes = [s for s in lit if s.recording.kind == "scene" and s.variance is not None]
    # Where most pixels are full nothing changes but at their edge.
    scenes = [s for s in scenes if below_rail(s, c).mean() > _HALF]
    most = max((moving(s.recording, c) for s in scenes), default=0.0)
    return f"{100 * most:.0f} % of what changes between frames is no noise: {STILL}" if most > MOVES else ""


def below_rail(s: FrameStatistics, c: int) -> Bool[np.ndarray, "h w"]:
    """Pixels of a channel whose noise ends well below the code at which its values pile up."""
    usable = ~site(s.clipped, c)
    top = np.fmin(s.high[c], s.recording.white_level)
    near = usable & (site(s.mean, c) > LINEAR * top)
    if not near.any():
        return usable
    if near.mean() <= 1 - _ALMOST_ALL:
        # Hot pixels: their charge does not go with the light, so that a lamp that changes is in their noise.
        near = usable
    sigma = np.sqrt(median(pixel_variance(s, c)[near]) / median_quotient(s.dof))
    return usable & (site(s.mean, c) + _FROM_RAIL * sigma < top)


def moving(r: Recording, c: int) -> float:
    """Share of the change from frame to frame of a scene that is none of noise: what pixels some apart in
    rows and in columns have in common, of noise next to none, of a scene or light that moves most; or what a
    shift of the whole scene explains; or what few changes have beyond most of them. Where whole columns have
    more than half of it, that share: upright edges that move sideways."""
    if r.count < 2:
        return 0.0
    rows, columns = (slice(max(n // 4 * 2 - _MIDDLE, 0), n // 4 * 2 + _MIDDLE) for n in r.size)
    whole = c == ALL or r.cfa == "MONO"

    def seen(t: int, *part: slice) -> Float[np.ndarray, "h w"]:
        frame = np.asarray(r.frames[t], np.float64)[part]
        return frame if whole else site(frame, c)

    far = _APART if whole else _APART // 2
    frames = [seen(t, rows, columns) for t in range(min(r.count, _CHANGES + 1))]
    changes = [after - before for before, after in pairwise(frames)]
    # One frame that has moved is one of many: the first two tell it of parts away from the middle.
    first = _in_common([seen(1) - seen(0)], far) if max(r.size) > 2 * _MIDDLE else 0.0
    return max(first, _in_common(changes, far), _shifted(frames, changes), _beyond_most(changes))


def _near(change: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Changes without hits and noisy pixels."""
    most = 8 * robust_std(change, 0.0)
    return np.clip(change, -most, most)


def _beyond_most(changes: list[np.ndarray]) -> float:
    """Share of the changes that few of them have beyond the others: noise is the same in all."""
    power = [float(np.mean(_near(change - change.mean()) ** 2)) for change in changes]
    if len(power) < _FEWEST or not any(power):
        return 0.0
    return 1 - float(median(power)) / float(np.mean(power))


def _shifted(frames: list[np.ndarray], changes: list[np.ndarray]) -> float:
    """Share of the changes that shifts of the scene by parts of a pixel explain: those along its slopes. A
    slope is of the pixels on either side, so that noise has none in common with it."""
    mean = np.mean(frames, 0)
    if min(mean.shape) < 3:
        return 0.0
    slopes = np.stack([mean[2:, 1:-1] - mean[:-2, 1:-1], mean[1:-1, 2:] - mean[1:-1, :-2]])
    slopes -= slopes.mean((1, 2), keepdims=True)
    normal = np.einsum("kij,lij->kl", slopes, slopes)
    explained = power = 0.0
    for change in changes:
        inner = change[1:-1, 1:-1]
        inner = _near(inner - inner.mean())
        along = np.einsum("kij,ij->k", slopes, inner)
        explained += float(along @ np.linalg.lstsq(normal, along, rcond=None)[0])
        power += float(np.sum(inner**2))
    return explained / power if power > 0 else 0.0


def _in_common(changes: list[np.ndarray], far: int) -> float:
    """Share of the changes that pixels so far apart have in common. A scene that moves in one of them changes
    more than noise does in all."""
    shared = upright = power = of_columns = 0.0
    for change in changes:
        change = change - change.mean(1, keepdims=True)
        columns = change.mean(0, keepdims=True)
        upright += float(np.mean(columns**2))
        of_columns += float(np.mean(change**2))
        if min(change.shape) <= 2 * far:
            continue
        change = _near(change - columns)
        power += float(np.mean(change**2))
        along, across = change[:, far:] * change[:, :-far], change[far:] * change[:-far]
        # Noise along rows, or along columns, is alike in that direction alone.
        shared += min(float(along.mean()), float(across.mean()))
    if upright > _UPRIGHT * of_columns:
        return upright / of_columns
    return shared / power if power > 0 else 0.0


def is_below_rail(s: FrameStatistics, c: int) -> bool:
    """Whether so few pixels of a repeated flat are near the code at which values pile up that its map of
    sensitivities is that of the sensor."""
    return bool(below_rail(s, c)[site(unspoilt(s), c)].mean() >= _ALMOST_ALL)


def is_cut_off(s: FrameStatistics, c: int) -> bool:
    """Whether the noise of a dark has lost its lower end in one channel: a good share of the values is at the
    lowest code, and not because noise of a few codes about a level near 0 ends there."""
    if s.lowest[c] <= _CUT:
        return False
    if np.isfinite(s.low[c]) or s.variance is None:
        return True
    level = site(s.mean, c)
    spread = np.hypot(np.sqrt(median(pixel_variance(s, c)) / median_quotient(s.dof)), robust_std(level))
    return bool(median(level) + max(s.code_step, 1.0) / 2 < _BELOW * spread)


def cut_off(statistics: Sequence[FrameStatistics]) -> str:
    """What is wrong with the darks that the read noise is taken from, where a good share of their values is
    cut off at code 0; empty where none is."""
    dark = reference_dark(statistics)
    if dark is None:
        return ""
    at_zero = [dark.lowest[c] if is_cut_off(dark, c) and not dark.low[c] > 0 else 0.0 for c in range(4)]
    share, name = 100 * float(np.mean(at_zero)), dark.recording.path or dark.recording.camera
    if not share:
        return ""
    if part := _at_zero(dark.recording):
        return (
            f"{name}: values of darks are 0 ({share:.0f} %), all within {part}: text written into the "
            "picture, or a part that was not read: cut that part off all frames, or leave those frames out"
        )
    return (
        f"{name}: darks are cut off at 0 ({share:.0f} % of their values), so that neither read noise nor "
        "black level shows: raise the camera's offset and record again"
    )


def _at_zero(recording: Recording) -> str:
    """The rows and columns, counted from 1, that hold all values 0 of the first frames; empty where these are
    all over the frame."""
    zero = (np.asarray(recording.frames[:_LOOKED_AT]) == 0).any(0)
    spans = [np.flatnonzero(zero.any(axis)) for axis in (1, 0)]
    if not zero.any() or np.prod([s[-1] - s[0] + 1 for s in spans]) > _PART * zero.size:
        return ""
    rows, columns = (f"{s[0] + 1} to {s[-1] + 1}" for s in spans)
    return f"rows {rows}, columns {columns}"


def contradicted_black(statistics: Sequence[FrameStatistics]) -> str:
    """A line where the black level that is stated is that of no dark, nor where their line to no exposure
    ends; empty where it agrees, or no dark tells."""
    dark = reference_dark(statistics)
    if dark is None or dark.variance is None:
        return ""
    darks = [s for s in statistics if s.recording.kind in DARK]
    levels = [float(s.frame_means.mean()) for s in darks]
    stated = float(np.mean(dark.recording.black_level))
    away = max(min(levels) - stated, stated - max(levels))
    seconds = [s.recording.exposure_s for s in darks]
    if None not in seconds and len(set(seconds)) > 1:
        slope, ends = np.polyfit(np.array(seconds, float), levels, 1)
        away = min(away, abs(float(ends) - stated)) if slope > 0 else away
    noise = np.sqrt(float(median(dark.variance)) / median_quotient(dark.dof))
    if away <= max(_OUTSIDE * noise, 2 * max(dark.code_step, 1.0)):
        return ""
    low, high = (f"{v:.0f}" for v in (min(levels), max(levels)))
    found = low if low == high else f"{low} to {high}"
    return f"darks are at {found} DN, {stated:g} is stated as black level: that of the darks is used"


def with_measured_black(statistics: Sequence[FrameStatistics]) -> list[FrameStatistics]:
    """The statistics with the black level that the darks show in place of the stated one, where the
    difference matters for a flat and darks tell it from dark charge."""
    black = black_level(statistics)
    off = np.asarray(statistics[0].recording.black_level) - np.asarray(black.level)
    flats = [s for s in statistics if s.recording.kind == "flat"]
    slack = 4 * np.asarray(black.error)
    matters = any(
        (np.abs(off) > np.maximum(slack, _MATTERS * (np.asarray(s.level) + off))).any() for s in flats
    )
    if not (matters and black.certain):
        return list(statistics)
    return [_above(s, black.level) if s.recording.kind != "scene" else s for s in statistics]


def _above(s: FrameStatistics, black: tuple[float, float, float, float]) -> FrameStatistics:
    recording = dataclasses.replace(s.recording, black_level=black)
    if s.recording.kind == "flat":  # whose rows are scaled above black
        return frame_statistics(recording)
    a, b, c, d = (float(v) for v in s.frame_means.mean(0) - np.asarray(black))
    return dataclasses.replace(s, recording=recording, level=(a, b, c, d))
