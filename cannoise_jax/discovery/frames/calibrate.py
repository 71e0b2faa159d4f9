"""The nuisance fit: black level, gain and read noise per channel, and the mean of every recording.

Gain and read noise come from differences between frames alone, which no fixed pattern, shading or wrong
reference can reach (photon transfer, EMVA 1288 release 4.0, section 6); the mean of a flat is a smooth
surface
per channel, that of a scene its reference after an affine refit per channel.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy import stats

from cannoise_jax.discovery.frames.contrasts import (
    Stack,
    affine,
    at_level,
    noisy_reference,
    plane_blur,
    reference,
    robust_mean,
    row_noise,
    smooth_mean,
    without_flicker,
)
from cannoise_jax.discovery.frames.full import mark_full, unshared
from cannoise_jax.physics.core.rounding import CLEAR, COARSE, before_rounding, level_and_spread
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import DARK, CaptureSet, Recording, mosaic_map
from cannoise_jax.signatures.fields import Fields, channel_index
from cannoise_jax.signatures.recorded import GroupBaseline, Level

_SHORT_S = 0.1
"""Exposure, s, below which dark charge hardly matters."""
_LINEAR = 0.45
"""Share of full scale up to which a scene is matched to its reference: a response that bends shows in the
upper half."""
_BINS = 8
"""Half the bins of like signal of a scene, per channel."""


def gain_groups(capture: CaptureSet) -> list[float | None]:
    """The ISO values that occur, sorted; [None] when none is stated."""
    isos = {r.iso for r in capture.recordings}
    return [None] if isos == {None} else sorted(isos, key=lambda v: -1.0 if v is None else v)


def stated_black(recordings: list[Recording]) -> np.ndarray:
    """Black level of the files, mosaic order, DN."""
    return np.mean([r.black_level for r in recordings], axis=0)


def fit_baseline(stacks: list[Stack], iso: float | None) -> GroupBaseline:
    """Black level, gain and read noise per channel of one gain setting, weighted least squares on the
    curve."""
    dark = [s for s in stacks if s.recording.kind in DARK]
    black = stated_black([s.recording for s in stacks])
    if dark:
        shortest = min(dark, key=lambda s: s.recording.exposure_s or 0.0)
        channel = channel_index(shortest.mean.shape)
        black = np.array([robust_mean(shortest.mean[channel == c]) for c in range(4)])
    shared = _shared_by_rows(dark)
    stacks = [without_flicker(s, black, shared) for s in _of_curve(stacks)]
    alone = [unshared(s, _expected(s, black)) for s in stacks]
    line = partial(_line, stacks)
    model: tuple[np.ndarray, np.ndarray] | None = None
    for _ in range(2):
        levels = [
            p
            for s, u in zip(stacks, alone, strict=True)
            if len(s.contrasts)
            for p in _levels(s, black, model, u)
        ]
        levels = mark_full(levels, stacks[0].step, line)
        lines = [line([p for p in levels if p.channel == c and not p.full], c) for c in range(4)]
        gain, read, gain_error, read_error = (np.array(column) for column in zip(*lines, strict=True))
        model = gain, read
    pedestal = black.copy()
    for s in (s for s in stacks if s.recording.kind in DARK and len(s.contrasts)):
        if (s.recording.exposure_s or 0.0) == _shortest(stacks):
            pedestal, read = _before_rounding(s, [p for p in levels if p.recording == s.number], black, read)
            break
    return GroupBaseline(iso, black, gain, read, gain_error, read_error, tuple(levels), pedestal)


def _shortest(stacks: list[Stack]) -> float:
    """Exposure of the shortest dark that shows noise, s; an unknown one is taken as none."""
    repeated = (s for s in stacks if s.recording.kind in DARK and len(s.contrasts))
    return min((s.recording.exposure_s or 0.0 for s in repeated), default=0.0)


def _of_curve(stacks: list[Stack]) -> list[Stack]:
    """The recordings of the photon-transfer curve: beside light only the shortest darks, for the charge of
    long ones is drawn by warm pixels and follows a curve of its own."""
    if not any(s.recording.kind not in DARK and len(s.contrasts) for s in stacks):
        return stacks
    longest = max(2 * _shortest(stacks), _SHORT_S)
    return [s for s in stacks if s.recording.kind not in DARK or (s.recording.exposure_s or 0.0) <= longest]


def _before_rounding(
    dark: Stack, levels: list[Level], black: np.ndarray, read: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Black level and read noise (DN) before rounding and clipping where these change them, see
    `physics.core.rounding`; else as they are."""
    pedestal, read = black.copy(), read.copy()
    for p in levels:
        sigma = np.sqrt(p.variance)
        if sigma > COARSE * dark.step and black[p.channel] > CLEAR * sigma:
            continue
        level, spread = level_and_spread(dark.mean[SITES[p.channel]], p.variance, dark.frames, dark.step)
        pedestal[p.channel], read[p.channel] = before_rounding(level, p.variance, dark.step, spread)
    return pedestal, read


