"""Writes a minimal DNG by hand: a TIFF with a mosaic, the tags that a DNG requires, and an Exif directory."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

BYTE, ASCII, SHORT, LONG, RATIONAL, UNDEFINED, SRATIONAL, DOUBLE = 1, 2, 3, 4, 5, 7, 10, 12
_FORMATS = {BYTE: "B", ASCII: "B", SHORT: "H", LONG: "I", UNDEFINED: "B", DOUBLE: "d"}
_COLOUR = {"R": 0, "G": 1, "B": 2, "C": 3, "M": 4, "Y": 5}


def _payload(kind, values):
    if kind in (RATIONAL, SRATIONAL):
        pair = "<Ii" if kind == RATIONAL else "<ii"
        return b"".join(struct.pack(pair, round(v * 1_000_000), 1_000_000) for v in values)
    if kind == ASCII:
        values = (*values.encode(), 0)
    return struct.pack(f"<{len(values)}{_FORMATS[kind]}", *values)


def _ifd(entries, at):
    """An image file directory at offset `at`, and the values that do not fit into it."""
    size = 2 + 12 * len(entries) + 4
    table, heap = struct.pack("<H", len(entries)), b""
    for tag, (kind, values) in sorted(entries.items()):
        payload = _payload(kind, values)
        count = len(payload) if kind == ASCII else len(values)
        table += struct.pack("<HHI", tag, kind, count)
        if len(payload) <= 4:
            table += payload.ljust(4, b"\0")
        else:
            table += struct.pack("<I", at + size + len(heap))
            heap += payload + b"\0" * (len(payload) % 2)
    return table + b"\0\0\0\0" + heap


def write_dng(
    path: Path,
    raw: np.ndarray,
    *,
    cfa: str = "RGGB",
    black=(64, 64, 64, 64),
    white: int = 1023,
    active: tuple[int, int, int, int] | None = None,
    iso: int | None = 400,
    exposure_s: float | None = 0.02,
    noise_profile=None,
    plane_colours: str = "RGB",
    nested: bool = False,
    samples: int = 1,
    extra: dict | None = None,
) -> Path:
    """raw: uint16 of the whole sensor. active: top, left, bottom, right of the visible area; `cfa` and
    `black` (mosaic order) start at its corner. nested: the mosaic in a sub-directory under a thumbnail.
    cfa: any square pattern of R, G, B, so also 36 letters; none for a monochrome sensor.
    samples: 3 makes a demosaiced (linear) DNG."""
    height, width = raw.shape[:2]
    side = round(len(cfa) ** 0.5)
    mosaic = {
        254: (LONG, [0]),
        256: (LONG, [width]),
        257: (LONG, [height]),
        258: (SHORT, [16] * samples),
        259: (SHORT, [1]),
        262: (SHORT, [32803 if samples == 1 and cfa else 34892]),
        277: (SHORT, [samples]),
        278: (LONG, [height]),
        279: (LONG, [raw.nbytes]),
        284: (SHORT, [1]),
        50717: (LONG, [white] * samples),
    }
    if samples == 1 and not cfa:
        mosaic[50714] = (RATIONAL, [black[0]])
    elif samples == 1:
        mosaic |= {
            33421: (SHORT, [side, side]),
            33422: (BYTE, [_COLOUR[c] for c in cfa]),
            50710: (BYTE, [_COLOUR[c] for c in plane_colours]),
            50711: (SHORT, [1]),
            50713: (SHORT, [2, 2]),
            50714: (RATIONAL, list(black)),
        }
    if active:
        mosaic[50829] = (LONG, list(active))
    top = {
        271: (ASCII, "Acme"),
        272: (ASCII, "Phone 3"),
        274: (SHORT, [1]),
        50706: (BYTE, [1, 4, 0, 0]),
        50707: (BYTE, [1, 1, 0, 0]),
        50708: (ASCII, "Acme Phone 3"),
        50721: (SRATIONAL, [1, 0, 0, 0, 1, 0, 0, 0, 1]),
        50728: (RATIONAL, [0.5, 1, 0.6]),
        50778: (SHORT, [21]),
    } | (extra or {})
    if noise_profile is not None:
        (mosaic if nested else top)[51041] = (DOUBLE, list(noise_profile))
    exif = {}
    if iso is not None:
        exif[34855] = (SHORT, [iso])
    if exposure_s is not None:
        exif[33434] = (RATIONAL, [exposure_s])
    thumbnail = np.zeros((8, 8, 3), np.uint8)
    if nested:
        top |= {
            254: (LONG, [1]),
            256: (LONG, [8]),
            257: (LONG, [8]),
            258: (SHORT, [8, 8, 8]),
            259: (SHORT, [1]),
            262: (SHORT, [2]),
            277: (SHORT, [3]),
            278: (LONG, [8]),
            279: (LONG, [thumbnail.nbytes]),
        }

    def directories(exif_at, sub_at, thumbnail_at, pixels_at):
        mosaic[273] = (LONG, [pixels_at])
        first = top | {34665: (LONG, [exif_at])}
        first |= {273: (LONG, [thumbnail_at]), 330: (LONG, [sub_at])} if nested else mosaic
        return [_ifd(first, 8), _ifd(exif, exif_at), _ifd(mosaic, sub_at) if nested else b""]

    # Lengths do not depend on where things lie, so the offsets follow from a first pass. Pixels come last.
    lengths = [8, *map(len, directories(0, 0, 0, 0)), thumbnail.nbytes]
    _, exif_at, sub_at, thumbnail_at, pixels_at = np.cumsum(lengths).tolist()
    parts = directories(exif_at, sub_at, thumbnail_at, pixels_at)
    pixels = np.ascontiguousarray(raw, "<u2").tobytes()
    path.write_bytes(b"II*\0" + struct.pack("<I", 8) + b"".join(parts) + thumbnail.tobytes() + pixels)
    return path
