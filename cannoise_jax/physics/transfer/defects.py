"""Pixels that show nothing, told by number and kind: stuck at an end of the codes, or without light; and
shadows of dust; spots of light that move."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool
from scipy import ndimage

from cannoise_jax.physics.robust import local_median, median
from cannoise_jax.physics.transfer.bad_lines import told
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

WITHOUT = "black level, noise and patterns are measured without what lies so far from its neighbours"
"""Of bad lines: what calibrating makes of them."""
_LINES_TOLD = 6
"""Bad columns that are named, from the left, and rows, from the top."""


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


def bad_line(statistics: Sequence[FrameStatistics]) -> str:
    """Which columns and rows are bad, in the darks or else under light, and how; empty where none are."""
    return "; ".join(text for axis in (0, 1) if (text := _bad_along(statistics, axis)))


def _bad_along(statistics: Sequence[FrameStatistics], axis: int) -> str:
    """Names of the bad columns (axis 0) or rows (1)."""
    flat = brightest_flat(statistics)
    found = [s for s in statistics if s.bad is not None]
    darks = sorted(
        (s for s in found if s.recording.kind in DARK), key=lambda s: s.recording.exposure_s or 0.0
    )
    flats = sorted((s for s in found if s.recording.kind == "flat"), key=lambda s: s is not flat)
    said: dict[int, str] = {}
    for s in (*darks, *flats):
        assert s.bad is not None
        mean, bad = (s.mean, s.bad.columns) if axis == 0 else (s.mean.T, s.bad.rows.T)
        dark = s.recording.kind in DARK
        for line in told(mean, bad, float(np.mean(s.recording.black_level))):
            how = f"{line.apart:+.3g} DN in the darks" if dark else f"{100 * line.ratio:.2g} % of the light"
            first, last = line.part
            part = "" if line.part == (1, len(mean)) else f", {('rows', 'columns')[axis]} {first} to {last}"
            said.setdefault(line.line, f"{line.line} ({how}{part})")
    if not said:
        return ""
    first_ones = ", ".join(said[n] for n in sorted(said)[:_LINES_TOLD])
    more = f" and {len(said) - _LINES_TOLD} more" if len(said) > _LINES_TOLD else ""
    return f"bad {('column', 'row')[axis]}{'s' if len(said) > 1 else ''} {first_ones}{more}"


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
        site(depth, c)[...] = local_median(-found.pattern / np.maximum(found.light, 1e-3), 3)
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
    return at_an_end(s) & (side * (s.mean - float(median(s.mean))) > 0)


def _always(masks: Sequence[Bool[np.ndarray, "H W"]]) -> Bool[np.ndarray, "H W"] | None:
    return np.logical_and.reduce(masks) if masks else None


def _where(mask: Bool[np.ndarray, "H W"]) -> str:
    return lines_of("columns", mask, 0) or lines_of("rows", mask, 1)
