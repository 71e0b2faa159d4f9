"""Whether the noise of a dark is one all over the frame: amplifiers of their own have another each, and what
their pixels do would be taken for noise of single pixels."""

from __future__ import annotations

import numpy as np

from cannoise_jax.physics.transfer.fit import median_quotient
from cannoise_jax.physics.transfer.frames import FrameStatistics

_GRID = 4
"""Regions along either side."""
_FEWEST = 64
"""Pixels of a region whose median variance means anything."""
_UNEVEN = 1.5
"""Ratio of variances from which regions are unlike: of seven real cameras they differ by 1.15 at most, the
two amplifiers of one frame by twice to four times."""
_SIGMAS = 6.0
"""Standard errors by which they have to differ beyond that."""
_OF_MEDIAN = 0.6
"""What the median of a mean square is worth of its mean."""


def uneven_noise(dark: FrameStatistics) -> str:
    """Between which values the temporal noise of the parts of a repeated dark lies; empty where it is one.
    Parts that are dead do not count."""
    if dark.variance is None:
        return ""
    variance = dark.variance if dark.dead is None else np.where(dark.dead, np.nan, dark.variance)
    rows, columns = (np.array_split(np.arange(n), _GRID) for n in variance.shape)
    parts = [variance[np.ix_(r, c)] for r in rows for c in columns]
    parts = [alive for part in parts if (alive := part[np.isfinite(part)]).size >= _FEWEST]
    if len(parts) < 2:
        return ""
    medians = np.array([np.median(part) for part in parts])
    room = _SIGMAS * 2 / np.sqrt(_OF_MEDIAN * min(part.size for part in parts) * dark.dof)
    if medians.max() <= _UNEVEN * np.exp(room) * max(medians.min(), dark.code_step**2 / 12):
        return ""
    low, high = np.sqrt(np.array([medians.min(), medians.max()]) / median_quotient(dark.dof))
    return (
        f"the noise of the dark differs between parts of the frame ({low:.3g} to {high:.3g} DN), as of "
        "amplifiers of their own: calibrate each part by itself (where it is a glow: record shorter darks)"
    )
