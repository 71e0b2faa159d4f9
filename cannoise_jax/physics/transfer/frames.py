"""What photon transfer needs to know of one recording, gathered in two passes over its frames.

Temporal noise is taken from how each pixel changes between frames, so that fixed patterns cancel. What a
whole row does together is taken out first, per frame, row and colour, and kept beside it as row means:
- in flats (and wherever the light dominates) by scaling every row of every frame to the same mean above
  black: lamp drift and mains flicker under a rolling shutter cancel, and shading stays out of the variance.
  The common mean is the harmonic mean over the frames, for which the shot noise of scaled rows keeps the
  slope K exactly. How the light leans from side to side in a frame, as the sky does, is taken out as well;
- otherwise by an offset: row noise and black-clamp drift cancel.
Scenes may move, so their variance is taken from successive frames only (von Neumann's mean square successive
difference); all others use the sample variance over frames. Memory does not grow with the number of frames.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.physics.transfer.bad_lines import BadLines, bad_lines, line_means_without
from cannoise_jax.physics.transfer.ends import Extremes, lowest_share, rails, stuck_pixels, without_stuck
from cannoise_jax.physics.transfer.hits import Hits, without_hits
from cannoise_jax.physics.transfer.spots import without_spots
from cannoise_jax.recordings.codes import Spacing, code_histograms, code_lattice, spacing_of
from cannoise_jax.recordings.metadata import chunks
from cannoise_jax.recordings.packing import site
from cannoise_jax.recordings.recording import PerChannel, Recording, per_channel

_CHUNK_BYTES = 1 << 23
"""Of frames that are read at once."""
_LIT = 10.0  # a row counts as lit when its mean above black exceeds this many times the noise of that mean


@dataclass(frozen=True, eq=False)
class FrameStatistics:
    """Statistics of one recording, all in DN. Channels are mosaic sites in mosaic order (see `PerChannel`);
    `[..., H, 2]` and `[..., 2, W]` hold row and column means for even and odd columns, even and odd rows.

    mean: average frame. level: its mean per channel above the recording's black level.
    variance: temporal variance of each pixel without what rows do together; None for a single frame.
    total: temporal variance of each pixel, rows included, only frame means taken out; None likewise.
    dof: degrees of freedom of `variance` at one pixel. relative: rows were scaled, not shifted.
    low, high: code at which each channel piles up at the bottom and top; nan where it does not.
    lowest: share of the values of each channel at its lowest code, without pixels that are 0 in every frame,
      which are masked or dead; 0 where that code is neither 0 nor `low`.
    clipped: pixels that touched such a code, or the white level, or were hit by a particle, in any frame.
    stuck: pixels at an end of the codes in every frame, far from the level of the others (`ends`), and those
      of bad lines, among `clipped`; no means but `mean` hold them. None where there are none.
    bad: columns and rows that are bad (`bad_lines`).
    spacing: how far apart the codes lie along their range; None where too few values tell.
    hits: particle hits of repeated darks, which `recording` is without; None for what is none.
    spots: pixels of a flat over which stars or the like move (`spots`), among `clipped`; None for none.
    unlit: parts of a flat that no light reaches (see `unlit`), among `clipped`; dead: parts of a dark that
      never change, likewise; None where there are none.
    dark_shot: variance by channel that the dark charge of a flat, whose mean is taken out of its means
      (`black.of_one_dark`), adds beyond that of the reference dark, DN^2; None: it is not taken out.
    rounded: what rounding adds to the means of a dark that is quieter than a code, and the error of that, DN
      per site (`quiet.with_rounding_told`); None: nothing that matters.
    shot: what charge that the means are without, but the frames not, adds to the variances, DN^2; None where
      there is none.
    """

    recording: Recording
    mean: Float[np.ndarray, "H W"]
    variance: Float[np.ndarray, "H W"] | None
    total: Float[np.ndarray, "H W"] | None
    dof: float
    relative: bool
    frame_means: Float[np.ndarray, "T 4"]
    row_means: Float[np.ndarray, "T H 2"]
    column_means: Float[np.ndarray, "T 2 W"]
    level: PerChannel
    code_step: float
    low: PerChannel
    high: PerChannel
    lowest: PerChannel
    clipped: Bool[np.ndarray, "H W"]
    hits: Hits | None = None
    spots: Bool[np.ndarray, "H W"] | None = None
    unlit: Bool[np.ndarray, "H W"] | None = None
    dead: Bool[np.ndarray, "H W"] | None = None
    dark_shot: PerChannel | None = None
    rounded: tuple[PerChannel, PerChannel] | None = None
    shot: Float[np.ndarray, "H W"] | None = None
    stuck: Bool[np.ndarray, "H W"] | None = None
    bad: BadLines | None = None
    spacing: Spacing | None = None


def steady_frames(s: FrameStatistics) -> Iterator[Float[np.ndarray, "H W"]]:
    """Frames as float64 in which what rows do together is taken out, as the module's docstring says; flats
    are given above black."""
    lean = leaning(s.recording, s.column_means) if s.relative else None
    yield from _steady(s.recording, s.row_means, lean)


def of_variance(s: FrameStatistics) -> Float[np.ndarray, "H W"]:
    """The level that the variance of every pixel belongs to, over its mean level: one, but for flats whose
    rows were scaled to their harmonic mean, which under a light that drifts lies below the mean."""
    size = s.recording.size
    if not s.relative:
        return np.ones(size)
    signal = _row_signal(s.recording, s.row_means)
    ratio = 1 / (np.mean(1 / signal, axis=0) * np.mean(signal, axis=0))
    return ratio[:, np.arange(size[1]) % 2]


def _row_signal(recording: Recording, rows: Float[np.ndarray, "T H 2"]) -> Float[np.ndarray, "T H 2"]:
    black = np.asarray(recording.black_level).reshape(2, 2)
    return rows - np.stack([black[np.arange(rows.shape[1]) % 2, p] for p in (0, 1)], -1)


def leaning(recording: Recording, columns: Float[np.ndarray, "T 2 W"]) -> Float[np.ndarray, "T W"]:
    """By what factor the light of every frame differs along the rows from the mean of all frames, apart from
    a common one: a parabola, 1 in the middle."""
    black = np.asarray(recording.black_level).reshape(2, 2)[:, np.arange(columns.shape[2]) % 2]
    signal = (columns - black).mean(1)
    shape = np.polynomial.legendre.legvander(np.linspace(-1, 1, signal.shape[1]), min(2, signal.shape[1] - 1))
    found = np.linalg.lstsq(signal.mean(0)[:, None] * shape, signal.T, rcond=None)[0].T
    factor = found @ shape.T / np.maximum(found[:, :1], 1e-9)
    return np.clip(factor, 0.1, 10.0)


def _steady(recording: Recording, rows: np.ndarray, lean: np.ndarray | None) -> Iterator[np.ndarray]:
    """Frames without what rows do together; lean: of the light of a flat, whose rows are scaled; None: they
    are shifted."""
    signal = _row_signal(recording, rows)
    middle = rows.mean(0)
    harmonic = signal.shape[0] / np.sum(1 / signal, axis=0) if lean is not None else None
    at = 0
    for part in chunks(recording.frames, _CHUNK_BYTES):
        for frame in part:
            values = frame.astype(np.float64)
            if harmonic is not None and lean is not None:
                _to_light(values, recording, lean[at])
                for p in (0, 1):
                    values[:, p::2] *= (harmonic / signal[at])[:, p : p + 1]
            else:
                for p in (0, 1):
                    values[:, p::2] -= (rows[at] - middle)[:, p : p + 1]
            yield values
            at += 1


def _to_light(values: np.ndarray, recording: Recording, lean: np.ndarray) -> None:
    """Makes of the values of a frame what they are above black, without how the light leans."""
    for c, black in enumerate(recording.black_map()[:2, :2].ravel()):
        site(values, c)[...] -= np.float64(black)
    values /= lean


def frame_statistics(recording: Recording, rounds: int = 2) -> FrameStatistics:
    """All statistics of one recording, darks without their particle hits (see `hits`), flats without what
    moves over them (see `spots`). Reads its frames a few at a time, twice or some times more. rounds: in
    which spots are looked for, as strong ones hide others.

    Raises ValueError for mosaics smaller than 4 x 4.
    """
    if min(recording.size) < 4:
        raise ValueError(f"frames of {recording.size} pixels are too small for statistics")
    recording, hits = without_hits(recording)
    rows, columns, histograms, seen = _first_pass(recording)
    step = recording.code_step
    if step is None:
        step = code_lattice(histograms.sum(0)).step
    stuck, others = np.zeros(recording.size, bool), histograms
    if recording.count > 1 and recording.kind != "scene":
        frame = np.asarray(recording.frames[:1])[0].astype(np.float64)
        stuck = stuck_pixels(frame, seen, max(step, 1.0))
        rows, columns = without_stuck(rows, columns, frame, stuck)
        held = [site(frame, c)[site(stuck, c)].astype(np.int64) for c in range(4)]
        others = histograms - recording.count * np.stack([np.bincount(v, minlength=1 << 16) for v in held])
    ends = (max(step, 1.0), recording.white_level)
    # Stuck pixels at the top show where codes end; at the bottom they are masked, and cut nothing off.
    high = [rails(h, *ends)[1] for h in histograms]
    low = [rails(h, *ends)[0] for h in others]
    signal = _row_signal(recording, rows)
    relative = _is_lit(recording, signal)
    mean, variance, total, clipped = _second_pass(recording, rows, columns, relative, low, high)
    bad = None
    if variance is not None and recording.kind != "scene":
        black = np.asarray(recording.black_level) if relative else None
        least = max(float(np.sqrt(median(variance))), step)
        bad = bad_lines(mean, least, black, stuck)
        if bad is not None:
            stuck = stuck | bad.pixels
            rows, columns = line_means_without(recording.frames, stuck, _CHUNK_BYTES)
            mean, variance, total, clipped = _second_pass(recording, rows, columns, relative, low, high)
    frame_means = np.stack([rows[:, c // 2 :: 2, c % 2].mean(1) for c in range(4)], -1)
    count = recording.count
    dead = [count * int((site((mean == 0) & ~stuck, c)).sum()) for c in range(4)]
    lowest = [lowest_share(h, low[c], dead[c]) for c, h in enumerate(others)]
    clipped |= stuck
    variance, total = (v if v is None else _filled(v, stuck) for v in (variance, total))
    dof = 2 * (count - 1) ** 2 / (3 * count - 4) if recording.kind == "scene" and count > 1 else count - 1.0
    level = per_channel(frame_means.mean(0) - np.asarray(recording.black_level))
    if hits is not None:
        clipped |= hits.pixels
    found = FrameStatistics(
        recording, mean, variance, total, dof, relative, frame_means, rows, columns,
        level, float(step), per_channel(np.array(low)), per_channel(np.array(high)),
        per_channel(np.array(lowest)), clipped, hits, stuck=stuck if stuck.any() else None,
        bad=bad, spacing=spacing_of(histograms.sum(0)),
    )  # fmt: skip
    if not relative or variance is None or not rounds:
        return found
    average = np.asarray(sum(steady_frames(found))) / recording.count
    spots = without_spots(recording, steady_frames(found), average, variance)
    if spots is None:
        return found
    again = frame_statistics(spots.recording, rounds - 1)
    pixels = spots.pixels if again.spots is None else spots.pixels | again.spots
    return replace(again, clipped=again.clipped | pixels, spots=pixels)


def _filled(variance: Float[np.ndarray, "H W"], stuck: Bool[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """With the median of their channel for stuck pixels, which show no noise: so they neither raise nor lower
    that of the others."""
    if stuck.any():
        for c in range(4):
            values, held = site(variance, c), site(stuck, c)
            values[held] = median(values[~held])
    return variance


def _first_pass(recording: Recording) -> tuple[np.ndarray, np.ndarray, np.ndarray, Extremes]:
    rows, columns, histograms = [], [], np.zeros((4, 1 << 16), np.int64)
    lowest, highest = np.full(recording.size, 65535, np.uint16), np.zeros(recording.size, np.uint16)
    for part in chunks(recording.frames, _CHUNK_BYTES):
        histograms += code_histograms(part)
        values = part.astype(np.float64)
        rows.append(np.stack([values[..., p::2].mean(-1) for p in (0, 1)], -1))
        columns.append(np.stack([values[:, p::2].mean(1) for p in (0, 1)], 1))
        lowest, highest = np.minimum(lowest, part.min(0)), np.maximum(highest, part.max(0))
    return np.concatenate(rows), np.concatenate(columns), histograms, Extremes(lowest, highest)


def _is_lit(recording: Recording, signal: Float[np.ndarray, "T H 2"]) -> bool:
    """Whether rows may be scaled to a common mean: a flat whose every row is well above black."""
    if recording.kind != "flat" or recording.count < 2:
        return False
    first, second = (np.asarray(recording.frames[t], np.float64) for t in (0, 1))
    noise = robust_std(first - second) / np.sqrt(2)
    return bool(signal.min() > _LIT * max(noise, 1e-6) / np.sqrt(recording.size[1] / 2))


def _second_pass(
    recording: Recording, rows: np.ndarray, columns: np.ndarray, relative: bool, low: Any, high: Any
) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None, np.ndarray]:
    height, width = recording.size
    low = [v if np.isfinite(v) else -1.0 for v in low]
    high = [v if np.isfinite(v) else np.inf for v in high]
    signal = _row_signal(recording, rows)
    lean = leaning(recording, columns) if relative else None
    frames_signal = np.stack([signal[:, c // 2 :: 2, c % 2].mean(1) for c in range(4)], -1)  # [T, 4]
    middle_frame = 1 / np.mean(1 / frames_signal, axis=0) if relative else frames_signal.mean(0)

    # Frames may be large: only what the kind needs is kept, and changed in place.
    scene, shape = recording.kind == "scene", (height, width)
    first: np.ndarray | None = None
    previous: np.ndarray | None = None
    plain, total, total_square, kept, square = (np.zeros(shape) for _ in range(5))
    clipped = np.zeros(shape, bool)
    whole_first: np.ndarray | None = None
    steady = _steady(recording, rows, lean)
    at = 0
    for part in chunks(recording.frames, _CHUNK_BYTES):
        for frame in part:
            values = frame.astype(np.float64)
            for c in range(4):
                site(clipped, c)[...] |= (site(values, c) <= low[c]) | (site(values, c) >= high[c])
            plain += values
            pixel = next(steady)
            whole = values
            if lean is not None:
                _to_light(whole, recording, lean[at])
            for c in range(4):
                if relative:
                    site(whole, c)[...] *= middle_frame[c] / frames_signal[at, c]
                else:
                    site(whole, c)[...] -= frames_signal[at, c] - middle_frame[c]
            # Shifted by the first frame, so that sums of squares do not cancel.
            first = pixel if first is None else first
            whole_first = whole if whole_first is None else whole_first
            _add(whole - whole_first, total, total_square)
            if not scene:
                _add(pixel - first, kept, square)
            elif previous is not None:
                square += (pixel - previous) ** 2
            previous = pixel if scene else None
            at += 1
    mean = plain / at
    if at < 2:
        return mean, None, None, clipped
    loss = 1 - 1 / (width // 2)  # a row mean is fitted to every row of half the width
    variance = square / (2 * (at - 1)) if scene else _variance(kept, square, at)
    return mean, variance / loss, _variance(total, total_square, at), clipped


def _add(values: np.ndarray, total: np.ndarray, square: np.ndarray) -> None:
    """Adds values, which are spent, to a sum, and their squares to another."""
    total += values
    values *= values
    square += values


def _variance(total: np.ndarray, square: np.ndarray, count: int) -> np.ndarray:
    """From the sums of values and of their squares, which are spent."""
    total *= total
    total /= count
    square -= total
    square /= count - 1
    return square
