"""Parts of flats that no light reaches: overscan that no header states, the outside of an image circle, dead
blocks. They say nothing of gain and sensitivities, and rows or shading that hold them are no patterns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool
from scipy import ndimage

from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.physics.transfer.black import black_level
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.recordings.metadata import chunks
from cannoise_jax.recordings.packing import site
from cannoise_jax.recordings.recording import DARK, Recording

_DARK = 0.05
"""Share of the light of the brightest tenth below which a part counts as unlit: the corners of a lens with
cos^4 at 60 degrees off the axis still have 0.06."""
_SIDE = 9
"""Pixels of the mosaic that are judged together, so that neither single dead pixels nor dust counts."""
_CLEAR = 6.0
"""Standard errors of such a mean that the limit has to lie above black: dimmer flats tell nothing."""
_SURE, _LESS = 6.0, 0.5
"""Standard errors, and of the charge of the others, by which that of a part is less."""
LEAST = 0.001
"""Share of a flat from which unlit parts are told."""
_KEPT = 0.5
"""Share of the lit pixels that the largest rectangle has to hold for frames to be cut to it: of an image
circle that touches two sides of the frame it holds 0.64 at least."""
_CELLS = 128
"""Cells of a frame along either side from which the rectangle is put together."""
NO_PART = ": they take no part"
"""What follows where an unlit part is."""
UNLIT = "no light reaches a part of the flats: record flats that fill the frame, or cut that part off"


def unlit(s: FrameStatistics, black: Sequence[float]) -> Bool[np.ndarray, "H W"]:
    """Pixels of a flat in parts that no light reaches; none of other recordings, or of dim flats.

    black: level per mosaic site, DN.
    """
    none = np.zeros(s.mean.shape, bool)
    if s.recording.kind != "flat" or min(s.mean.shape) < 2 * _SIDE:
        return none
    light, noise = np.empty(s.mean.shape), []
    for c in range(4):
        signal = site(s.mean, c) - black[c]
        level = float(np.quantile(signal, 0.9))
        if level <= 0:
            return none
        site(light, c)[...] = signal / level
        noise.append(robust_std(np.diff(signal, axis=1)) / level)
    if _CLEAR * max(noise) / _SIDE > _DARK:
        return none
    dark = ndimage.uniform_filter(light, _SIDE) < _DARK
    # A mean beside the light holds some of it; a part that is thinner than that goes on beside a thicker one.
    around = np.ones((3, 3), bool)
    return ndimage.binary_dilation(dark, around, iterations=2 * _SIDE, mask=light < 2 * _DARK)


def without_unlit(statistics: Sequence[FrameStatistics]) -> list[FrameStatistics]:
    """The statistics with unlit parts of flats among the pixels that are not used (`clipped`), and of darks
    the parts there that never change, or gather no charge where the others do: overscan has none."""
    black = black_level(statistics).level
    masks = [unlit(s, black) for s in statistics]
    told = [m for m in masks if m.mean() >= LEAST]
    if not told:
        return list(statistics)
    always = np.logical_and.reduce(told)
    no_charge = always & (always.any() and _gathers_none(statistics, always))
    out = []
    for s, mask in zip(statistics, masks, strict=True):
        if mask.mean() >= LEAST:
            s = replace(s, clipped=s.clipped | mask, unlit=mask)
        elif s.recording.kind != "flat" and s.variance is not None:
            dead = no_charge | (always & _never_changes(s.recording))
            s = replace(s, clipped=s.clipped | dead, dead=dead) if dead.any() else s
        out.append(s)
    return out


def lit_rectangle(statistics: Sequence[FrameStatistics]) -> tuple[slice, slice] | None:
    """The largest rectangle of the frame that light reaches in all flats, from even rows and columns; None
    where all is lit, or much of the light falls elsewhere. Unlit parts within the frame are its defects.

    statistics: as `without_unlit` gives them, of frames of one size.
    """
    masks = [s.unlit for s in statistics if s.unlit is not None]
    if not masks:
        return None
    parts, _ = ndimage.label(np.logical_or.reduce(masks))
    edges = np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]])
    dark = np.isin(parts, edges[edges > 0])
    if not dark.any():
        return None
    side = 2 * -(-max(dark.shape) // (2 * _CELLS))
    h, w = (n // side for n in dark.shape)
    cells = dark[: h * side, : w * side].reshape(h, side, w, side)
    top, left, rows, columns = _largest(np.logical_not(cells.any((1, 3))))
    if rows * columns * side**2 < _KEPT * np.sum(~dark):
        return None
    return slice(top * side, (top + rows) * side), slice(left * side, (left + columns) * side)


def _largest(free: Bool[np.ndarray, "h w"]) -> tuple[int, int, int, int]:
    """First row and column, height and width of the largest rectangle of free cells."""
    best, height = (0, 0, 0, 0), np.zeros(free.shape[1] + 1, int)
    for row, line in enumerate(free):
        height[:-1] = np.where(line, height[:-1] + 1, 0)
        open_ = list[tuple[int, int]]()  # first column and height of rectangles that may still grow
        for column, tall in enumerate(height):
            first = column
            while open_ and open_[-1][1] >= tall:
                first, reached = open_.pop()
                if reached * (column - first) > best[2] * best[3]:
                    best = row - reached + 1, first, reached, column - first
            open_.append((first, int(tall)))
    return best


def _gathers_none(statistics: Sequence[FrameStatistics], mask: Bool[np.ndarray, "H W"]) -> bool:
    """Whether the dark charge of a part is not that of the rest, by the longest dark less the shortest."""
    darks = [s for s in statistics if s.recording.kind in DARK and s.variance is not None]
    known = [(0.0 if s.recording.kind == "bias" else s.recording.exposure_s, s) for s in darks]
    timed = sorted(((t, n) for n, (t, _) in enumerate(known) if t is not None))
    if len(timed) < 2 or timed[0][0] == timed[-1][0]:
        return False
    grown = known[timed[-1][1]][1].mean - known[timed[0][1]][1].mean
    inside, outside = (float(median(grown[at])) for at in (mask, ~mask))
    error = robust_std(grown) / np.sqrt(mask.sum())
    return outside - inside > max(_SURE * error, _LESS * outside)


def _never_changes(recording: Recording) -> Bool[np.ndarray, "H W"]:
    """Pixels among which more than half have one value in all frames."""
    same = np.ones(recording.size, bool)
    first = np.asarray(recording.frames[0])
    for part in chunks(recording.frames):
        same &= (part == first).all(0)
    return ndimage.uniform_filter(same.astype(np.float32), _SIDE) > 0.5


def unlit_line(statistics: Sequence[FrameStatistics]) -> str:
    """Which flat has the largest part that no light reaches, and where; empty where none has. statistics: as
    `without_unlit` gives them."""
    parts = [(s.unlit, s) for s in statistics if s.unlit is not None]
    if not parts:
        return ""
    mask, s = max(parts, key=lambda part: float(part[0].mean()))
    where = lines_of("columns", mask, 0) or lines_of("rows", mask, 1)
    name = s.recording.path or s.recording.camera
    return (
        f"{name}: no light reaches {100 * mask.mean():.1f} % of its pixels{where}{NO_PART} in gain and "
        "sensitivities: record flats that fill the frame, or cut that part off all frames"
    )


def lines_of(what: str, mask: Bool[np.ndarray, "H W"], axis: int) -> str:
    """The lines, counted from 1, where they are all that is unlit, and wholly; empty else."""
    whole = mask.all(axis)
    if not np.array_equal(mask, np.broadcast_to(np.expand_dims(whole, axis), mask.shape)):
        return ""
    parts, _ = ndimage.label(whole)
    spans = [(int(part[0].start) + 1, int(part[0].stop)) for part in ndimage.find_objects(parts)]
    return f" ({what} " + ", ".join(f"{a}" if a == b else f"{a} to {b}" for a, b in spans) + ")"
