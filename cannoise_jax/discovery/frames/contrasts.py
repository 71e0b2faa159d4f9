"""One split of a recording: its frames reduced, its mean modelled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.recordings.codes import code_histogram, code_lattice
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import DARK, LIT, CaptureSet, Recording
from cannoise_jax.signatures.fields import (
    channel_index,
    contrast_matrix,
    least_squares,
)

MOST_FRAMES = 16
"""Frames of one recording and split that are held at once: memory does not grow beyond."""


class Stack(NamedTuple):
    """Frames of one split of a recording: mean, temporal variance, contrasts (DN) and the rails. earlier:
    mean of the `before` frames of the other split, against which the last contrast is taken; None: none.
    lines: offsets of rows and columns that darks show, DN; None: none. dust: where shadows lie in the light
    of flats, see `dust`; None: nowhere. light: `smooth_mean`, where it is worked out."""

    recording: Recording
    number: int
    mean: Float[np.ndarray, "h w"]
    variance: Float[np.ndarray, "h w"]
    contrasts: Float[np.ndarray, "n h w"]
    usable: np.ndarray
    frames: int
    step: float
    low: float
    high: float
    before: int = 0
    earlier: Float[np.ndarray, "h w"] | None = None
    lines: Float[np.ndarray, "h w"] | None = None
    dust: Bool[np.ndarray, "h w"] | None = None
    light: Float[np.ndarray, "h w"] | None = None


def stack(
    recording: Recording, index: int, chosen: list[int], step: float, before: list[int] | None = None
) -> Stack:
    """Reads the chosen frames one by one (at most MOST_FRAMES) and forms their contrasts; before: frames of
    the other split, which lend their mean alone."""
    chosen, before = chosen[:MOST_FRAMES], (before or [])[:MOST_FRAMES]
    matrix = contrast_matrix(len(chosen), len(before)).astype(np.float32)
    size = recording.size
    total, earlier = np.zeros(size, np.float64), np.zeros(size, np.float64)
    contrasts = np.zeros((len(matrix), *size), np.float32)
    high, low = np.zeros(size, np.uint16), np.full(size, 65535, np.uint16)
    anchor = None
    for n, t in enumerate((*before, *chosen)):
        frame = np.asarray(recording.frames[t : t + 1])[0]
        high, low = np.maximum(high, frame), np.minimum(low, frame)
        anchor = frame.astype(np.float32) if anchor is None else anchor
        moved = frame.astype(np.float32) - anchor
        total += frame if n >= len(before) else 0
        earlier += frame if n < len(before) else 0
        for k in np.flatnonzero(matrix[:, n]):
            contrasts[k] += matrix[k, n] * moved
    mean = (total / len(chosen)).astype(np.float32)
    # The mean of all frames is independent of every contrast.
    overall = ((total + earlier) / (len(chosen) + len(before))).astype(np.float32)
    variance = steady_variance(contrasts, overall, recording.kind == "flat")
    white = min(recording.white_level, 65535.0)
    usable = (high < white - 0.5) & (low > 0)
    if recording.kind in DARK and usable.mean() < 0.9:
        usable = np.ones(size, bool)
    return Stack(
        recording,
        index,
        mean,
        variance,
        contrasts,
        usable,
        len(chosen),
        step,
        float(low.min()),
        float(high.max()),
        len(before),
        (earlier / len(before)).astype(np.float32) if before else None,
    )


def steady_variance(contrasts: np.ndarray, mean: np.ndarray, lit: bool) -> np.ndarray:
    """Mean square of the contrasts once what a whole frame shares is taken out; lit: of a flat."""
    total = np.zeros(mean.shape, np.float32)
    for c in range(4):
        at = SITES[c]
        for contrast in contrasts:
            total[at] += steady(contrast[at], mean[at], lit) ** 2
    return total / max(len(contrasts), 1)


def steady(
    contrast: Float[np.ndarray, "*at"], mean: Float[np.ndarray, "*at"], leaning: bool = False
) -> Float[np.ndarray, "*at"]:
    """What is left of a contrast of one channel without an offset and a factor of the whole frame: neither
    drift of the lamp nor of the pedestal is noise of a pixel (EMVA 1288, section 6.6). leaning: nor is light
    that leans to another side in every frame, as the sky's does."""
    level, values = mean.ravel().astype(np.float64), contrast.ravel().astype(np.float64)
    basis = np.stack([np.ones_like(level), level - level.mean()], 1)
    if np.ptp(level) < 1e-6:
        basis = basis[:, :1]
    if leaning:
        places = np.meshgrid(*(np.linspace(-1, 1, n) for n in mean.shape), indexing="ij")
        basis = np.concatenate([basis, *((p.ravel() * level)[:, None] for p in places)], 1)
    rest = values - np.einsum("nk,k->n", basis, least_squares(basis, values))
    return rest.reshape(mean.shape).astype(np.float32)


