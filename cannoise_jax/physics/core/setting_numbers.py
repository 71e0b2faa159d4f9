"""What a recording can be taken at: the numbers of `Settings`, held to the limits of those in files."""

from __future__ import annotations

import reprlib
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from cannoise_jax.recordings.recording import COLDEST_C, HOTTEST_C, LEAST, LONGEST_S, MOST, SHORTEST_S


def check_numbers(settings: Any) -> None:
    """Raises ValueError where a number of `Settings` is none that a recording has, as in files."""
    _check(
        settings.iso,
        f"iso must be above 0, at most {MOST:g}",
        lambda v: (v >= LEAST) & (v <= MOST),
    )
    _check(
        settings.exposure_s,
        f"exposure_s must be 0 or {SHORTEST_S:g} to {LONGEST_S:g}",
        lambda v: (v == 0) | (v >= np.float32(SHORTEST_S)) & (v <= LONGEST_S),
    )
    _check(
        settings.temperature_c,
        f"temperature_c must be {COLDEST_C:g} to {HOTTEST_C:g}",
        lambda v: (v >= COLDEST_C) & (v <= HOTTEST_C),
    )
    # Frames are no leaf of the tree, so that JAX puts nothing of its own there.
    whole = isinstance(settings.frames, (int, np.integer)) and not isinstance(settings.frames, bool)
    if not whole or not 1 <= settings.frames < 2**31:
        raise ValueError(f"frames must be a whole number from 1, got {reprlib.repr(settings.frames)}")


def _check(value: Any, words: str, holds: Callable[[np.ndarray], Any]) -> None:
    """Raises ValueError for what is no number, or numbers of which not all hold. Traced ones pass."""
    if value is None or isinstance(value, jax.core.Tracer):
        return
    numbers = np.asarray(None if isinstance(value, (str, bytes, list, tuple)) else value)
    if numbers.dtype.kind not in "fiu":
        raise ValueError(f"{words}, got {reprlib.repr(value)}")
    good = np.isfinite(numbers) & holds(numbers)
    if not good.all():
        raise ValueError(f"{words}, got {numbers[~good].flat[0]:g}")
