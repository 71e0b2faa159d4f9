"""Levels of the four sites of a mosaic under a flat, and what they say about its colour order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cannoise_jax.recordings.packing import SITES, green_sites
from cannoise_jax.recordings.recording import CFA_PATTERNS, PerChannel, per_channel

COLOURED = 0.01
"""Sites of a mosaic under a flat differ by more than this share of their mean, of one colour by less."""
_GREENS_APART, _GREENS_ALIKE = 0.2, 0.05
"""Greens of one sensor differ by some per cent at most. Those of a wrong order are red and blue."""


def site_levels(frame: np.ndarray) -> PerChannel:
    """Levels of the four sites at the same places of the frame: light that changes evenly along rows or
    columns does not part them, colours do."""
    if min(frame.shape) < 3:
        return per_channel(np.array([np.median(frame[s]) if frame[s].size else frame[0, 0] for s in SITES]))
    height, width = ((n - 1) // 2 * 2 for n in frame.shape)
    # Places are those of the last site but the outermost: the others are a mean of what lies on both sides.
    cells = frame[: height + 1, : width + 1].astype(np.float32)
    along = ((cells[:-1:2] + cells[2::2]) / 2, cells[1::2])
    parts = np.stack([p for row in along for p in ((row[:, :-1:2] + row[:, 2::2]) / 2, row[:, 1::2])])
    middle = parts.mean(axis=0)
    return per_channel(np.median(middle) + np.median(parts - middle, axis=(1, 2)))


def light_of(lit: Sequence[PerChannel], dark: Sequence[PerChannel]) -> Any:
    """Light on the four sites, DN above the darks where there are any."""
    return np.median(lit, axis=0) - (np.median(dark, axis=0) if dark else 0.0)


def greens_apart(light: Any, cfa: str) -> str | None:
    """That the greens of a stated order are none: they differ grossly, and the other two sites do not."""
    if cfa not in CFA_PATTERNS or (greens := green_sites(cfa)) is None:
        return None
    others = [s for s in range(4) if s not in greens]
    own, other = (float(np.ptp(light[list(p)]) / np.mean(light[list(p)])) for p in (greens, others))
    if not (own > _GREENS_APART and 0 <= other < _GREENS_ALIKE):
        return None
    return (
        f"the two greens of {cfa} differ by {100 * own:.0f} % in the flats, and its red and blue are alike: "
        "check the colour order, --cfa states another"
    )
