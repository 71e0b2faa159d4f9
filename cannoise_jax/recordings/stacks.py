"""Stacks of frames in general formats, TIFF, NPY and NPZ, with a JSON side-car that names what they lack.

The side-car lies beside the stack under the same name with the suffix .json and holds the fields of
`Recording`: {"cfa": "RGGB", "black_level": 64, "white_level": 1023, ...}; null means unknown. Other
names are not used, with a warning. Without a side-car the caller states the required fields. One image is
a recording of one frame.
"""

from __future__ import annotations

import json
import logging
import struct
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from cannoise_jax.recordings.lazy import LazyArray, read_stack
from cannoise_jax.recordings.metadata import FIELDS, check_overrides, make_recording, quiet, reading
from cannoise_jax.recordings.recording import BadInput, Recording

TIFF_SUFFIXES, NUMPY_SUFFIXES = (".tif", ".tiff"), (".npy", ".npz")
_log = logging.getLogger(__name__)


def read_numpy(path: str | Path, **overrides: Any) -> Recording:
    """A recording from an NPY file, or from `frames` (and `clean`) of an NPZ file; nothing is unpickled.

    overrides: see `metadata.OVERRIDES`. Raises BadInput.
    """
    check_overrides(overrides)
    if Path(path).suffix.lower() == ".npy":
        return _recording(path, _loaded(path), {}, overrides)
    with _loaded(path) as archive:
        names = archive.files
        frames_name = "frames" if "frames" in names else names[0] if len(names) == 1 else None
        if frames_name is None:
            raise BadInput(f"{path}: holds {', '.join(names) or 'nothing'}: expected an array 'frames'")
    known = {"clean": _read_npz(str(path), "clean")} if "clean" in names else {}
    return _recording(path, _read_npz(str(path), frames_name), known, overrides)


def read_tiff(path: str | Path, **overrides: Any) -> Recording:
    """A recording from the pages of a TIFF file, one a frame, read when they are indexed.

    overrides: see `metadata.OVERRIDES`. Raises BadInput.
    """
    check_overrides(overrides)
    if not Path(path).is_file():
        raise BadInput(f"{path}: no such file")
    with reading(path, "not a readable TIFF file"), quiet("tifffile"), tifffile.TiffFile(path) as file:
        shapes = {page.shape for page in file.pages}
        types = {page.dtype for page in file.pages}
        count = len(file.pages)
        whole = _is_whole(file, Path(path).stat().st_size)
    if not whole:
        raise BadInput(f"{path}: not a readable TIFF file: truncated after {count} pages")
    size = next(iter(shapes))
    if len(shapes) > 1 or len(types) > 1 or len(size) != 2:
        raise BadInput(f"{path}: pages of shape {', '.join(map(str, sorted(shapes)))}: expected mosaics")
    shape = (count, *size)
    read = partial(read_stack, partial(_read_page, path=str(path)), shape)
    return _recording(path, LazyArray(read, shape, np.dtype(next(iter(types)))), {}, overrides)


def _recording(path: str | Path, frames: Any, known: dict[str, Any], overrides: dict[str, Any]) -> Recording:
    if len(frames.shape) == 2:
        frames = frames[None]
    if frames.dtype.kind == "u" and frames.dtype.itemsize <= 2 and frames.dtype != np.uint16:
        frames = np.asarray(frames).astype(np.uint16)  # 8 bits, or the other byte order
    return make_recording(path, frames, _side_car(path) | known, overrides)


def _side_car(path: str | Path) -> dict[str, Any]:
    beside = Path(path).with_suffix(".json")
    if not beside.is_file():
        return {}
    with reading(beside, "not a readable JSON file"):
        stated = json.loads(beside.read_text(encoding="utf-8"))
    if not isinstance(stated, dict):
        raise BadInput(f"{beside}: expected an object with the fields of a recording")
    unknown = sorted(set(stated) - set(FIELDS))
    if unknown:
        _log.warning("%s: %s not used: the fields are %s", beside, ", ".join(unknown), ", ".join(FIELDS))
    return {name: value for name, value in stated.items() if name in FIELDS}


def _loaded(path: str | Path) -> Any:
    if not Path(path).is_file():
        raise BadInput(f"{path}: no such file")
    with reading(path, "not a readable NumPy file"):
        loaded = np.load(path, mmap_mode="r", allow_pickle=False)
    if isinstance(loaded, np.ndarray) != (Path(path).suffix.lower() == ".npy"):
        raise BadInput(f"{path}: the content does not fit the suffix")
    return loaded


def _read_npz(path: str, name: str) -> np.ndarray:
    with reading(path, f"cannot read {name}"), np.load(path, allow_pickle=False) as archive:
        return archive[name]


def _read_page(number: int, *, path: str) -> np.ndarray:
    with reading(path, f"cannot read page {number}"):
        return tifffile.imread(path, key=number)


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
