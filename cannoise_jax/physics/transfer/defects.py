"""Pixels that show nothing, told by number and kind: stuck at an end of the codes, or without light; and
shadows of dust; spots of light that move."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool
from scipy import ndimage

from cannoise_jax.physics.transfer.bad_columns import told
from cannoise_jax.physics.transfer.estimators.dead import dead_of
from cannoise_jax.physics.transfer.estimators.pick import brightest_flat
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.response import response_of
from cannoise_jax.physics.transfer.unlit import lines_of
from cannoise_jax.physics.transfer.views import at_an_end
from cannoise_jax.recordings.packing import site
from cannoise_jax.recordings.recording import DARK

_TOLD = 3
"""Shadows that are named, the deepest first."""

_COLUMNS_TOLD = 6
"""Bad columns that are named, from the left."""


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


def columns_line(statistics: Sequence[FrameStatistics]) -> str:
    """Which columns are bad, in the darks or else under light, and how; empty where none are."""
    flat = brightest_flat(statistics)
    flats = [s for s in statistics if s.recording.kind == "flat" and s.bad is not None]
    darks = [s for s in statistics if s.recording.kind in DARK and s.bad is not None]
    said: dict[int, str] = {}
    for s in (
        *sorted(darks, key=lambda s: s.recording.exposure_s or 0.0),
        *sorted(flats, key=lambda s: s is not flat),
    ):
        assert s.bad is not None
        dark = s.recording.kind in DARK
        for found in told(s.mean, s.bad, float(np.mean(s.recording.black_level))):
            how = f"{found.apart:+.3g} DN in the darks" if dark else f"{100 * found.ratio:.2g} % of the light"
            part = "" if found.rows == (1, s.mean.shape[0]) else f", rows {found.rows[0]} to {found.rows[1]}"
            said.setdefault(found.column, f"{found.column} ({how}{part})")
    if not said:
        return ""
    first = ", ".join(said[c] for c in sorted(said)[:_COLUMNS_TOLD])
    more = f" and {len(said) - _COLUMNS_TOLD} more" if len(said) > _COLUMNS_TOLD else ""
    return (
        f"bad column{'s' if len(said) > 1 else ''} {first}{more}: black level, noise and patterns are "
        "measured without what lies so far from its neighbours"
    )


def shadows_line(statistics: Sequence[FrameStatistics]) -> str:
    """Where the deepest shadows of the brightest flat are, and how deep; empty where there are none."""
    flat = brightest_flat(statistics)
    if flat is None:
        return ""
    mask, depth = np.zeros(flat.mean.shape, bool), np.zeros(flat.mean.shape)
    for c in range(4):
        signal = site(flat.mean, c) - flat.recording.black_level[c]
        found = response_of(signal / flat.level[c], ~site(flat.clipped, c))
        site(mask, c)[...] = found.shadow
        site(depth, c)[...] = ndimage.median_filter(-found.pattern / np.maximum(found.light, 1e-3), 3)
    places, count = ndimage.label(ndimage.binary_dilation(mask, np.ones((3, 3), bool)))
    if not count:
        return ""
    number = np.arange(1, count + 1)
    depths = ndimage.maximum(np.where(mask, depth, 0.0), places, number)
    where = ndimage.maximum_position(np.where(mask, depth, 0.0), places, number)
    order = np.argsort(-depths)[:_TOLD]
    said = ", ".join(
        f"{100 * depths[n]:.2g} % deep at row {where[n][0] + 1}, column {where[n][1] + 1}" for n in order
    )
    more = f" and {count - _TOLD} more" if count > _TOLD else ""
    return (
        f"{flat.recording.path or flat.recording.camera}: shadows as of dust: {said}{more}: their pixels "
        "take no part in the sensitivities: clean what lies over the sensor, and record flats anew"
    )


def spots_line(statistics: Sequence[FrameStatistics]) -> str:
    """Over which flats spots of light move, and over how much of them; empty where none do."""
    some = [s for s in statistics if s.spots is not None]
    if not some:
        return ""
    first = some[0].recording.path or some[0].recording.camera
    others = f" and {len(some) - 1} more" if len(some) > 1 else ""
    share = max(float(s.spots.mean()) for s in some if s.spots is not None)
    return (
        f"{first}{others}: spots of light move over the flats, as stars do over those of twilight: they are "
        f"taken out, and {100 * share:.2g} % of the pixels take no part in what single pixels tell"
    )


def _stuck(s: FrameStatistics, side: int) -> Bool[np.ndarray, "H W"]:
    """Pixels that are stuck above (1) or below (-1) the level."""
    return at_an_end(s) & (side * (s.mean - float(np.median(s.mean))) > 0)


def _always(masks: Sequence[Bool[np.ndarray, "H W"]]) -> Bool[np.ndarray, "H W"] | None:
    return np.logical_and.reduce(masks) if masks else None


def _where(mask: Bool[np.ndarray, "H W"]) -> str:
    return lines_of("columns", mask, 0) or lines_of("rows", mask, 1)
