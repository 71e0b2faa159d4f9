"""Pixels that show nothing, told by number and kind: stuck at an end of the codes, or without light."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from cannoise_jax.physics.transfer.estimators.dead import dead_of
from cannoise_jax.physics.transfer.estimators.pick import brightest_flat
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.unlit import lines_of
from cannoise_jax.recordings.recording import DARK


def defects_line(statistics: Sequence[FrameStatistics]) -> str:
    """How many pixels are full in every dark, at the lowest code in every frame, or dead; empty where none
    are."""
    darks = [s for s in statistics if s.recording.kind in DARK and s.variance is not None]
    full = _always([_stuck(s, 1) for s in darks])
    flats = [s for s in statistics if s.recording.kind == "flat" and s.variance is not None]
    empty = _always([_stuck(s, -1) for s in (*darks, *flats)])
    flat = brightest_flat(statistics)
    dead = None if flat is None else dead_of(statistics, flat)
    if dead is not None and empty is not None:
        dead = dead & ~empty
    told = (
        (full, "are full in every dark (stuck)"),
        (empty, "are at the lowest code in every frame (masked, or broken)"),
        (dead, "do not answer light (dead)"),
    )
    said = [
        f"{int(m.sum())} ({100 * m.mean():.2g} %){_where(m)} {what}"
        for m, what in told
        if m is not None and m.any()
    ]
    return f"of the pixels {', '.join(said)}: noise and patterns are measured without them" if said else ""


def _stuck(s: FrameStatistics, side: int) -> Bool[np.ndarray, "H W"]:
    """Pixels that are stuck above (1) or below (-1) the level."""
    if s.stuck is None:
        return np.zeros(s.mean.shape, bool)
    return s.stuck & (side * (s.mean - float(np.median(s.mean))) > 0)


def _always(masks: Sequence[Bool[np.ndarray, "H W"]]) -> Bool[np.ndarray, "H W"] | None:
    return np.logical_and.reduce(masks) if masks else None


def _where(mask: Bool[np.ndarray, "H W"]) -> str:
    return lines_of("columns", mask, 0) or lines_of("rows", mask, 1)
