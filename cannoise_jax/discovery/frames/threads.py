"""Independent pieces of work on two threads: NumPy and JAX let others run while they compute."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from typing import TypeVar

WORKERS = 2
"""Pieces that are worked on at once: each holds arrays as large as the recordings."""
Piece = TypeVar("Piece")
Result = TypeVar("Result")


def each(
    function: Callable[[Piece], Result],
    pieces: Iterable[Piece],
    tell: Callable[[str], None] = lambda text: None,
    doing: str = "",
) -> list[Result]:
    """What the function makes of every piece, in order. tell: called with how many are done of what is being
    done, of all but the last."""
    asked, done = list(pieces), count(1)

    def one(piece: Piece) -> Result:
        made = function(piece)
        if (number := next(done)) < len(asked):
            tell(f"{doing}, {number} of {len(asked)}")
        return made

    with ThreadPoolExecutor(WORKERS) as pool:
        return list(pool.map(one, asked))
