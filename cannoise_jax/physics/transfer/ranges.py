"""Flats in a coarser range of the converter than the darks.

Some cameras convert twice, at a high gain and at a low one, and store what was bright at the low gain times
the ratio of both: there codes lie that far apart, and noise is larger. No straight line of photon transfer
goes through both ranges.
"""

from __future__ import annotations

from collections.abc import Sequence

from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.recordings.recording import DARK


def finest(lit: Sequence[FrameStatistics], step: float) -> list[FrameStatistics]:
    """What is lit without that whose codes lie further apart than `step`, DN; all where nothing else is left.
    Of some no spacing is known."""
    fine = [s for s in lit if s.code_step <= step]
    return fine or list(lit)


def coarser_range(statistics: Sequence[FrameStatistics], c: int) -> str:
    """From which level on the flats of one channel are in a coarser range than the darks; empty where all are
    in one."""
    dark = [s for s in statistics if s.recording.kind in DARK and s.code_step > 0]
    flats = [s for s in statistics if s.recording.kind == "flat"]
    step = min((s.code_step for s in dark), default=0.0)
    coarse = [s for s in flats if s.code_step > step > 0]
    if not coarse or len(coarse) == len(flats):
        return ""
    last = max(float(s.frame_means[:, c].mean()) for s in flats if s not in coarse)
    first = min(float(s.frame_means[:, c].mean()) for s in coarse)
    apart = min(s.code_step for s in coarse)
    return (
        f"of flats up to {last:.0f} DN: from {first:.0f} DN on codes lie {apart:g} apart, not {step:g}: "
        "a second gain of the converter, whose noise is another, and no part of line or read noise"
    )
