"""What a reader hands on: the frames of a file, what the file states of them, and what only plans ask for."""

from __future__ import annotations

import contextlib
import json
import math
import sys
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from tokenize import TokenError
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from cannoise_jax.recordings.recording import BadInput, Frames


class Developed(BadInput):
    """A picture in colours, which is no raw frame."""


MOST_PIXELS = 1 << 30
"""Of a file: more, and what it says of its size is not believed before memory is asked for it."""
_DENSEST = 2000
"""No compression that the formats use packs more bytes than this into one (deflate: 1032)."""
BROKEN_ARRAYS = (
    *(OSError, ValueError, EOFError, SyntaxError, TokenError, NotImplementedError, RuntimeError),
    *(zlib.error, zipfile.BadZipFile),
)
"""What NumPy raises over NPY and NPZ files that are damaged or no such files."""
HEADERLESS = (
    "values without a header: read them with numpy.fromfile, unpack 10 or 12 packed bits, and numpy.save "
    "them as uint16 frames x rows x columns (.npy)"
)
"""What files are that some programs call .raw, and what to do with them."""
_NARROW = 8
"""Rows and columns of the least picture."""
_WHOLE_FLOAT16 = 2048
"""Up to which float16 holds every whole number."""
_SPARE_FRAME, _SPARE_STACK = 64 << 20, 4 << 30
"""Bytes that a file may claim beyond what it can hold: HDF5 leaves out what is all zero."""


class Opened(NamedTuple):
    """A file that was opened and not yet judged.

    frames: `uint16[T, H, W]`, mostly lazy. known: fields of `Recording` that the file states.
    about: what a file may state beside them, None or absent where it does not:
      image_type (the header's own words), object (what was looked at), filter, binning, origin (of a
      sub-frame), offset (of the camera's black, in its own steps), mode (of the readout), gain_setting (in
      the camera's own unit, where its scale is unknown), set_temperature_c, taken_s (when the exposure began,
      of any epoch),
      settings (words of the readout and what they say, see `fits_readout`),
      combined (how many frames were averaged or added, or the words that say so), black_from (what
      `black_level` was measured on), bits (8 where a file holds no more, whose values are in other units than
      those of 16).
    """

    frames: Frames
    known: dict[str, Any]
    about: Mapping[str, Any] = {}


def check_plain(path: str | Path, instead: str) -> None:
    """Raises BadInput for what is no plain file, with what to do instead: whoever reads from a pipe waits
    until somebody writes into it, perhaps for ever."""
    path = Path(path)
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "is no plain file (a pipe or device)"
        raise BadInput(f"{path}: {what}: {instead}")


def plainly(error: BaseException) -> str:
    """What is wrong with a file of JSON that could not be read or lacks something, in plain words."""
    if isinstance(error, OSError):
        return (error.strerror or type(error).__name__).lower()
    if isinstance(error, KeyError):
        return f"{error} is missing"
    if isinstance(error, UnicodeDecodeError):
        return "it is no text"
    if isinstance(error, RecursionError):
        return "it is nested too deep"
    if isinstance(error, TypeError | AttributeError):
        return "its values are of other kinds"
    return " ".join(str(error).split())


def json_of(text: str) -> Any:
    """What a text in JSON holds. Raises ValueError, also for a name that is stated twice in one object, for
    which of both is meant nobody can tell, and for whole numbers beyond any float. Raises RecursionError for
    what is nested too deep."""

    def whole(digits: str) -> int:
        number = int(digits)
        if abs(number) > sys.float_info.max:
            raise ValueError(f"{digits[:8]}... is a number of {len(digits)} digits")
        return number

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        names = [name for name, _ in pairs]
        twice = next((name for name in names if names.count(name) > 1), None) if len(names) < 1000 else None
        if twice is not None:
            raise ValueError(f"{twice!r} is stated twice")
        return dict(pairs)

    return json.loads(text, object_pairs_hook=once, parse_int=whole)


def stated(known: Mapping[str, Any]) -> dict[str, Any]:
    """What is not None."""
    return {name: value for name, value in known.items() if value is not None}


def check_claim(path: str | Path, shape: tuple[int, ...], itemsize: int) -> None:
    """Raises BadInput for frames larger than any sensor's, or than the file can hold, unread."""
    pixels = math.prod(shape[-2:]) if len(shape) > 1 else math.prod(shape)
    size = Path(path).stat().st_size
    if pixels > MOST_PIXELS:
        raise BadInput(f"{path}: claims frames of {_by(shape[-2:])} pixels: no sensor has that many")
    claimed = math.prod(shape) * itemsize
    holds = _DENSEST * size
    if pixels * itemsize > holds + _SPARE_FRAME or claimed > holds + _SPARE_STACK:
        raise BadInput(
            f"{path}: claims {_by(shape)} values ({claimed / 1e9:.3g} GB) in {size} bytes: damaged"
        )


@contextlib.contextmanager
def any_size() -> Iterator[None]:
    """Without the library's own limit, which large sensors exceed: `check_claim` has ours."""
    limit = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = None
    try:
        yield
    finally:
        Image.MAX_IMAGE_PIXELS = limit


def check_pixels(path: str | Path, shape: tuple[int, ...]) -> None:
    """Raises BadInput for one picture with three or four values a pixel: no stack has frames that narrow."""
    if len(shape) == 3 and shape[2] in (3, 4) and min(shape[:2]) > _NARROW:
        raise BadInput(
            f"{path}: has shape {shape}: {shape[2]} values a pixel are the colours of a developed picture: "
            "give the raw mosaics"
        )


def whole_numbers(path: str | Path, values: np.ndarray) -> np.ndarray:
    """Values of any type as uint16. Raises BadInput for fractions and for what 16 bits do not hold."""
    if values.dtype == np.uint16:
        return values
    if values.dtype.kind == "b" or values.dtype.kind not in "iuf":
        raise BadInput(f"{path}: values are {values.dtype}: expected the sensor's own whole numbers")
    if values.dtype.kind == "f" and (count := int(np.isnan(values).sum())):
        said = "1 value is" if count == 1 else f"{count} values are"
        raise BadInput(f"{path}: {said} NaN: pixels were masked: give the raw frames of the camera")
    if values.dtype.kind == "f" and not (np.isfinite(values).all() and (values == np.rint(values)).all()):
        raise BadInput(
            f"{path}: floating-point values that are no whole numbers ({values.dtype}): calibrated, averaged "
            "or rescaled: give the raw frames of the camera"
        )
    if values.dtype == np.float16 and values.size and values.max() > _WHOLE_FLOAT16:
        raise BadInput(
            f"{path}: float16 values up to {values.max():g}: above {_WHOLE_FLOAT16} it holds every other "
            "whole number at best, so they were rounded: give the raw frames as integers"
        )
    if values.size and values.min() < 0:
        raise BadInput(
            f"{path}: negative values (down to {values.min():g}): black was subtracted, or unsigned numbers "
            "were stored as signed: give the raw frames of the camera"
        )
    if values.size and values.max() > 65535:
        raise BadInput(
            f"{path}: values up to {values.max():g}: sums of frames? single raw frames have 16 bits at most"
        )
    return values.astype(np.uint16)


def _by(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape))
