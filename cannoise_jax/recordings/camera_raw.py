"""Camera raw files (DNG, NEF, CR2, CR3, ARW, ...) through LibRaw, and what only their tags tell.

LibRaw gives the stored values, the visible area and its colour order; fractional black levels and the noise
profile of a DNG come from its tags (DNG specification 1.7), the camera's name and temperature from Exif.
The frame is the visible area, less its last row or column where a size is odd. LibRaw moves a visible area
that starts at an odd row or column to the next even one; colours and black levels here follow the pixels.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rawpy
from jaxtyping import UInt16

from cannoise_jax.recordings.lazy import LazyArray, read_stack
from cannoise_jax.recordings.metadata import check_overrides, make_recording, reading
from cannoise_jax.recordings.opened import HEADERLESS, Opened
from cannoise_jax.recordings.raw_tags import (
    ACTIVE_AREA,
    BLACK,
    BLACK_DELTAS,
    BLACK_REPEAT,
    CFA_PATTERN,
    CFA_PLANE_COLOUR,
    EXPOSURE,
    ISO,
    MASKED_AREAS,
    Directory,
    camera_name,
    directories_of,
    exif_of,
    first_number,
    noise_profile,
    tag_of,
)
from cannoise_jax.recordings.recording import BadInput, PerChannel, Recording, per_channel

SUFFIXES = (
    *(".dng", ".nef", ".nrw", ".cr2", ".cr3", ".crw", ".arw", ".sr2", ".srf", ".raf", ".orf", ".rw2", ".pef"),
    *(".srw", ".x3f", ".3fr", ".iiq", ".erf", ".mef", ".mos", ".mrw", ".dcr", ".kdc", ".rwl", ".raw"),
)


class BorderRegion(NamedTuple):
    """A rectangle of the sensor outside the visible area, in capture order of rows and columns.

    top, left: its corner counted from the corner of the recording's frame, so (top + i) % 2, (left + j) % 2
    is the mosaic site of pixel (i, j).
    """

    top: int
    left: int
    pixels: UInt16[np.ndarray, "h w"]


class _Decoded(NamedTuple):
    sensor: np.ndarray  # all pixels that the file holds
    top: int
    left: int
    size: tuple[int, int]  # of the visible area, even for a Bayer mosaic
    cfa: str
    black: PerChannel
    white: float
    iso: float | None
    exposure_s: float | None


def read_camera_raw(path: str | Path, **overrides: Any) -> Recording:
    """A recording of one frame from a camera raw file, decoded again whenever it is indexed.

    shot, read: the DNG NoiseProfile, variance = S x + O in normalised units, where the file has one.
    overrides: see `metadata.OVERRIDES`. Raises BadInput, also for mosaics that are not Bayer.
    """
    check_overrides(overrides)
    opened = open_camera_raw(path)
    recording = make_recording(path, opened.frames, opened.known, overrides)
    read_again = partial(read_stack, partial(_read_frame, path=str(path)), recording.frames.shape)
    return replace(recording, frames=LazyArray(read_again, recording.frames.shape, np.dtype(np.uint16)))


def open_camera_raw(path: str | Path) -> Opened:
    """The frame of a camera raw file, in memory, and what it states. Raises BadInput.

    Where the file states no black level, or 0, that of the masked pixels is taken if there are any.
    """
    if not Path(path).is_file():
        raise BadInput(f"{path}: no such file")
    tags = directories_of(path)
    raw = _decode(path, tags)
    with reading(path, "tags that make no sense: the file is damaged"):
        known, about = _stated(path, tags, raw)
    return Opened(np.ascontiguousarray(_visible(raw))[None], known, about)


def _stated(path: str | Path, tags: list[Directory], raw: _Decoded) -> tuple[dict[str, Any], dict[str, Any]]:
    """What a file says of its frame, and where the black level is from."""
    shot, read = noise_profile(path, tags, raw.cfa)
    black, about = _exact_black(tags, raw) or raw.black, {}
    if not any(black):
        masked = _median_of(_masked(tags, raw))
        if masked is not None:
            black, about = masked, {"black_from": "masked pixels"}
    known: dict[str, Any] = {
        "cfa": raw.cfa,
        "black_level": black,
        "white_level": raw.white,
        "iso": raw.iso or first_number(tags, *ISO),
        "exposure_s": raw.exposure_s or first_number(tags, EXPOSURE),
        "shot": shot,
        "read": read,
        **exif_of(path),
    }
    known["camera"] = known.get("camera") or camera_name(tags)
    return known, about


def _masked(tags: list[Directory], raw: _Decoded) -> tuple[BorderRegion, ...]:
    """The masked pixels around the visible area: a DNG's MaskedAreas, or else all four borders; empty where
    the file stores none. The pixels nearest to the visible area may see stray light."""
    rows, columns = raw.sensor.shape
    bottom, right = raw.top + raw.size[0], raw.left + raw.size[1]
    masked = tag_of(tags, MASKED_AREAS)
    if masked is not None:
        areas = [tuple(area) for area in np.reshape(masked, (-1, 4)).astype(int)]
    else:
        areas = [
            (0, 0, raw.top, columns),
            (bottom, 0, rows, columns),
            (raw.top, 0, bottom, raw.left),
            (raw.top, right, bottom, columns),
        ]
    return tuple(
        BorderRegion(t - raw.top, left - raw.left, np.ascontiguousarray(raw.sensor[t:b, left:r]))
        for t, left, b, r in areas
        if b > t and r > left
    )


def _median_of(regions: tuple[BorderRegion, ...]) -> PerChannel | None:
    """Median of the masked pixels of each mosaic site, DN, mosaic order; None where a site has none."""
    sites: list[list[np.ndarray]] = [[], [], [], []]
    for region in regions:
        for site in range(4):
            first = (site // 2 - region.top) % 2, (site % 2 - region.left) % 2
            sites[site].append(region.pixels[first[0] :: 2, first[1] :: 2].ravel())
    pixels = [np.concatenate([np.empty(0, np.uint16), *parts]) for parts in sites]
    if not all(p.size for p in pixels):
        return None
    return per_channel(np.array([np.median(p) for p in pixels]))


def _visible(raw: _Decoded) -> np.ndarray:
    height, width = raw.size
    return raw.sensor[raw.top : raw.top + height, raw.left : raw.left + width]


def _read_frame(number: int, *, path: str) -> np.ndarray:
    return np.ascontiguousarray(_visible(_decode(path, directories_of(path))))


def _decode(path: str | Path, directories: list[Directory]) -> _Decoded:
    _check_directories(path, directories)
    other = f", perhaps {HEADERLESS}" if Path(path).suffix.lower() == ".raw" else ""
    with (
        reading(path, f"not a readable camera raw file{other}"),
        _off_the_screen(),
        rawpy.imread(str(path)) as raw,
    ):
        cfa, colours = _mosaic(path, raw)
        sizes = raw.sizes
        even = (lambda n: n) if cfa == "MONO" else (lambda n: n - n % 2)
        return _Decoded(
            sensor=np.array(raw.raw_image, np.uint16),
            top=sizes.top_margin,
            left=sizes.left_margin,
            size=(even(sizes.height), even(sizes.width)),
            cfa=cfa,
            black=per_channel(np.array(raw.black_level_per_channel, np.float64)[colours]),
            white=float(raw.white_level),
            iso=raw.other.iso_speed or None,
            exposure_s=raw.other.shutter_speed or None,
        )


@contextmanager
def _off_the_screen() -> Iterator[None]:
    """LibRaw also prints what is wrong with a file; the error that it gives says it."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


