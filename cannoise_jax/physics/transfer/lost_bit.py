"""Whether a bit of the codes never changes while the next higher ones do: half of all codes are then missing.

Every other run of as many codes as the bit counts is then empty, however well those between are populated;
none of a converter with steps of unlike width looks like that, nor codes of a table or a digital gain.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.recordings.codes import code_histogram

_FRAMES = 2
"""Of every recording, that are looked at: hundreds of values a code."""
_RUNS, _POPULATED = 4, 50
"""Runs of codes that a lost bit leaves between empty ones, in a row, and values in each."""


def lost_bit(statistics: Sequence[FrameStatistics]) -> str:
    """Which bit of the stored codes never changes; empty where each does, as far as the values reach."""
    if not statistics:
        return ""
    histogram = np.sum([code_histogram(s.recording.frames[:_FRAMES]) for s in statistics], axis=0)
    step = min((s.code_step for s in statistics if s.code_step > 0), default=0.0)
    if step < 1:
        return ""
    for bit in range(int(np.ceil(np.log2(step + 0.5))), 15):
        state = _never_changes(histogram, 1 << bit)
        if state is not None:
            return (
                f"bit {bit} of the codes ({1 << bit} DN) is {state} in all frames, so that half of the codes "
                "never occur: a defect of the converter or of the transfer: levels, noise and fixed patterns "
                "are wrong with it"
            )
    return ""


def _never_changes(histogram: Int[np.ndarray, "65536"], size: int) -> str | None:
    runs = histogram.reshape(-1, 2, size).sum(-1)
    for own, state in ((0, "0"), (1, "1")):
        if runs[:, 1 - own].any():
            continue
        full = np.concatenate([[0], (runs[:, own] >= _POPULATED).astype(int), [0]])
        edges = np.flatnonzero(np.diff(full))
        if np.max(edges[1::2] - edges[::2], initial=0) >= _RUNS:
            return state
    return None
