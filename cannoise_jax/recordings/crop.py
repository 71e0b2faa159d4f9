"""Parts of every frame: the middle, where whole frames would take too long, or any other rectangle."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import numpy as np

from cannoise_jax.recordings.lazy import LazyArray
from cannoise_jax.recordings.recording import CaptureSet, Recording

Place = tuple[slice, slice]
"""Rows and columns of a frame."""


def central(capture: CaptureSet, most_pixels: int) -> tuple[CaptureSet, tuple[int, int] | None]:
    """The recordings cut to at most so many pixels about their middle, in the shape of the frame, and that
    size; None where nothing is cut. Cuts start at even rows and columns, so that colours stay."""
    sizes = {r.size for r in capture.recordings}
    height, width = max(sizes, key=lambda s: s[0] * s[1])
    if len(sizes) > 1 or height * width <= most_pixels:
        return capture, None
    scale = (most_pixels / (height * width)) ** 0.5
    size = max(2, int(height * scale) // 2 * 2), max(2, int(width * scale) // 2 * 2)
    start = (height - size[0]) // 4 * 2, (width - size[1]) // 4 * 2
    place = slice(start[0], start[0] + size[0]), slice(start[1], start[1] + size[1])
    return cut_to(capture, place), size


def cut_to(capture: CaptureSet, place: Place) -> CaptureSet:
    """The recordings, all of one size, cut to a rectangle, which has to start at an even row and column."""
    size = place[0].stop - place[0].start, place[1].stop - place[1].start
    cut = tuple(_cut(r, place, size) for r in capture.recordings)
    return dataclasses.replace(capture, recordings=cut)


def _cut(recording: Recording, place: Place, size: tuple[int, int]) -> Recording:
    clean: Any = recording.clean
    if clean is not None:
        clean = np.asarray(clean[place]) if clean.ndim == 2 else _view(clean, place, size)
    return dataclasses.replace(recording, frames=_view(recording.frames, place, size), clean=clean)


def _view(frames: Any, place: Place, size: tuple[int, int]) -> LazyArray:
    return LazyArray(partial(_read, frames, place), (len(frames), *size), np.dtype(frames.dtype))


def _read(frames: Any, place: Place, index: Any) -> np.ndarray:
    first, *rest = index if isinstance(index, tuple) else (index,)
    values = np.asarray(frames[first])[..., place[0], place[1]]
    return values[(..., *rest, *[slice(None)] * (2 - len(rest)))] if rest else values