FLICKER = 0.02
"""Share of the variance from which on what rows of light share is taken out of the photon-transfer curve."""


def without_flicker(stacked: Stack, black: np.ndarray, additive: np.ndarray) -> Stack:
    """The stack with what whole rows share beyond `additive` (variance per channel, DN^2: that of the darks)
    taken out of its variance, where that is more than `FLICKER` of it: mains light through a rolling shutter
    is no noise of a pixel, and would be taken for shot noise."""
    if not len(stacked.contrasts) or stacked.recording.kind not in LIT:
        return stacked
    variance, found = stacked.variance.copy(), False
    for c in range(4):
        at = SITES[c]
        rest, shared = row_variance(stacked.contrasts[:, *at], stacked.mean[at] - black[c])
        if shared - additive[c] > FLICKER * float(np.mean(rest)):
            variance[at], found = rest + additive[c], True
    return stacked._replace(variance=variance) if found else stacked


def row_noise(stacked: Stack) -> Float[np.ndarray, "4"]:
    """Variance of the contrasts that whole rows share, per channel, DN^2. Of a channel's own rows, for it is
    held against those under light; `line_noise` of photon transfer is of whole rows of all frames."""
    flat = np.ones(stacked.mean.shape)
    return np.array([row_variance(stacked.contrasts[:, *SITES[c]], flat[SITES[c]])[1] for c in range(4)])


def row_variance(
    contrasts: Float[np.ndarray, "n h w"], light: Float[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "h w"], float]:
    """Mean square of the contrasts of one channel once an offset, a factor of the light of every row and how
    it leans along the row are taken out, and the variance of the row means beyond what that explains, drift
    of whole frames left out."""
    columns, means = light.shape[1], contrasts.mean(2)
    slope = light - light.mean(1, keepdims=True)
    power = np.maximum(np.sum(slope**2, 1), 1e-9)
    lean = np.einsum("nij,ij->ni", contrasts, slope) / power
    left = contrasts - means[:, :, None] - lean[:, :, None] * slope
    # Light that leans along the rows, to another side in every frame.
    along = light * np.linspace(-1, 1, columns)
    along = along - along.mean(1, keepdims=True)
    along = along - np.sum(along * slope, 1, keepdims=True) / power[:, None] * slope
    bend = np.einsum("nij,ij->ni", left, along) / np.maximum(np.sum(along**2, 1), 1e-9)
    rest = np.mean((left - bend[:, :, None] * along) ** 2, 0) / (1 - 3 / columns)
    drift = np.stack([steady(m, light.mean(1)) for m in means])
    return rest.astype(np.float32), float(np.mean(drift**2) - np.mean(rest) / columns)


def code_step(capture: CaptureSet) -> float:
    """Spacing of the codes: stated in the files, else as the codes show it, DN."""
    stated = {r.code_step for r in capture.recordings if r.code_step}
    return float(stated.pop()) if len(stated) == 1 else detected_step(capture)


