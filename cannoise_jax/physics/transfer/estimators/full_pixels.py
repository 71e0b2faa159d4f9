"""Pixels that are full in the longest dark: shorter darks hold the charge that grows in them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool

from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.recordings.join import ALIKE_KELVIN
from cannoise_jax.recordings.recording import Recording


def charge_fills(long: FrameStatistics, short: FrameStatistics | None) -> Bool[np.ndarray, "H W"]:
    """Pixels that charge fills: those that are full in a short dark as well are stuck."""
    full = long.clipped & (long.mean > long.recording.white_level / 2)
    return full if short is None else full & ~(short.clipped & (short.mean > short.recording.white_level / 2))


def as_unfilled(
    long: FrameStatistics, short: FrameStatistics, darks: Sequence[FrameStatistics]
) -> FrameStatistics:
    """The longest dark with mean and variance, in pixels that charge fills, of the longest of `darks` that
    they do not fill, grown in proportion to the time since the shortest; those that are full in all of these
    hold at least what any of them shows."""
    left = charge_fills(long, short)
    if not left.any():
        return long
    start, end = _seconds(short), _seconds(long)
    mean, clipped = long.mean.copy(), long.clipped.copy()
    variance = None if long.variance is None else long.variance.copy()
    for s in sorted(darks, key=_seconds, reverse=True):
        if not start < _seconds(s) < end or not _as_warm(s.recording, long.recording):
            continue
        times = (end - start) / (_seconds(s) - start)
        # Those that are full here too hold more still.
        mean[left] = np.maximum(mean[left], short.mean[left] + times * (s.mean[left] - short.mean[left]))
        here = left & ~s.clipped
        if variance is not None and s.variance is not None:
            # Of one frame, as the mean over the frames of the longest dark is taken to be.
            variance[here] = times**2 * s.variance[here] * long.recording.count / s.recording.count
        clipped &= ~here
        left &= ~here
    return dataclasses.replace(long, mean=mean, variance=variance, clipped=clipped)


def _seconds(s: FrameStatistics) -> float:
    return s.recording.exposure_s or 0.0


def _as_warm(one: Recording, other: Recording) -> bool:
    known = one.temperature_c, other.temperature_c
    return None in known or abs(float(known[0] or 0.0) - float(known[1] or 0.0)) <= ALIKE_KELVIN
