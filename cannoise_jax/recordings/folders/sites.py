"""Levels of the four sites of a mosaic under a flat, and what they say about its colour order."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from cannoise_jax.recordings.packing import SITES, green_sites
from cannoise_jax.recordings.recording import CFA_PATTERNS, PerChannel, per_channel

_COLOURED, _SURE = 0.01, 5.0
"""Sites of a mosaic under a flat differ by more than this share of their mean, of one colour by less; and
standard errors by which they have to."""
_ENDS = 0.05
"""Share of the cells at either end that no level is made of: hot pixels and dust are there."""
_GREENS_ALIKE = 0.05
"""Greens of one sensor differ by some per cent at most. Those of a wrong order are red and blue."""
_DIAGONAL = 0.25
"""Of what the sites of a mosaic differ by, that which its greens do at most: rows or columns that are read
out with a gain of their own part the sites on both diagonals."""


class Sites(NamedTuple):
    """Levels of the four sites of a mosaic, DN, and the standard error of what they differ by."""

    levels: PerChannel
    error: float


def site_levels(frame: np.ndarray) -> Sites:
    """Levels of the four sites at the same places of the frame: light that changes evenly along rows or
    columns does not part them, colours do. Means, for a median of whole codes is one."""
    if min(frame.shape) < 3:
        sites = [np.median(frame[s]) if frame[s].size else frame[0, 0] for s in SITES]
        return Sites(per_channel(np.array(sites)), 0.0)
    height, width = ((n - 1) // 2 * 2 for n in frame.shape)
    # Places are those of the last site but the outermost: the others are a mean of what lies on both sides.
    cells = frame[: height + 1, : width + 1].astype(np.float32)
    along = ((cells[:-1:2] + cells[2::2]) / 2, cells[1::2])
    parts = np.stack([p for row in along for p in ((row[:, :-1:2] + row[:, 2::2]) / 2, row[:, 1::2])])
    middle = parts.mean(axis=0)
    apart = (parts - middle).reshape(4, -1)
    inner = stats.trim_mean(apart, _ENDS, axis=1)
    error = float(apart.std(axis=1).max() / np.sqrt(apart.shape[1]))
    return Sites(per_channel(np.median(middle) + inner), error)


def light_of(lit: Sequence[Sites], dark: Sequence[Sites]) -> Sites:
    """Light on the four sites, DN above the darks where there are any."""
    levels = np.median([s.levels for s in lit], axis=0)
    if dark:
        levels = levels - np.median([s.levels for s in dark], axis=0)
    # Of one frame: the fixed pattern, which it holds, is that of all.
    return Sites(per_channel(levels), float(np.median([s.error for s in lit])))


def shows_colours(light: Sites) -> bool:
    """Whether the four sites are not equally bright, by more than sensitivities and noise of one colour."""
    apart = float(np.ptp(light.levels))
    return apart > max(_COLOURED * abs(float(np.mean(light.levels))), _SURE * light.error)


class Apart(NamedTuple):
    """Lines of a sensor, "rows" or "columns", whose odd ones and even ones differ, by this share of their
    mean."""

    lines: str
    share: float


def lines_apart(light: PerChannel) -> Apart | None:
    """That the four sites differ as every other row or column does, which no mosaic has, for its greens lie
    on a diagonal; None where they differ in another way."""
    apart = float(np.ptp(light))
    for lines, pairs in (("columns", ((0, 2), (1, 3))), ("rows", ((0, 1), (2, 3)))):
        if apart > 0 and max(abs(light[a] - light[b]) for a, b in pairs) <= _DIAGONAL * apart:
            return Apart(lines, apart / max(float(np.mean(light)), 1e-9))
    return None


def two_gains(light: PerChannel, cfa: str) -> str | None:
    """That odd and even lines of a sensor without colours answer light by gains of their own; None where they
    do not, or by some per cent."""
    found = lines_apart(light) if cfa == "MONO" else None
    if found is None or found.share <= _GREENS_ALIKE:
        return None
    return (
        f"odd and even {found.lines} of the flats differ by {100 * found.share:.0f} %, as where two "
        "amplifiers read them out: what is measured of all pixels is a mean of both"
    )


def other_colours(light: PerChannel, cfa: str) -> str | None:
    """That flats contradict the stated colour order; None where nothing speaks against it."""
    return _colours_of_mono(light) if cfa == "MONO" else _greens_apart(light, cfa)


def _colours_of_mono(light: PerChannel) -> str | None:
    """That the sites of what is said to be without colours are those of a mosaic: two across are alike, and
    others are not."""
    apart = float(np.ptp(light))
    greens = min(abs(light[0] - light[3]), abs(light[1] - light[2]))
    if apart <= _GREENS_ALIKE * max(light) or greens > _DIAGONAL * apart:
        return None
    sites = ", ".join(f"{v:.4g}" for v in light)
    return (
        f"MONO is stated, and the flats show a mosaic (its four sites: {sites} DN): check the colour order, "
        "--cfa states another"
    )


def _greens_apart(light: PerChannel, cfa: str) -> str | None:
    """That the greens of a stated order are none: they differ by more than greens do, and the other two sites
    by far less."""
    if cfa not in CFA_PATTERNS or (greens := green_sites(cfa)) is None:
        return None
    others = [s for s in range(4) if s not in greens]
    own, other = (2 * abs(light[a] - light[b]) / max(light[a] + light[b], 1e-9) for a, b in (greens, others))
    if own <= _GREENS_ALIKE or other > _DIAGONAL * own:
        return None
    return (
        f"the two greens of {cfa} differ by {100 * own:.0f} % in the flats, and its red and blue are alike: "
        "check the colour order, --cfa states another"
    )
