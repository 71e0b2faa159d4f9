"""Chains of image directories in TIFF files that lead back to themselves: readers follow them for ever."""

from __future__ import annotations

import os
import struct
from pathlib import Path

from cannoise_jax.recordings.recording import BadInput

_MOST_PAGES = 1_000_000


def check_chain(path: str | Path) -> None:
    """Raises BadInput where a directory of a TIFF is reached twice. Other files, and chains that end outside
    of the file, pass: their reader says what is wrong."""
    with open(path, "rb") as file:
        start = file.read(16)
        order = {b"II": "<", b"MM": ">"}.get(start[:2])
        if order is None or len(start) < 16:
            return
        (version,) = struct.unpack(order + "H", start[2:4])
        if version == 43:  # BigTIFF
            count, entry, offset, at = "Q", 20, "Q", struct.unpack(order + "Q", start[8:16])[0]
        else:
            count, entry, offset, at = "H", 12, "I", struct.unpack(order + "I", start[4:8])[0]
        size, seen = os.fstat(file.fileno()).st_size, set[int]()
        while 0 < at < size:
            if at in seen or len(seen) > _MOST_PAGES:
                raise BadInput(f"{path}: not a readable TIFF file: page {len(seen)} leads back to another")
            seen.add(at)
            file.seek(at)
            head = file.read(struct.calcsize(order + count))
            if len(head) < struct.calcsize(order + count):
                return
            (tags,) = struct.unpack(order + count, head)
            file.seek(min(at + len(head) + tags * entry, size))
            following = file.read(struct.calcsize(order + offset))
            if len(following) < struct.calcsize(order + offset):
                return
            (at,) = struct.unpack(order + offset, following)
