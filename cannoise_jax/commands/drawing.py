"""How long it takes to draw a recording, told while it is drawn. One program draws all of its frames, so that
none can be counted: the time comes from two frames drawn before, or from the recording before."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from cannoise_jax.commands.entry import duration
from cannoise_jax.commands.pulse import current

_LONG = 4e7
"""Pixels of all frames from which on an estimate is worth two frames more: some five seconds of two cores."""
_TRIED = 2


class Drawing:
    """What is known of the speed after each recording."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._rate: float | None = None
        """Seconds per pixel of a frame."""

    @contextmanager
    def told(self, name: str, frames: int, pixels: int, draw: Callable[[int], Any]) -> Iterator[None]:
        """Around the work on one recording. pixels: of a frame. draw: draws so many frames of it."""
        work, began = frames * pixels, self._clock()

        def words() -> str:
            text = f"drawing {frames} frame{'s' * (frames > 1)} of {name}"
            if self._rate is None or work < _LONG:
                return text
            left = self._rate * work - (self._clock() - began)
            return f"{text}, about {duration(left)} left" if left >= 1 else f"{text}, nearly done"

        with current().doing(words):
            if self._rate is None and work >= _LONG and frames > 4 * _TRIED:
                draw(_TRIED)  # the first time it is compiled, too
                tried = self._clock()
                draw(_TRIED)
                self._rate = (self._clock() - tried) / (_TRIED * pixels)
                began = self._clock()
            yield
        if work >= _LONG:
            self._rate = (self._clock() - began) / work
