"""Memory that is given back once it is free, for commands that work tile by tile."""

from __future__ import annotations

import ctypes
import sys

_MMAP_THRESHOLD = -3  # M_MMAP_THRESHOLD of glibc's malloc.h
_LARGE = 4 << 20


def give_back_large() -> None:
    """Blocks of 4 MiB and more go back to the system when they are freed.

    By itself glibc raises that limit to 32 MiB as such blocks are freed, and keeps smaller ones in heaps:
    arrays of a tile, of some 25 MiB, then leave half a gigabyte of holes there. Without glibc nothing is
    done.
    """
    if sys.platform.startswith("linux"):
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
        if mallopt is not None:
            mallopt(ctypes.c_int(_MMAP_THRESHOLD), ctypes.c_int(_LARGE))
