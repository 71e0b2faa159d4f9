"""Full pixels: the levels of a photon-transfer curve that have lost their shot noise."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import optimize

from cannoise_jax.discovery.frames.contrasts import Stack, steady
from cannoise_jax.physics.robust import median
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.signatures.recorded import Level

_STANDS_OUT = 12.0
"""Power of a mode, in units of the white level, that noise of single pixels has in one of 1e5."""
_LIT = 20.0
"""Signal, in code steps, from which on light shows."""
_KNOWN = 0.1
"""Relative error of a gain by which others may be judged."""


def _low_line(levels: list[Level], step: float) -> tuple[np.ndarray, np.ndarray]:
    """Gain and read noise from the lower half of the signals, where no pixel is full, or from as many more
    as tell the gain at all: darks alone do not. Gain 0: none do."""
    gain, read = np.zeros(4), np.zeros(4)
    for c in range(4):
        mine = sorted((p for p in levels if p.channel == c), key=lambda p: p.signal)
        if len(mine) < 4:
            continue
        for low in range((len(mine) + 1) // 2, len(mine)):
            slope, noise, error = _straight(mine[:low])
            if mine[low - 1].signal > _LIT * step and slope > error / _KNOWN:
                gain[c], read[c] = slope, noise
                break
    return gain, read


def _line(levels: list[Level]) -> tuple[np.ndarray, np.ndarray]:
    """Gain and read noise from all levels that are not full."""
    gain, read = np.zeros(4), np.zeros(4)
    for c in range(4):
        mine = [p for p in levels if p.channel == c and not p.full]
        if mine:
            gain[c], read[c], _ = _straight(mine)
    return gain, read


def _straight(levels: list[Level]) -> tuple[float, float, float]:
    """Gain, read noise and the error of the gain by weighted least squares. Neither can be negative: levels
    that lie close together would extrapolate to anything. Not `fit_line`, which is through single pixels: it
    weighs all of a level as one, and full pixels, of which this line is to tell, would pull it down."""
    weight = 1 / np.array([p.error for p in levels])
    basis = np.stack([np.maximum([p.signal for p in levels], 0.0), np.ones(len(levels))], 1) * weight[:, None]
    (slope, square), _ = optimize.nnls(basis, np.array([p.variance for p in levels]) * weight)
    return slope, float(np.sqrt(square)), float(np.sqrt(np.linalg.pinv(basis.T @ basis)[0, 0]))


def mark_full(levels: list[Level], step: float) -> tuple[list[Level], tuple[np.ndarray, np.ndarray]]:
    """The levels with those of full pixels marked, which have lost their shot noise, and the gain (DN/e-) and
    read noise (DN) per channel of the others. Judged by what pixels do not share, for the few offsets that
    rows, columns or a wave draw scatter a level's variance by more than that."""
    judged = [p._replace(variance=p.alone) for p in levels]
    judged = _mark_short(judged, *_low_line(judged, step), step)
    line = _line(judged)
    judged = _mark_short(judged, *line, step)
    return [p._replace(full=q.full) for p, q in zip(levels, judged, strict=True)], line


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
            modes[power > _STANDS_OUT * median(power) / np.log(2)] = 0
            out[at] += np.fft.irfft2(modes, contrast.shape) ** 2
    return out / max(len(stacked.contrasts), 1)
