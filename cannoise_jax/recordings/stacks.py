"""Stacks of frames in general formats, TIFF, NPY and NPZ, with a JSON side-car that names what they lack.

The side-car lies beside the stack under the same name with the suffix .json and holds the fields of
`Recording`: {"cfa": "RGGB", "black_level": 64, "white_level": 1023, ...}; null means unknown. Other
names are not used, with a warning. Without a side-car the caller states the required fields. One image is
a recording of one frame.
"""

from __future__ import annotations

import contextlib
import logging
import struct
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from PIL import Image

from cannoise_jax.recordings.lazy import LazyArray, read_stack
from cannoise_jax.recordings.metadata import FIELDS, check_overrides, make_recording, quiet, reading
from cannoise_jax.recordings.opened import Opened, any_size, check_claim, check_pixels, json_of, whole_numbers
from cannoise_jax.recordings.recording import BadInput, Recording
from cannoise_jax.recordings.tiff_chain import check_chain

TIFF_SUFFIXES, NUMPY_SUFFIXES = (".tif", ".tiff"), (".npy", ".npz")
_NO_LEVELS = {0: "values count down from white (WhiteIsZero)", 3: "values are places in a palette of colours"}
"""What numbers of a TIFF mean, by its PhotometricInterpretation, that are no light."""
_LOSSY = {6: "JPEG", 7: "JPEG", 34892: "lossy JPEG"}
"""Values of its Compression that keep no pixel as it was."""
_LZW = 5
"""Value of the same that Pillow reads, and tifffile alone does not."""
_READ = (1, 8, 32773, 32946, 34925, 50000, _LZW)
"""Values of it that are read: none, Deflate, PackBits, LZMA, Zstandard."""
_log = logging.getLogger(__name__)


def read_numpy(path: str | Path, **overrides: Any) -> Recording:
    """A recording from an NPY file, or from `frames` (and `clean`) of an NPZ file; nothing is unpickled.

    overrides: see `metadata.OVERRIDES`. Raises BadInput.
    """
    check_overrides(overrides)
    opened = open_numpy(path)
    return make_recording(path, opened.frames, opened.known, overrides)


def open_numpy(path: str | Path) -> Opened:
    """The frames of an NPY or NPZ file, and what its side-car states. Raises BadInput."""
    if Path(path).suffix.lower() == ".npy":
        return _opened(path, _loaded(path), {})
    with _loaded(path) as archive:
        names = archive.files
        frames_name = "frames" if "frames" in names else names[0] if len(names) == 1 else None
        if frames_name is None:
            raise BadInput(f"{path}: holds {', '.join(names) or 'nothing'}: expected an array 'frames'")
    known = {"clean": _read_npz(str(path), "clean")} if "clean" in names else {}
    return _opened(path, _read_npz(str(path), frames_name), known)


def read_tiff(path: str | Path, **overrides: Any) -> Recording:
    """A recording from the pages of a TIFF file, one a frame, read when they are indexed.

    overrides: see `metadata.OVERRIDES`. Raises BadInput.
    """
    check_overrides(overrides)
    opened = open_tiff(path)
    return make_recording(path, opened.frames, opened.known, overrides)


def open_tiff(path: str | Path) -> Opened:
    """The pages of a TIFF file, and what its side-car states. Raises BadInput."""
    if not Path(path).is_file():
        raise BadInput(f"{path}: no such file")
    check_chain(path)
    with reading(path, "not a readable TIFF file"), quiet("tifffile"), tifffile.TiffFile(path) as file:
        pages = _pages(file)
        shapes = {page.shape for page in pages}
        types = {page.dtype for page in pages}
        count = len(pages)
        whole = _is_whole(file, Path(path).stat().st_size)
        squeezed = {int(page.compression) for page in pages}
        meanings = {int(page.photometric) for page in pages if page.photometric is not None}
    if squeezed & _LOSSY.keys():
        how = _LOSSY[(squeezed & _LOSSY.keys()).pop()]
        raise BadInput(f"{path}: compressed as {how}, which changes the pixels: give the raw frames")
    if unread := sorted(squeezed - set(_READ)):
        raise BadInput(f"{path}: its compression (number {unread[0]}) is not read: save it without")
    if not whole:
        raise BadInput(f"{path}: not a readable TIFF file: truncated after {count} pages")
    size = next(iter(shapes))
    if len(shapes) == 1 and len(size) == 3 and {size[0], size[-1]} & {3, 4}:
        raise BadInput(
            f"{path}: pages of shape {size} hold colours: give the raw mosaics, one frame a page (tifffile "
            "takes a stack of three or four for colours unless it is told photometric='minisblack')"
        )
    if len(shapes) > 1 or len(types) > 1 or len(size) != 2:
        raise BadInput(f"{path}: pages of shape {', '.join(sorted(map(str, shapes)))}: expected mosaics")
    if meanings & set(_NO_LEVELS):
        raise BadInput(f"{path}: {_NO_LEVELS[(meanings & set(_NO_LEVELS)).pop()]}: give the raw mosaics")
    shape = (count, *size)
    read = partial(read_stack, partial(_read_lzw if _LZW in squeezed else _read_page, path=str(path)), shape)
    kind = next(iter(types))
    if not all(type(n) is int and n > 0 for n in shape):
        raise BadInput(f"{path}: not a readable TIFF file: its sizes are no whole numbers")
    check_claim(path, shape, np.dtype(kind).itemsize)
    return _opened(path, LazyArray(read, shape, np.dtype(kind)), {})