_COLOURS = {0: "red", 1: "green", 2: "blue", 3: "cyan", 4: "magenta", 5: "yellow", 6: "white"}
"""Of CFAPattern (TIFF/EP, ISO 12234-2)."""


def _check_directories(path: str | Path, directories: list[Directory]) -> None:
    """What LibRaw would take without complaint: strips cut short, and colour planes in another order."""
    size = Path(path).stat().st_size
    needed = max((d.end for d in directories), default=0)
    if needed > size:
        raise BadInput(f"{path}: truncated: {size} bytes of at least {needed}")
    cells = tag_of(directories, CFA_PATTERN)
    sites = list(cells) if isinstance(cells, (bytes, tuple, list)) else []
    if any(code not in (0, 1, 2) for code in sites):
        named = ", ".join(_COLOURS.get(code, str(code)) for code in dict.fromkeys(sites))
        raise BadInput(f"{path}: mosaic of {named}: only Bayer mosaics of red, green and blue are supported")
    planes = tag_of(directories, CFA_PLANE_COLOUR)
    listed = list(planes) if isinstance(planes, (bytes, tuple, list)) else [planes]
    if planes is not None and listed != [0, 1, 2]:
        raise BadInput(f"{path}: colour planes {listed} are not red, green, blue: LibRaw would misname them")


def _mosaic(path: str | Path, raw: Any) -> tuple[str, np.ndarray]:
    """The colour order of the visible area, and the colour number of each mosaic site."""
    pattern = raw.raw_pattern if raw.raw_type == rawpy.RawType.Flat else None
    if raw.raw_type == rawpy.RawType.Flat and raw.num_colors == 1:
        return "MONO", np.zeros(4, int)
    if pattern is None:
        raise BadInput(f"{path}: all colours in every pixel (Foveon or demosaiced): a Bayer mosaic is needed")
    letters = "".join(chr(raw.color_desc[c]) for c in pattern.ravel())
    if pattern.shape != (2, 2) or letters not in ("RGGB", "GRBG", "GBRG", "BGGR"):
        kind = "X-Trans" if pattern.shape == (6, 6) else letters
        raise BadInput(
            f"{path}: {kind} mosaic: only Bayer mosaics and monochrome sensors are supported: all "
            "that is measured and simulated goes by the four sites of a 2x2 cell"
        )
    return letters, pattern.ravel().astype(int)


def _exact_black(tags: list[Directory], raw: _Decoded) -> PerChannel | None:
    """BlackLevel with its fraction where a DNG states it for the 2x2 cell or for all; LibRaw rounds it."""
    page = next((d.tags for d in tags if BLACK in d.tags), None)
    if page is None or any(code in page for code in BLACK_DELTAS):
        return None
    values = np.ravel(page[BLACK]).astype(np.float64)
    repeat = tuple(np.ravel(page.get(BLACK_REPEAT, (1, 1))))
    if isinstance(page[BLACK], tuple) and len(values) == 2 * repeat[0] * repeat[1]:  # numerator, denominator
        values = values[::2] / values[1::2]
    if repeat not in ((1, 1), (2, 2)) or len(values) != repeat[0] * repeat[1]:
        return None
    if repeat == (1, 1):
        return per_channel(values)
    # The cell starts at the corner of the active area, the frame where LibRaw lets the visible area start.
    top, left, *_ = page.get(ACTIVE_AREA, (0, 0))
    cell = np.roll(values.reshape(2, 2), (-(raw.top - top), -(raw.left - left)), (0, 1))
    return per_channel(cell)
