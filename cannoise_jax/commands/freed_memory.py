"""What becomes of memory once it is free: given back by commands that work tile by tile, kept by those that
take the same over and over."""

from __future__ import annotations

import ctypes
import sys

# M_TRIM_THRESHOLD, M_MMAP_THRESHOLD and M_ARENA_MAX of glibc's malloc.h
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8
_LARGE = 4 << 20
_KEPT, _UNBOUNDED = 1 << 30, 2**31 - 1


def give_back_large() -> None:
    """Blocks of 4 MiB and more go back to the system when they are freed.

    By itself glibc raises that limit to 32 MiB as such blocks are freed, and keeps smaller ones in heaps:
    arrays of a tile, of some 25 MiB, then leave half a gigabyte of holes there. Without glibc nothing is
    done.
    """
    _set((_MMAP_THRESHOLD, _LARGE))


def keep_freed() -> None:
    """What is freed stays with the process, in one heap for all threads.

    Every training step takes some hundred megabytes and frees them. By itself glibc gives them back, and the
    system hands them out again page by page and cleared, a fifth of the step's time on a CPU. The process
    grows to the most that it ever needs at once, and by what lies scattered. Without glibc nothing is done.
    """
    _set((_ARENA_MAX, 1), (_MMAP_THRESHOLD, _KEPT), (_TRIM_THRESHOLD, _UNBOUNDED))


def _set(*options: tuple[int, int]) -> None:
    if sys.platform.startswith("linux"):
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
        if mallopt is not None:
            for name, value in options:
                mallopt(ctypes.c_int(name), ctypes.c_int(value))
