"""What must hold of FITS files before their reader sees them: it follows headers without an end, and images
of less than no pixels, for ever; and of sizes that cannot be meant it speaks in its own words."""

from __future__ import annotations

import gzip
import math
import re
import zlib
from pathlib import Path
from typing import IO, cast

from cannoise_jax.recordings.recording import BadInput

_BLOCK, _CARD = 2880, 80
_MOST_BLOCKS, MOST_UNITS = 1000, 1000
"""Of one header, three megabytes of cards; images and tables in one file."""
_PACKED = {b"BZh": "bzip2", b"PK\x03\x04": "zip", b"\xfd7zXZ": "xz", b"\x1f\x9d": "compress"}
_BITS = (8, 16, 32, 64, -32, -64)
_MOST_BYTES = 1 << 42
"""Of one image: file systems refuse to seek much further."""
_FAILURE = "not a readable FITS file"


def check_headers(path: str | Path) -> None:
    """Raises BadInput where a file is no FITS, is packed otherwise than by gzip, has a header that goes on
    and on or states an impossible size, or ends before its images do."""
    with open(path, "rb") as plain:
        start = plain.read(6)
        for magic, name in _PACKED.items():
            if start.startswith(magic):
                raise BadInput(f"{path}: packed with {name}: unpack it, or pack it with gzip")
        plain.seek(0)
        if not start.startswith(b"\x1f\x8b"):
            _walk(path, plain)
            return
        try:
            _walk(path, cast(IO[bytes], gzip.GzipFile(fileobj=plain)))
        except EOFError as error:
            raise BadInput(f"{path}: {_FAILURE}: its gzip stream is cut short: copy it again") from error
        except (OSError, zlib.error) as error:
            raise BadInput(f"{path}: {_FAILURE}: its gzip stream is damaged: copy it again") from error


def _walk(path: str | Path, file: IO[bytes]) -> None:
    for number in range(MOST_UNITS):
        cards = _header(path, file, number)
        if cards is None:
            return
        if number == 0 and cards["SIMPLE"] != "T":  # of such files, packed ones are followed for ever
            raise BadInput(
                f"{path}: {_FAILURE}: SIMPLE is {cards['SIMPLE'][:20]!r}, not T: it says itself that it "
                "follows no standard"
            )
        _check_lossless(path, cards)
        size, begins = _data_bytes(path, cards), file.tell()
        if not size:
            continue
        # The last byte is read: plain files may be sought beyond their end. Some lack the padding behind it.
        file.seek(begins + size - 1)
        if not file.read(1):
            raise BadInput(
                f"{path}: {_FAILURE}: it ends before the {size} bytes that its header states: cut short: "
                "copy it again"
            )
        file.seek(begins + -(-size // _BLOCK) * _BLOCK)
    if file.read(1):
        raise BadInput(f"{path}: holds over {MOST_UNITS} images and tables: give one image a file")


def _check_lossless(path: str | Path, cards: dict[str, str]) -> None:
    """Raises BadInput for an image that was compressed with loss, by HCOMPRESS with a scale above one
    (FITS standard 4.0, Sec. 10.4.4): its noise is no longer the sensor's."""
    if "HCOMPRESS" not in cards.get("ZCMPTYPE", ""):
        return
    for name, value in cards.items():
        scale = cards.get(f"ZVAL{name[5:]}", "") if name.startswith("ZNAME") and "SCALE" in value else ""
        if re.fullmatch(r"[+-]?[0-9.]{1,18}(E[+-]?[0-9]{1,2})?", scale) and float(scale) > 1:
            raise BadInput(
                f"{path}: compressed with loss (HCOMPRESS, SCALE {float(scale):g}), which takes noise away: "
                "give the frames as the camera wrote them"
            )


def _header(path: str | Path, file: IO[bytes], number: int) -> dict[str, str] | None:
    """The values of the next header by keyword; None where what is left of the file is no header."""
    cards: dict[str, str] = {}
    begun = True
    for n in range(_MOST_BLOCKS):
        block = file.read(_BLOCK)
        if n == 0:
            begun = block.startswith(b"XTENSION" if number else b"SIMPLE  =")
        if not begun and not number:
            begins = (
                f"it begins with {block[:9].decode('latin-1')!r}, not with SIMPLE" if block else "it is empty"
            )
            raise BadInput(f"{path}: {_FAILURE}: {begins}")
        for at in range(0, len(block), _CARD):
            card = block[at : at + _CARD]
            if card[:8] == b"END     ":
                return cards
            if card[8:9] == b"=":
                name = card[:8].decode("latin-1").rstrip()
                cards.setdefault(name, card[9:].decode("latin-1").split("/")[0].strip())
        if len(block) < _BLOCK:
            if not begun:
                return None
            raise BadInput(f"{path}: {_FAILURE}: it ends within a header: cut short: copy it again")
    raise BadInput(f"{path}: {_FAILURE}: a header without an end: damaged, or padded")


def _data_bytes(path: str | Path, cards: dict[str, str]) -> int:
    """What lies behind a header. Raises BadInput where it cannot be meant."""
    bits = _number(path, cards, "BITPIX", -64)
    if bits not in _BITS:
        raise BadInput(f"{path}: {_FAILURE}: BITPIX is {bits}: its header is damaged")
    axes = [
        _number(path, cards, f"NAXIS{n + 1}", 0) for n in range(min(_number(path, cards, "NAXIS", 0), 999))
    ]
    if axes and axes[0] == 0 and cards.get("GROUPS") == "T":  # the first axis of random groups is none
        axes = axes[1:]
    size = math.prod(axes) if axes else 0
    if size:
        more, groups = _number(path, cards, "PCOUNT", 0, 0), _number(path, cards, "GCOUNT", 1, 1)
        size = abs(bits) // 8 * groups * (more + size)
    if size > _MOST_BYTES:
        raise BadInput(f"{path}: {_FAILURE}: its header claims {size:.3g} bytes: damaged")
    return size


def _number(
    path: str | Path, cards: dict[str, str], name: str, least: int, otherwise: int | None = None
) -> int:
    if name not in cards and otherwise is not None:
        return otherwise
    text = " ".join(cards.get(name, "").split())
    if re.fullmatch(r"[+-]?[0-9]{1,18}", text) and int(text) >= least:
        return int(text)
    said = (
        f"no {name}" if name not in cards else f"{name} is {text[:20]!r}" if text else f"{name} says nothing"
    )
    raise BadInput(f"{path}: {_FAILURE}: {said}: its header is damaged")