def detected_step(capture: CaptureSet) -> float:
    """Greatest common divisor of the steps of the recordings' first frames, codes below the white level, DN;
    1 where none shows."""
    step = 0
    for recording in capture.recordings:
        counts = code_histogram(np.asarray(recording.frames[0:1]))
        counts[int(np.ceil(recording.white_level)) :] = 0
        step = int(np.gcd(step, int(code_lattice(counts).step)))
    return float(max(step, 1))


def ordinary(values: np.ndarray) -> np.ndarray:
    """Which values lie within six robust standard deviations of their median. Where most of them are one
    code, those that are not tell the spread: without them the mean would be that code."""
    centre = median(values)
    away = np.abs(values - centre)
    spread = robust_std(values, centre)
    if spread < 1e-6:
        others = away[away > 1e-6]
        spread = float(median(others)) if others.size else 1e-6
    return away < 6 * spread


def robust_mean(values: np.ndarray) -> float:
    """Mean of the `ordinary` values: recorded ones, for where there is no noise it is that of all."""
    return float(values[ordinary(values)].mean())


def reference(recording: Recording) -> np.ndarray:
    """The recording's reference as one normalised frame; a noisy one is smoothed within its colour plane."""
    clean = np.asarray(recording.clean, np.float32)
    clean = clean.mean(0) if clean.ndim == 3 else clean
    return plane_blur(clean) if noisy_reference(recording) else clean


def noisy_reference(recording: Recording) -> bool:
    """Whether a scene's reference is a mean of too few frames, or missing."""
    if recording.kind != "scene":
        return False
    few = recording.reference == "burst_mean" and (recording.reference_frames or 0) < 32
    return recording.clean is None or few


def plane_blur(image: np.ndarray) -> np.ndarray:
    """Mean of 3 x 3 pixels of one colour plane."""
    padded = np.pad(image, 2, mode="reflect")
    h, w = image.shape
    shifts = [padded[2 + dy : 2 + dy + h, 2 + dx : 2 + dx + w] for dy in (-2, 0, 2) for dx in (-2, 0, 2)]
    return np.mean(shifts, axis=0)


def affine(
    stacked: Stack, clean: np.ndarray, sigma: np.ndarray, channel: np.ndarray, linear: np.ndarray
) -> np.ndarray:
    """Mean of every pixel, DN: offset and factor per channel on the reference, fitted where it is linear."""
    out = np.zeros(clean.shape)
    for c in range(4):
        chosen = (channel == c) & stacked.usable & linear
        if chosen.sum() < 64:
            chosen = channel == c
        offset, slope = robust_line(clean[chosen], stacked.mean[chosen], sigma[chosen])
        out[channel == c] = offset + slope * clean[channel == c]
    return out


def robust_line(
    x: Float[np.ndarray, "n"], values: Float[np.ndarray, "n"], sigma: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "2"]:
    """Offset and slope by weighted least squares, values beyond six median deviations left aside."""
    basis = np.stack([np.ones(x.size), x], 1) / sigma[:, None]
    values = values / sigma
    kept = np.ones(values.size, bool)
    for _ in range(2):
        beta = least_squares(basis[kept], values[kept])
        rest = values - np.einsum("nk,k->n", basis, beta)
        kept = np.abs(rest) < 6 * robust_std(rest, 0) + 1e-6
    return beta


def at_level(mean: np.ndarray, like: np.ndarray, black: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """The mean of other frames, DN, scaled per channel to the level of `like` over the chosen pixels: frames
    brighter or darker as a whole are the lamp's."""
    out, channel = mean.astype(np.float32), channel_index(mean.shape)
    for c in range(4):
        mine = (channel == c) & chosen
        if mine.any():
            level = max(float(np.mean(mean[mine] - black[c])), 1e-6)
            factor = float(np.mean(like[mine] - black[c])) / level
            out[channel == c] = black[c] + factor * (mean[channel == c] - black[c])
    return out