def _shared_by_rows(dark: list[Stack]) -> np.ndarray:
    """Variance that the rows of the darks share, mean of all darks, per channel, DN^2."""
    shared = [row_noise(s) for s in dark if len(s.contrasts)]
    return np.maximum(np.mean(shared, axis=0), 0.0) if shared else np.zeros(4)


def full_level(baseline: GroupBaseline) -> float:
    """Lowest signal at which the pixels are full, DN above black; infinite when none is."""
    return min((p.signal for p in baseline.levels if p.full), default=np.inf)


def _levels(
    stacked: Stack, black: np.ndarray, model: tuple[np.ndarray, np.ndarray] | None, unshared: np.ndarray
) -> list[Level]:
    """Bins of like signal. Without a model the variance comes from medians; with one, pixels far above it
    (hot, telegraph) are left out one by one."""
    channel = channel_index(stacked.mean.shape)
    signal = _expected(stacked, black)
    n = max(len(stacked.contrasts), 1)
    # Beyond `far` times its variance a pixel is not like the others. Below half a code their median says
    # little of that: it is one of a few values.
    far, lattice = float(stats.chi2.isf(1e-6, n) / n), (0.5 * stacked.step) ** 2
    out = []
    for c in range(4):
        chosen = (channel == c) & stacked.usable
        x, v, u = signal[chosen], stacked.variance[chosen], unshared[chosen]
        if x.size < 64:
            continue
        root = np.sqrt(np.maximum(x, 0))
        bins = 2 * _BINS if stacked.recording.kind == "scene" else 1
        which = np.clip(((root - root.min()) / max(np.ptp(root), 1e-9) * bins).astype(int), 0, bins - 1)
        for b in range(bins):
            xb, vb = x[which == b], v[which == b]
            if xb.size < 200:
                continue
            if model is None:
                mean, number = float(np.median(vb) / (stats.chi2.median(n) / n)), vb.size / 2
            else:
                gain, read = model
                expected = read[c] ** 2 + stacked.step**2 / 12 + gain[c] * np.maximum(xb, 0)
                scale = max(np.median(vb / expected) / (stats.chi2.median(n) / n), 0.2)
                kept = vb < np.maximum(scale * expected, lattice) * far
                mean, number = float(vb[kept].mean()), int(kept.sum())
                xb = xb[kept]
            # Near the rail the noise decides which pixels clip: the rest would be a biased sample.
            if xb.mean() + black[c] + 5 * np.sqrt(mean) >= stacked.recording.white_level:
                continue
            error = max(mean, stacked.step**2 / 12) * np.sqrt(2 / (n * number))
            sure = mean > stacked.step**2 / 3 and not noisy_reference(stacked.recording)
            ub = u[which == b]
            alone = float(ub[ub < far * max(np.median(ub) / (stats.chi2.median(n) / n), lattice)].mean())
            out.append(
                Level(
                    stacked.number, c, float(xb.mean()), mean, float(error), int(number), False, sure, alone
                )
            )
    return out


def _expected(stacked: Stack, black: np.ndarray) -> np.ndarray:
    """Signal of every pixel for the photon-transfer curve, DN: the reference, else the smoothed mean."""
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
    mean = (
        stacked.mean
        if stacked.earlier is None
        else at_level(stacked.earlier, stacked.mean, black, stacked.usable)
    )
    return plane_blur(mean) - mosaic_map(tuple(black), recording.size)