def _opened(path: str | Path, frames: Any, known: dict[str, Any]) -> Opened:
    check_pixels(path, tuple(frames.shape))
    if len(frames.shape) == 2:
        frames = frames[None]
    about = {"bits": 8} if frames.dtype.itemsize == 1 else {}
    if frames.dtype != np.uint16:  # 8 bits, the other byte order, or whole numbers of another type
        frames = whole_numbers(path, np.asarray(frames))
    return Opened(frames, side_car(path) | known, about)


def side_car(path: str | Path) -> dict[str, Any]:
    """The fields of a recording that the .json beside a file states. Raises BadInput."""
    beside = Path(path).with_suffix(".json")
    if beside.is_symlink() and not beside.exists():
        raise BadInput(f"{beside}: a link to nothing: mend or remove it")
    if not beside.is_file():
        return {}
    with reading(beside, "not a readable JSON file"):
        stated = json_of(beside.read_text(encoding="utf-8-sig"))  # editors on Windows write a mark first
    if not isinstance(stated, dict):
        raise BadInput(f"{beside}: expected an object with the fields of a recording")
    unknown = sorted(set(stated) - set(FIELDS))
    if unknown:
        _log.warning("%s: %s not used: the fields are %s", beside, ", ".join(unknown), ", ".join(FIELDS))
    return {name: value for name, value in stated.items() if name in FIELDS}


def _loaded(path: str | Path) -> Any:
    if not Path(path).is_file():
        raise BadInput(f"{path}: no such file")
    with reading(path, "not a readable NumPy file"), _no_objects(path):
        loaded = np.load(path, mmap_mode="r", allow_pickle=False)
    if isinstance(loaded, np.ndarray) != (Path(path).suffix.lower() == ".npy"):
        raise BadInput(f"{path}: the content does not fit the suffix")
    return loaded


def _read_npz(path: str, name: str) -> np.ndarray:
    with (
        reading(path, f"cannot read {name}"),
        _no_objects(path),
        np.load(path, allow_pickle=False) as archive,
    ):
        return archive[name]


@contextlib.contextmanager
def _no_objects(path: str | Path) -> Iterator[None]:
    """Says of an array of Python objects what to do, which NumPy does not."""
    try:
        yield
    except ValueError as error:
        if "(object)" in str(error):  # NumPy takes what it does not know for a pickle
            raise ValueError("it begins as neither .npy nor .npz do") from error
        if "object" not in str(error).lower():
            raise
        raise BadInput(
            f"{path}: holds Python objects, which are not read: save the frames alone, as an array of uint16"
        ) from error


def _read_page(number: int, *, path: str) -> np.ndarray:
    with reading(path, f"cannot read page {number}"), quiet("tifffile"):
        return tifffile.imread(path, key=number)


def _read_lzw(number: int, *, path: str) -> np.ndarray:
    with (
        reading(path, f"cannot read page {number}"),
        any_size(),
        Image.open(path, formats=("TIFF",)) as image,
    ):
        image.seek(number)
        return np.array(image)


def _pages(file: tifffile.TiffFile) -> list[Any]:
    """The pages, in order. Raises ValueError where the directories of a damaged file lead back to an earlier
    one, which tifffile would follow for ever."""
    found: dict[int, Any] = {}
    for page in file.pages:
        if page.offset in found:
            raise ValueError(f"directory {len(found)} leads back to an earlier one")
        found[page.offset] = page
    return list(found.values())


def _is_whole(file: tifffile.TiffFile, size: int) -> bool:
    """Whether all strips and the chain of directories end inside the file: tifffile stops in silence."""
    tiff, last = file.tiff, file.pages[-1]
    file.filehandle.seek(last.offset)
    (tags,) = struct.unpack(tiff.tagnoformat, file.filehandle.read(tiff.tagnosize))
    file.filehandle.seek(tags * tiff.tagsize, 1)
    (following,) = struct.unpack(tiff.offsetformat, file.filehandle.read(tiff.offsetsize))
    pages = [page.aspage() for page in file.pages]
    ends = [sum(strip) for p in pages for strip in zip(p.dataoffsets, p.databytecounts, strict=False)]
    return following == 0 and max(ends, default=0) <= size
