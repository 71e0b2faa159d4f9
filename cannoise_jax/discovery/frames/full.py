"""Full pixels: the levels of a photon-transfer curve that have lost their shot noise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy import optimize

from cannoise_jax.discovery.frames.contrasts import Stack, steady
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.signatures.recorded import Level

_STANDS_OUT = 12.0
"""Power of a mode, in units of the white level, that noise of single pixels has in one of 1e5."""
_LIT = 20.0
"""Signal, in code steps, from which on light shows."""
_KNOWN = 0.1
"""Relative error of a gain by which others may be judged."""


Line = Callable[[list[Level], int], tuple[float, ...]]
"""Gain and read noise, DN, and more, of the levels of one channel."""


def _low_line(levels: list[Level], step: float) -> tuple[np.ndarray, np.ndarray]:
    """Gain and read noise from the lower half of the signals, where no pixel is full, or from as many more
    as tell the gain at all: darks alone do not. Gain 0: none do."""
    gain, read = np.zeros(4), np.zeros(4)
    for c in range(4):
        mine = sorted((p for p in levels if p.channel == c), key=lambda p: p.signal)
        if len(mine) < 4:
            continue
        x = np.maximum([p.signal for p in mine], 0.0)
        v, weight = np.array([p.variance for p in mine]), 1 / np.array([p.error for p in mine])
        for low in range((len(mine) + 1) // 2, len(mine)):
            basis = np.stack([x[:low], np.ones(low)], 1) * weight[:low, None]
            # Neither can be negative: levels that lie close together would extrapolate to anything.
            (slope, square), _ = optimize.nnls(basis, v[:low] * weight[:low])
            error = np.sqrt(np.linalg.pinv(basis.T @ basis)[0, 0])
            if x[low - 1] > _LIT * step and slope > error / _KNOWN:
                gain[c], read[c] = slope, np.sqrt(square)
                break
    return gain, read


def mark_full(levels: list[Level], step: float, line: Line) -> list[Level]:
    """Marks the levels of full pixels, which have lost their shot noise: judged by what pixels do not share,
    for the few offsets that rows, columns or a wave draw scatter a level's variance by more than that. line:
    fits gain and read noise, DN, of one channel."""
    judged = [p._replace(variance=p.alone) for p in levels]
    judged = _mark_short(judged, *_low_line(judged, step), step)
    lines = [line([p for p in judged if p.channel == c and not p.full], c) for c in range(4)]
    gain, read, *_ = (np.array(column) for column in zip(*lines, strict=True))
    judged = _mark_short(judged, gain, read, step)
    return [p._replace(full=q.full) for p, q in zip(levels, judged, strict=True)]


def _mark_short(levels: list[Level], gain: np.ndarray, read: np.ndarray, step: float) -> list[Level]:
    """Marks the levels from the first on whose variance, and that of all above, falls to less than 0.7."""
    out = list(levels)
    for c in range(4):
        mine = sorted((n for n, p in enumerate(levels) if p.channel == c), key=lambda n: -levels[n].signal)
        for n in mine:
            p = levels[n]
            expected = read[c] ** 2 + step**2 / 12 + gain[c] * max(p.signal, 0)
            # Of noise of about a code rounding leaves too little to say how much of it is lost.
            coarse = expected < 2 * step**2
            if gain[c] <= 0 or p.variance > 0.7 * expected or coarse or p.signal < _LIT * step:
                break
            out[n] = p._replace(full=True)
    return out


def unshared(stacked: Stack, signal: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Mean square of the contrasts, DN^2, without the modes of each colour plane that stand out of its white
    spectrum: offsets of rows and columns, waves, drift of the lamp and of the pedestal. signal: of every
    pixel, without the noise of the frames: with it, noise would count as drift."""
    out = np.zeros(stacked.mean.shape, np.float32)
    for c in range(4):
        at = SITES[c]
        for contrast in stacked.contrasts[:, *at]:
            modes = np.fft.rfft2(steady(contrast, signal[at]))
            power = np.abs(modes) ** 2
            modes[power > _STANDS_OUT * np.median(power) / np.log(2)] = 0
            out[at] += np.fft.irfft2(modes, contrast.shape) ** 2
    return out / max(len(stacked.contrasts), 1)
