"""The photon-transfer curve of one gain setting: its levels, and the pixels that the line goes through.

The levels say which pixels are full, which are left out beside a rail or below a code, and what signatures
judge the shape of the curve by; gain and read noise come from the line through the pixels, which is that of
`physics.transfer.fit` with its rule for outliers. The variance holds what rows share, for a camera without
row noise has to explain all of the noise of a pixel; the table of `physics.transfer` states the two apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

from cannoise_jax.discovery.frames.contrasts import (
    Stack,
    affine,
    at_level,
    noisy_reference,
    plane_blur,
    reference,
)
from cannoise_jax.discovery.frames.full import unshared
from cannoise_jax.discovery.frames.smooth import smooth_mean
from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.fit import HALF_A_CODE, ChannelMaps, median_quotient, robust_mean_square
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import DARK, mosaic_map
from cannoise_jax.signatures.fields import channel_index
from cannoise_jax.signatures.recorded import Level

_LINEAR = 0.45
"""Share of full scale up to which a scene is matched to its reference: a response that bends shows in the
upper half."""
_PARTS = 16
"""Classes of like signal of a scene, per channel."""
_LOST, _SHOWS = 0.5, 20.0
"""Share of the light, and signal in code steps beyond which it shows, that a dead pixel is missing."""
_FEWEST, _FEWEST_OF_CHANNEL = 200, 64
"""Pixels of a level, and of a channel, below which neither is looked at."""


class Curve(NamedTuple):
    """One recording as a piece of the curve. signal: of every pixel without the noise of the frames, DN above
    black; known: whether it is, so that the line need not allow for its error; measured: for the line, see
    `maps_of`; part: class of like signal, -1 where a pixel is in none; alone: variance of what pixels do not
    share, DN^2."""

    stack: Stack
    signal: Float[np.ndarray, "h w"]
    known: bool
    measured: Float[np.ndarray, "h w"]
    part: Int[np.ndarray, "h w"]
    alone: Float[np.ndarray, "h w"]


def curve_of(stacked: Stack, black: np.ndarray) -> Curve:
    """A recording of more than one frame as a piece of the curve."""
    signal, kind = expected_signal(stacked, black), stacked.recording.kind
    known = kind in DARK or (kind == "scene" and not noisy_reference(stacked.recording))
    part = np.full(signal.shape, -1, np.int8)
    parts = _PARTS if kind == "scene" else 1
    channel = channel_index(signal.shape)
    measured = signal if known else _mean(stacked, black) - mosaic_map(tuple(black), signal.shape)
    # Of a flat pixels that miss most of the light, dead ones: their noise is of another level.
    lost = (measured < _LOST * signal) & (signal > _SHOWS * stacked.step) & (kind == "flat")
    for c in range(4):
        chosen = (channel == c) & stacked.usable & ~lost
        if chosen.sum() < _FEWEST_OF_CHANNEL:
            continue
        root = np.sqrt(np.maximum(signal[chosen], 0))
        part[chosen] = np.clip((root - root.min()) / max(np.ptp(root), 1e-9) * parts, 0, parts - 1)
    return Curve(stacked, signal, known, measured, part, unshared(stacked, signal))


def levels_of(
    curves: Sequence[Curve], black: np.ndarray, start: tuple[np.ndarray, np.ndarray] | None = None
) -> list[Level]:
    """The levels of all recordings. Without a start (gain, DN/e-, and read noise, DN, per channel) their
    variance comes from medians; with one it is the mean by the outlier rule of the line, which leaves out hot
    and telegraph pixels one by one."""
    return [p for curve in curves for c in range(4) for p in _levels(curve, c, black[c], start)]


@lru_cache(maxsize=64)
def _far(dof: int) -> float:
    """A mean square, in units of its expectation, that one pixel of a million exceeds by chance."""
    return float(stats.chi2.isf(1e-6, dof) / dof)


def _levels(curve: Curve, c: int, black: float, start: tuple[np.ndarray, np.ndarray] | None) -> list[Level]:
    stacked, at = curve.stack, SITES[c]
    n, rounding = len(stacked.contrasts), stacked.step**2 / 12
    far, lattice = _far(n), HALF_A_CODE * rounding
    part, out = curve.part[at], []
    for b in range(int(part.max()) + 1):
        chosen = part == b
        if chosen.sum() < _FEWEST:
            continue
        x, v, u = curve.signal[at][chosen], stacked.variance[at][chosen], curve.alone[at][chosen]
        if start is None:
            mean, number = float(median(v)) / median_quotient(n), v.size / 2
        else:
            expected = start[1][c] ** 2 + rounding + start[0][c] * np.maximum(x, 0)
            expected *= max(float(median(v / expected)) / median_quotient(n), 0.2)
            mean, kept = robust_mean_square(v, n, expected, rounding)
            number, x = int(kept.sum()), x[kept]
        # Near the rail the noise decides which pixels clip: the rest would be a biased sample.
        if x.mean() + black + 5 * np.sqrt(mean) >= stacked.recording.white_level:
            continue
        error = max(mean, rounding) * np.sqrt(2 / (n * number))
        sure = mean > 4 * rounding and not noisy_reference(stacked.recording)
        alone = float(u[u < far * max(float(median(u)) / median_quotient(n), lattice)].mean())
        out.append(
            Level(
                recording=stacked.number,
                channel=c,
                signal=float(x.mean()),
                variance=mean,
                error=float(error),
                pixels=int(number),
                full=False,
                sure=sure,
                alone=alone,
                part=b,
            )
        )
    return out


def maps_of(curves: Sequence[Curve], levels: Sequence[Level], c: int, cut: float) -> list[ChannelMaps]:
    """One channel of the recordings for the line, the pixels of these levels alone. cut: variance that the
    darks have lost where they are cut off, DN^2."""
    at, out = SITES[c], []
    for curve in curves:
        s = curve.stack
        parts = [p.part for p in levels if p.recording == s.number and p.channel == c]
        if parts:
            signal = np.asarray(curve.measured[at], np.float64)
            if s.recording.kind in DARK:
                signal = np.maximum(signal, 0.0)
            variance = np.asarray(s.variance[at], np.float64) + (cut if s.recording.kind in DARK else 0.0)
            usable = np.isin(curve.part[at], parts)
            frames = s.frames + s.before
            out.append(ChannelMaps(signal, variance, usable, frames, len(s.contrasts), curve.known))
    return out


def expected_signal(stacked: Stack, black: np.ndarray) -> Float[np.ndarray, "h w"]:
    """Signal of every pixel, DN above black: the reference, else the smoothed mean."""
    recording = stacked.recording
    if recording.kind == "flat" or recording.kind in DARK:
        return smooth_mean(stacked) - mosaic_map(black, recording.size)
    if recording.clean is not None:
        clean = reference(recording)
        low = clean < _LINEAR
        if low.mean() < 0.5:
            low = np.ones(clean.shape, bool)
        spread = np.sqrt(np.maximum(clean, 1e-3))
        fitted = affine(stacked, clean, spread, channel_index(clean.shape), low)
        return fitted - mosaic_map(tuple(black), recording.size)
    return plane_blur(_others(stacked, black)) - mosaic_map(tuple(black), recording.size)


def _others(stacked: Stack, black: np.ndarray) -> Float[np.ndarray, "h w"]:
    """Mean of the frames before, DN, scaled to the level of the others; without any, that of all."""
    if stacked.earlier is None:
        return stacked.mean
    return at_level(stacked.earlier, stacked.mean, black, stacked.usable)


def _mean(stacked: Stack, black: np.ndarray) -> Float[np.ndarray, "h w"]:
    """Mean of all frames, DN, those before scaled to the level of the others: its error is that of so many
    frames, and its covariance with the contrasts as with a variance over them."""
    if stacked.earlier is None:
        return stacked.mean
    both = stacked.frames * stacked.mean + stacked.before * _others(stacked, black)
    return both / (stacked.frames + stacked.before)