def _line(stacks: list[Stack], levels: list[Level], c: int) -> tuple[float, float, float, float]:
    """Gain and read noise (DN) of one channel: variance = read^2 + step^2/12 + gain * signal."""
    step = stacks[0].step
    # To noise below half a code rounding adds less than step^2/12.
    broad = [p for p in levels if p.variance > step**2 / 3]
    most = np.inf
    if broad and max(p.signal for p in broad) - min(p.signal for p in broad) > 20 * step:
        most = min((p.variance for p in levels if p.variance <= step**2 / 3), default=np.inf)
        levels = broad
    dark = [p for p in levels if p.signal < 1e-3 * max([q.signal for q in levels] + [1.0]) + 2 * step]
    if not levels:
        first = stacks[0].recording
        span = first.white_level - np.mean(first.black_level)
        shot = first.shot[c] * span if first.shot else 1.0
        read = np.sqrt(first.read[c]) * span if first.read else max(np.std(stacks[0].mean), step)
        return float(shot), float(read), 0.0, 0.0
    x, v, e, n = (
        np.array([getattr(p, name) for p in levels]) for name in ("signal", "variance", "error", "pixels")
    )
    x = np.maximum(x, 0)
    if np.ptp(x) < 2 * step or len(levels) == len(dark):
        first = stacks[0].recording
        rest = float(np.average(v, weights=n) - step**2 / 12)
        span = first.white_level - np.mean(first.black_level)
        slope = float(first.shot[c] * span) if first.shot else 1.0
        if len(levels) > len(dark):
            # One level of light: shot noise of the stated gain, or else all of it, and the rest.
            signal = float(np.average(x, weights=n))
            most = max(rest, 0.0) / signal
            slope = min(slope, most) if first.shot else most
            rest -= slope * signal
        return slope, float(np.sqrt(max(rest, 1e-4 * step**2))), 0.0, 0.0
    relative = e / np.maximum(v, 1e-9)
    fitted = v
    for _ in range(6):
        weight = 1 / (relative * np.maximum(fitted, 1e-3 * v.max() if v.max() > 0 else 1.0)) ** 2
        basis = np.stack([np.ones_like(x), x], 1)
        normal = basis.T @ (weight[:, None] * basis)
        beta = np.linalg.solve(normal, basis.T @ (weight * v))
        fitted = np.maximum(np.einsum("nk,k->n", basis, beta), step**2 / 12)
    cov = np.linalg.inv(normal)
    read2 = max(min(beta[0] - step**2 / 12, most), 1e-4 * step**2)
    read = np.sqrt(read2)
    return (
        float(max(beta[1], 1e-6)),
        float(read),
        float(np.sqrt(cov[1, 1])),
        float(np.sqrt(cov[0, 0]) / (2 * read)),
    )


def standardise(stacked: Stack, baseline: GroupBaseline, group: int) -> Fields:
    """The fields of one recording under the fitted baseline."""
    recording, size = stacked.recording, stacked.mean.shape
    channel = channel_index(size)
    expected = _expected(stacked, baseline.black)
    signal = np.maximum(expected, 0)
    gain, read = baseline.gain[channel], baseline.read_dn[channel]
    variance = gain * signal + read**2 + stacked.step**2 / 12
    clean = None if recording.clean is None else reference(recording)
    static, mean = None, signal + baseline.black[channel]
    if recording.kind in DARK:
        mean = expected + mosaic_map(baseline.black, size)
        variance = own_variance(stacked, channel, variance, mean)
        static = stacked.mean - mean
    elif recording.kind == "flat":
        mean = expected + mosaic_map(baseline.black, size)
        static = stacked.mean - mean
    elif clean is not None and recording.reference != "burst_mean":
        mean = affine(stacked, clean, np.sqrt(variance), channel, signal < 0.9 * full_level(baseline))
        static = stacked.mean - mean
    sigma = np.sqrt(variance).astype(np.float32)
    usable = stacked.usable & (signal < 0.9 * full_level(baseline))
    # Near the rail the noise decides which pixels clip: the rest would be a biased sample.
    usable &= mean + 5 * sigma < recording.white_level
    if not len(stacked.contrasts):
        static = None  # one frame cannot tell what stays from what is redrawn
    scaled = np.float32(np.sqrt(stacked.frames)) * usable / sigma
    contrasts = stacked.contrasts * (usable / sigma)
    contrasts = contrasts.astype(np.float32)
    return Fields(
        recording.path or f"recording {stacked.number}",
        recording.kind,
        stacked.frames,
        stacked.number,
        group,
        recording.exposure_s,
        stacked.step,
        mean.astype(np.float32),
        signal.astype(np.float32),
        sigma,
        (gain * signal / variance).astype(np.float32),
        usable,
        contrasts,
        None if static is None else (static * scaled).astype(np.float32),
        clean,
        baseline.gain,
        baseline.black,
        stacked.before,
    )


def own_variance(stacked: Stack, channel: np.ndarray, modelled: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Darks are standardised by their own variance, in which rounding below a step and dark current are
    included: the temporal one, of a single frame that over the pixels."""
    out = modelled.copy()
    n = max(len(stacked.contrasts), 1)
    values = stacked.variance if len(stacked.contrasts) else (stacked.mean - mean) ** 2
    for c in range(4):
        v = values[channel == c]
        limit = stats.chi2.isf(1e-6, n) / n * max(np.median(v) * n / stats.chi2.median(n), 1e-9)
        # Of noise far below a step most pixels never move: one that changes by a code is no outlier.
        kept = v[v < max(limit, stacked.step**2)]
        out[channel == c] = max(float(kept.mean()) if kept.size else 0.0, 1e-6)
    return out
