"""Single mosaics in picture formats: PGM (one or more, 8 or 16 bits, binary or text), grey PNG and BMP."""

from __future__ import annotations

import mmap
import re
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from cannoise_jax.recordings.metadata import check_overrides, make_recording, reading
from cannoise_jax.recordings.opened import Developed, Opened, any_size, check_claim, whole_numbers
from cannoise_jax.recordings.recording import BadInput, Recording
from cannoise_jax.recordings.stacks import side_car

SUFFIXES = (".pgm", ".png", ".bmp")
_HEADER = re.compile(rb"(P[25])(?:\s|#[^\n]*\n)+(\d+)(?:\s|#[^\n]*\n)+(\d+)(?:\s|#[^\n]*\n)+(\d+)\s")


def read_picture(path: str | Path, **overrides: Any) -> Recording:
    """A recording from a PGM, PNG or BMP file with a side-car like that of other stacks. Raises BadInput."""
    check_overrides(overrides)
    opened = open_picture(path)
    return make_recording(path, opened.frames, opened.known, overrides)


def open_picture(path: str | Path) -> Opened:
    """The mosaics of a PGM, PNG or BMP file; a PGM states its white level. Raises BadInput."""
    if not Path(path).is_file():
        raise BadInput(f"{path}: no such file")
    if Path(path).suffix.lower() != ".pgm":
        values, deep = _pillow(path, Path(path).suffix[1:].upper())
        return Opened(values[None], side_car(path), {} if deep else {"bits": 8})
    with (
        reading(path, "not a readable PGM file"),
        open(path, "rb") as file,
        mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data,
    ):
        frames, white = _pgm(path, data)
    # 255 and 65535 are what the container holds, not what the sensor reaches.
    known = {} if white in (255, 65535) else {"white_level": float(white)}
    return Opened(frames, known | side_car(path), {"bits": 8} if white < 256 else {})


def _pgm(path: str | Path, data: mmap.mmap) -> tuple[np.ndarray, int]:
    """All images of a file, netpbm's own manual: 16 bits are big-endian."""
    images, white, at = [], 0, 0
    while at < len(data) and (at == 0 or data[at : at + _BETWEEN].strip()):
        found = _HEADER.match(data, at)
        if not found:
            what = "colours (PPM)" if data[at : at + 2] in (b"P3", b"P6") else "not a readable PGM file"
            raise BadInput(f"{path}: {what}: expected grey mosaics, P5 or P2")
        width, height, white = (int(found[n]) for n in (2, 3, 4))
        check_claim(path, (height, width), 1 if white < 256 else 2)
        if not 0 < white < 65536 or width * height == 0:
            raise BadInput(f"{path}: not a readable PGM file: {width} x {height}, highest value {white}")
        if found[1] == b"P2":
            values = np.array(data[found.end() :].split()[: width * height], np.int64)
            at = len(data)
        else:
            kind = np.dtype(np.uint8 if white < 256 else ">u2")
            values = np.frombuffer(data[found.end() : found.end() + width * height * kind.itemsize], kind)
            at = found.end() + width * height * kind.itemsize
        if values.size != width * height or values.max() > white or values.min() < 0:
            raise BadInput(
                f"{path}: not a readable PGM file: truncated, or values above its highest, {white}"
            )
        images.append(values.reshape(height, width).astype(np.uint16))
    if len({image.shape for image in images}) != 1:
        raise BadInput(f"{path}: not a readable PGM file: {len(images)} images of several sizes")
    return np.stack(images), white


_BETWEEN = 64
"""Bytes behind an image that are looked at for another one."""


def _pillow(path: str | Path, kind: str) -> tuple[np.ndarray, bool]:
    """The mosaic, and whether the file has more than 8 bits."""
    with (
        reading(path, f"not a readable {kind} file"),
        any_size(),
        Image.open(path, formats=(kind,)) as image,
    ):
        check_claim(path, (image.height, image.width), 1)
        if image.mode not in ("L", "I", "I;16", "I;16B"):
            raise Developed(
                f"{path}: colours or a palette ({image.mode}): expected a grey mosaic of 8 or 16 bits"
            )
        return whole_numbers(path, np.array(image)), image.mode != "L"
