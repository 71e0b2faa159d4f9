"""Whether successive frames share temporal noise, as those of a camera do that averages over time.

Noise reduction over time writes y_t = a x_t + (1 - a) y_(t-1), or a running mean. Its frames look like any
others, but their noise is too low, and what they share is taken for a fixed pattern: photon transfer gives
too low a gain and too low a read noise, and nothing else tells.

Fixed patterns cancel in differences of two frames, whose mean square is D_ij = v_i + v_j - 2 c_|i-j|: the
noise v of every frame and the covariance c of frames one and two apart are solved for (least squares; of
frames further apart none is assumed). No mean over frames is taken out, so that nothing need be corrected for
it, and a frame of another noise, or of a pattern of its own, changes its v alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Shaped
from scipy import stats

from cannoise_jax.recordings.recording import DARK, BadInput, Recording

_FEWEST = 3
_FEW = 5
"""Frames up to which c_2, which few pairs tell, costs more than it helps."""
_MOST = 12
"""Successive frames that are looked at: 66 pairs."""
_SIDE = 256
"""Rows and columns that are looked at, about the middle."""
_BANDS = 16
"""Of rows, whose scatter is the error; fewer rows than `_LEAST_ROWS` a band are too few."""
_LEAST_ROWS = 3
_BULK = 0.75
"""Share of the differences that counts, the smallest: hits, hot and telegraph pixels stay out, each of which
is in four of them."""
_RANGE = 6.0
"""Standard deviations over which values may range with time: one in a thousand of noise does so in 12 frames,
pixels that jump most of the time."""
_BOTH, _OF_THREE, _DARK_ALONE, _LIT_ALONE = 0.05, 0.12, 0.12, 0.18
"""Correlation of successive frames from which they are averaged: in darks and in flats alike; of three
frames, of which a quieter one in the middle looks so too; in darks, and in flats, where only these can be
judged. It is 1 - a, or a half for running means of two, and takes twice as much of the gain. Of 40 real
recordings of six cameras the strongest is 0.04. Pixels with 1/f noise share some of it in the dark alone,
image lag in the light alone: the strongest lag that the catalogue shows as an example, 0.15, comes to
0.17."""
_MEDIAN = 0.6745
"""Of the absolute value of a standard normal variable."""
_FEWEST_VALUES = 32
"""Of a band, from which its bulk says something."""
_CHANCE, _CHANCE_ALONE = 1e-4, 1e-6
"""Of as large a correlation without any: in darks and flats each, and where only these are judged."""
_REPEATS = 1.5
"""Times as often as frames two apart have a value in common from which successive ones repeat it: averages
come to the root of 1.5 (y_t = (x_t + y_(t-1)) / 2) or of 2 (running means)."""
_COARSE = 0.1
"""Of the square of a code: bulks of differences whose mean square is below it are rounding, not noise."""


class Shared(NamedTuple):
    """Correlation of the temporal noise of successive frames, and its standard error."""

    correlation: float
    stderr: float

    def above(self, least: float, chance: float) -> bool:
        """Whether it is more than `least`, and surely there."""
        sure = stats.t.ppf(1 - chance, _BANDS - 1) * self.stderr
        return self.correlation > max(least, float(sure))


def check_single_exposures(recordings: Sequence[Recording]) -> None:
    """Raises BadInput where the frames of a camera are averages over time: successive ones share noise in
    darks and flats alike, or strongly in those of the two that are given.

    Scenes, which may move, and pairs are not judged. The order of the frames is that of recording.
    """
    seen = [(r, found) for r in recordings if (found := shared_noise(r)) is not None]
    dark = [(r, found) for r, found in seen if r.kind in DARK]
    lit = [(r, found) for r, found in seen if r.kind == "flat"]
    both = bool(dark and lit)
    averaged = (
        _averaged(dark, _BOTH if both else _DARK_ALONE, both),
        _averaged(lit, _BOTH if both else _LIT_ALONE, both),
    )
    if not any(averaged) or (both and not all(averaged)):
        return
    recording, found = max((a for a in averaged if a), key=lambda a: a[1].correlation)
    or_lag = "" if dark else " (or, where none is on, image lag: add darks)"
    raise BadInput(
        f"{recording.path or recording.camera}: successive frames share {100 * found.correlation:.0f} % of "
        "their noise: the frames are averaged over time: switch temporal noise reduction (frame averaging) "
        f"off and record again{or_lag}"
    )


def _averaged(
    seen: Sequence[tuple[Recording, Shared]], least: float, both: bool
) -> tuple[Recording, Shared] | None:
    """The recording whose frames share most, where one, or all together, share more than `least`."""
    if not seen:
        return None
    chance = _CHANCE if both else _CHANCE_ALONE
    weight = np.array([found.stderr**-2.0 for _, found in seen])
    values = np.array([found.correlation for _, found in seen])
    pooled = Shared(float(weight @ values / weight.sum()), float(weight.sum() ** -0.5))
    most = max(seen, key=lambda one: one[1].correlation)
    own = [found.above(max(least, _OF_THREE) if r.count == 3 else least, chance) for r, found in seen]
    three = all(r.count == 3 for r, _ in seen)
    return most if any(own) or pooled.above(max(least, _OF_THREE) if three else least, chance) else None


def shared_noise(recording: Recording) -> Shared | None:
    """Correlation of the noise of successive frames, pixel by pixel, of the bulk of the pixels; None for
    scenes, which may move, for fewer than three frames, for frames too small, and for noise below a code.

    Light that drifts or leans, what rows and columns do together, and patterns that all grow alike cancel.
    """
    if recording.kind not in (*DARK, "flat") or recording.count < _FEWEST:
        return None
    frames, step = _middle(recording)
    if frames.shape[1] < _BANDS * _LEAST_ROWS + 2 or frames.shape[2] < 2 * _BANDS or _repeats(frames):
        return None
    if recording.kind == "flat":
        frames = _of_one_light(frames)
    frames = _of_one_pattern(_alone(frames))
    pairs = [(i, j) for i in range(len(frames)) for j in range(i + 1, len(frames))]
    steady = _steady(frames)
    if min(band.sum() for band in _bands(steady)) < _FEWEST_VALUES:
        return None
    squares = np.array([_bulk_squares(frames[j] - frames[i], steady) for i, j in pairs])
    # Four values are in every one of these differences.
    if np.median(squares) / 4 < _COARSE * step**2:
        return None
    noise, covariance = _solved(pairs, squares)
    each = covariance / noise.mean()
    value = float(covariance.mean() / noise.mean())
    return Shared(value, float(each.std(ddof=1) / np.sqrt(_BANDS)))


def _repeats(frames: Float[np.ndarray, "t h w"]) -> bool:
    """Whether pixels keep their value of the frame before: such frames share noise, and are no averages."""
    near, far = (float(np.mean(frames[n:] == frames[:-n])) for n in (1, 2))
    return near > _REPEATS * max(far, 1 / frames[0].size)


def _middle(recording: Recording) -> tuple[Float[np.ndarray, "t h w"], float]:
    """The first frames about their middle, above black, DN, and the spacing of their codes."""
    top, left = (max((n - _SIDE) // 2, 0) // 2 * 2 for n in recording.size)
    some = np.asarray(recording.frames[:_MOST])[:, top : top + _SIDE, left : left + _SIDE]
    codes = np.unique(some)
    step = float(np.gcd.reduce(np.diff(codes))) if len(codes) > 1 else 1.0
    return some.astype(np.float64) - float(np.mean(recording.black_level)), step


def _of_one_light(frames: Float[np.ndarray, "t h w"]) -> Float[np.ndarray, "t h w"]:
    """Frames scaled to one level, so that the pattern of pixels cancels."""
    levels = frames.mean((1, 2), keepdims=True)
    return frames * (levels.mean() / levels) if levels.min() > 0 else frames


def _alone(frames: Float[np.ndarray, "t h w"]) -> Float[np.ndarray, "t h-2 w-2"]:
    """What pixels do alone: differences of neighbours of one colour, along rows and along columns."""
    across = frames[:, :, 2:] - frames[:, :, :-2]
    return across[:, 2:] - across[:, :-2]


def _of_one_pattern(frames: Float[np.ndarray, "t h w"]) -> Float[np.ndarray, "t h w"]:
    """Frames less what their common pattern grew: dark charge of a sensor that warms up."""
    pattern = frames.mean(0)
    limit = np.quantile(np.abs(pattern), _BULK)
    steady = np.where(np.abs(pattern) <= limit, pattern, 0.0)
    power = float(np.sum(steady**2))
    if power <= 0:
        return frames
    growth = np.einsum("thw,hw->t", frames, steady) / power
    return frames - (growth - growth.mean())[:, None, None] * pattern


def _steady(frames: Float[np.ndarray, "t h w"]) -> Bool[np.ndarray, "h w"]:
    """Values that do not jump over time."""
    far = len(frames) // 2  # what successive frames share would hide how far they range
    spread = np.median(np.abs(frames[far:] - frames[:-far])) / _MEDIAN / np.sqrt(2)
    return np.ptp(frames, axis=0) <= _RANGE * max(float(spread), 1.0)


def _bands(values: Shaped[np.ndarray, "h w"]) -> Shaped[np.ndarray, "b h w"]:
    """Bands of rows of one height."""
    rows = len(values) // _BANDS
    return values[: rows * _BANDS].reshape(_BANDS, rows, -1)


def _bulk_squares(
    change: Float[np.ndarray, "h w"], steady: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "b"]:
    """Mean square of the bulk of the steady values in bands of rows."""
    out = []
    for band, counts in zip(_bands(np.abs(change)), _bands(steady), strict=True):
        values = band[counts]
        kept = int(_BULK * len(values))
        out.append(np.mean(np.partition(values, kept)[:kept] ** 2))
    return np.array(out)


def _solved(
    pairs: Sequence[tuple[int, int]], squares: Float[np.ndarray, "p b"]
) -> tuple[Float[np.ndarray, "b"], Float[np.ndarray, "b"]]:
    """Mean noise of the frames and what successive ones share, by D_ij = v_i + v_j - 2 c_|i-j|."""
    count = pairs[-1][1] + 1
    own = np.zeros((len(pairs), count))
    for row, pair in zip(own, pairs, strict=True):
        row[list(pair)] = 1.0
    if count == 3:
        own = own.sum(1, keepdims=True)
    shared = -2.0 * (np.diff(pairs, axis=1) == np.array([1, 2] if count > _FEW else [1]))
    found = np.linalg.lstsq(np.hstack([own, shared]), squares, rcond=None)[0]
    return found[: own.shape[1]].mean(0), found[own.shape[1]]
