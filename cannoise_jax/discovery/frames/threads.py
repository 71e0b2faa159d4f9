"""Independent pieces of work on two threads: NumPy and JAX let others run while they compute."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

WORKERS = 2
"""Pieces that are worked on at once: each holds arrays as large as the recordings."""
Piece = TypeVar("Piece")
Result = TypeVar("Result")


def each(function: Callable[[Piece], Result], pieces: Iterable[Piece]) -> list[Result]:
    """What the function makes of every piece, in order."""
    with ThreadPoolExecutor(WORKERS) as pool:
        return list(pool.map(function, pieces))
