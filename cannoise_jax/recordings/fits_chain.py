"""Headers of FITS files that never end: their reader would take the rest of the file for one header."""

from __future__ import annotations

import gzip
import math
import zlib
from pathlib import Path
from typing import IO, cast

from cannoise_jax.recordings.recording import BadInput

_BLOCK, _CARD = 2880, 80
_MOST_BLOCKS, _MOST_UNITS = 1000, 1000
"""Of one header, three megabytes of cards; images and tables in one file."""
_PACKED = {b"BZh": "bzip2", b"PK\x03\x04": "zip", b"\xfd7zXZ": "xz", b"\x1f\x9d": "compress"}


def check_headers(path: str | Path) -> None:
    """Raises BadInput where a header goes on and on, or the file is packed otherwise than by gzip. Other
    faults pass: the reader says what is wrong."""
    with open(path, "rb") as plain:
        start = plain.read(6)
        for magic, name in _PACKED.items():
            if start.startswith(magic):
                raise BadInput(f"{path}: packed with {name}: unpack it, or pack it with gzip")
        plain.seek(0)
        try:
            packed = start.startswith(b"\x1f\x8b")
            _walk(path, cast(IO[bytes], gzip.GzipFile(fileobj=plain)) if packed else plain)
        except (OSError, EOFError, zlib.error):  # cut short or damaged
            return


def _walk(path: str | Path, file: IO[bytes]) -> None:
    for _ in range(_MOST_UNITS):
        cards = _header(path, file)
        if cards is None:
            return
        size = _data_bytes(cards)
        if size is None:
            return
        file.seek(-(-size // _BLOCK) * _BLOCK, 1)
    if file.read(1):
        raise BadInput(f"{path}: holds over {_MOST_UNITS} images and tables: give one image a file")


def _header(path: str | Path, file: IO[bytes]) -> dict[str, str] | None:
    """The values of the next header by keyword; None where the file ends first."""
    cards: dict[str, str] = {}
    for _ in range(_MOST_BLOCKS):
        block = file.read(_BLOCK)
        if len(block) < _BLOCK:
            return None
        for at in range(0, _BLOCK, _CARD):
            card = block[at : at + _CARD]
            if card[:8] == b"END     ":
                return cards
            cards.setdefault(card[:8].decode("latin-1").rstrip(), card[9:].decode("latin-1").split("/")[0])
    raise BadInput(f"{path}: not a readable FITS file: a header without an end: damaged, or padded")


def _data_bytes(cards: dict[str, str]) -> int | None:
    """What lies behind a header, in bytes; None where it does not say."""
    try:
        axes = [int(cards[f"NAXIS{n + 1}"]) for n in range(min(int(cards["NAXIS"]), 999))]
        more, groups = int(cards.get("PCOUNT", 0)), int(cards.get("GCOUNT", 1))
        size = abs(int(cards["BITPIX"])) // 8 * groups * (more + math.prod(axes)) if axes else 0
    except (KeyError, ValueError):
        return None
    return size if 0 <= size < 2**62 else None
