"""What a flat holds beside its light: the fixed pattern of the darks at the flat's exposure, pixel by pixel.

EMVA 1288 takes PRNU from flats less darks of one exposure, so that what pixels hold in the dark cancels, that
of warm and hot ones with it. Where no dark is as long, the darks next to it in exposure give the pattern by a
straight line for every pixel, for dark charge grows with the exposure.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from cannoise_jax.physics.robust import robust_std
from cannoise_jax.physics.transfer.black import as_long, reference_dark
from cannoise_jax.physics.transfer.estimators.pick import steady_pixels
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.quiet import rounding_of_offsets, unchanging
from cannoise_jax.physics.transfer.views import pixel_variance
from cannoise_jax.recordings.packing import ALL, site
from cannoise_jax.recordings.recording import DARK

HOT = 6.0
"""Robust standard deviations: of a normal law one pixel in 5e8 lies as far out."""
_BEYOND = 0.5
"""Of the exposures between two darks: how far outside them their straight line is used."""
_ENOUGH = 0.5
"""Share of pixels that have to be neither hot nor loud nor cut off for a pattern of the others."""


class DarkMap(NamedTuple):
    """Fixed pattern in the dark. offsets: DN, channel means out. keep: pixels that are neither hot nor loud
    nor at an end of the codes. darks: those it is made of, with their weights."""

    offsets: Float[np.ndarray, "H W"]
    keep: Bool[np.ndarray, "H W"]
    darks: tuple[tuple[FrameStatistics, float], ...]

    def noise(self, c: int) -> float:
        """Variance that the offsets of one channel still hold, temporal and of rounding, DN^2."""
        keep = site(self.keep, c)
        parts = [w**2 * float(pixel_variance(s, c)[keep].mean()) / s.recording.count for s, w in self.darks]
        return float(sum(parts)) + self.rounding(c)

    def rounding(self, c: int) -> float:
        """The part of rounding, which is known to no better than itself where pixels that changed code in no
        frame are those that are kept."""
        return sum(w**2 * rounding_of_offsets(s, c) for s, w in self.darks)


def dark_map(
    statistics: Sequence[FrameStatistics], flat: FrameStatistics, channel: int = ALL
) -> DarkMap | None:
    """The pattern of the darks at the exposure of a flat; None without repeated darks that show one. channel:
    the one that is asked for, the others are left empty."""
    darks = _weighted(statistics, flat.recording.exposure_s)
    channels = range(4) if channel == ALL else (channel,)
    offsets, keep = np.zeros(flat.mean.shape), np.zeros(flat.mean.shape, bool)
    for c in channels if darks else ():
        site(keep, c)[...] = True
        for dark, weight in darks:
            mean, inside = site(dark.mean, c), steady_pixels(dark, c)
            part = mean - (mean[inside].mean() if inside.any() else 0.0)
            inside &= np.abs(part) < HOT * max(robust_std(part, 0.0), dark.code_step)
            site(offsets, c)[...] += weight * part
            site(keep, c)[...] &= inside
    enough = _ENOUGH * flat.mean.size * len(channels) / 4
    return DarkMap(offsets, keep, darks) if keep.sum() > enough else None


def _weighted(
    statistics: Sequence[FrameStatistics], seconds: float | None
) -> tuple[tuple[FrameStatistics, float], ...]:
    """The darks whose weighted sum stands for one of so many seconds."""
    usable = [
        s for s in statistics if s.recording.kind in DARK and s.variance is not None and not unchanging(s)
    ]
    if not usable:
        return ()
    exposures = {_seconds(s): s for s in sorted(usable, key=lambda s: s.recording.count)}
    times = sorted(t for t in exposures if t is not None)
    if seconds is None or not times:
        nearest = reference_dark([s for s in statistics if s.recording.kind == "flat"] + usable)
        return () if nearest is None else ((nearest, 1.0),)
    if same := [t for t in times if as_long(t, seconds, usable)]:
        return ((exposures[max(same, key=lambda t: exposures[t].recording.count)], 1.0),)
    at = int(np.clip(np.searchsorted(times, seconds), 1, max(len(times) - 1, 1)))
    if len(times) > 1:
        weight = (seconds - times[at - 1]) / (times[at] - times[at - 1])
        if -_BEYOND <= weight <= 1 + _BEYOND:
            return (exposures[times[at - 1]], 1 - weight), (exposures[times[at]], weight)
    return ((exposures[min(times, key=lambda t: abs(t - seconds))], 1.0),)


def _seconds(s: FrameStatistics) -> float | None:
    return 0.0 if s.recording.kind == "bias" and not s.recording.exposure_s else s.recording.exposure_s
