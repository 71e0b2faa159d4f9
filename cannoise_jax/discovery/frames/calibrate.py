"""The nuisance fit: black level, gain and read noise per channel, and the mean of every recording.

Gain and read noise come from differences between frames alone, which no fixed pattern, shading or wrong
reference can reach (photon transfer, EMVA 1288 release 4.0, section 6).
The mean of a flat is a smooth surface per channel.
The mean of a scene is its reference after an affine refit per channel.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import stats

from cannoise_jax.discovery.frames.contrasts import (
    Stack,
    affine,
    reference,
    robust_mean,
    row_noise,
    without_flicker,
)
from cannoise_jax.discovery.frames.curve import Curve, curve_of, expected_signal, levels_of, maps_of
from cannoise_jax.discovery.frames.full import mark_full
from cannoise_jax.physics.core.rounding import CLEAR, COARSE, before_rounding, level_and_spread
from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.black import alike
from cannoise_jax.physics.transfer.fit import fit_line
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import DARK, CaptureSet, Recording, mosaic_map
from cannoise_jax.signatures.fields import Fields, channel_index
from cannoise_jax.signatures.recorded import GroupBaseline, Level


def gain_groups(capture: CaptureSet) -> list[float | None]:
    """The ISO values that occur, sorted; [None] when none is stated."""
    isos = {r.iso for r in capture.recordings}
    return [None] if isos == {None} else sorted(isos, key=lambda v: -1.0 if v is None else v)


def stated_black(recordings: list[Recording]) -> np.ndarray:
    """Black level of the files, mosaic order, DN."""
    return np.mean([r.black_level for r in recordings], axis=0)


def fit_baseline(stacks: list[Stack], iso: float | None) -> GroupBaseline:
    """Black level, gain and read noise per channel of one gain setting: the line of photon transfer
    (`physics.transfer.fit`) through the pixels of its curve."""
    dark = [s for s in stacks if s.recording.kind in DARK]
    black = stated_black([s.recording for s in stacks])
    if dark:
        shortest = min(dark, key=lambda s: s.recording.exposure_s or 0.0)
        channel = channel_index(shortest.mean.shape)
        black = np.array([robust_mean(shortest.mean[channel == c]) for c in range(4)])
    shared = _shared_by_rows(dark)
    chosen = _of_curve(stacks)
    curves = [curve_of(without_flicker(s, black, shared), black) for s in chosen if len(s.contrasts)]
    levels, start = mark_full(levels_of(curves, black), chosen[0].step)
    levels, _ = mark_full(levels_of(curves, black, start), chosen[0].step)
    stored = _shortest_dark(chosen)
    of_dark = [] if stored is None else [p for p in levels if p.recording == stored.number]
    before = {} if stored is None else _before_rounding(stored, of_dark, black)
    cut = np.zeros(4) if stored is None else _lost_below(stored, of_dark, before, black)
    lines = [
        _line(curves, [p for p in levels if p.channel == c and not p.full], c, chosen[0], cut[c])
        for c in range(4)
    ]
    gain, read, gain_error, read_error = (np.array(column) for column in zip(*lines, strict=True))
    # The four channels have it in common: the variance of each is twice as unsure as that of all.
    common = _between_frames(dark, float(np.linalg.norm(read_error * read)) / 2)
    read_error = np.maximum(read_error, 2 * common / (2 * read))
    pedestal = black.copy()
    for c, (level, noise) in before.items():
        pedestal[c], read[c] = level, noise
    return GroupBaseline(
        gain=gain,
        read_noise=read,
        black_level=black,
        gain_stderr=gain_error,
        read_stderr=read_error,
        white_level=chosen[0].recording.white_level,
        code_step=chosen[0].step,
        iso=iso,
        levels=tuple(levels),
        pedestal=pedestal,
    )


_TELLS = 0.5
"""Standard deviations, codes, from which on noise that is cut off tells how much of it is lost."""
_WHOLE = 3.0
"""Variance of noise of which half is cut off, over what is left of it."""
_FEWEST_CONTRASTS = 3
"""Of a dark from which on they show how its noise differs from frame to frame."""
_MORE = 2.0
"""Standard errors of pixels that are independent, from which on what frames differ by is no chance: of three
contrasts it is 1.7 of those in one of twenty."""


def _between_frames(dark: list[Stack], known: float) -> float:
    """Standard error of the mean variance of the quietest dark by what its contrasts differ in, DN^2: what
    whole frames have, as a wave, averages over frames and not over pixels. known: that of pixels that are
    independent; 0: it is no more than that."""
    told = [s for s in dark if len(s.contrasts) >= _FEWEST_CONTRASTS]
    if not told:
        return 0.0
    quietest = min(told, key=lambda s: float(np.mean(s.variance)))
    each = quietest.contrasts.var((1, 2))
    error = float(each.std(ddof=1) / np.sqrt(each.size))
    return error if error > _MORE * known else 0.0


def _lost_below(
    dark: Stack, levels: list[Level], before: Mapping[int, tuple[float, float]], black: np.ndarray
) -> np.ndarray:
    """Variance of each channel of a dark that is lost where values are cut off at code 0, DN^2: that of flats
    is whole. before: see `_before_rounding`."""
    out = np.zeros(4)
    for p in levels:
        if _is_cut(p, black) and p.variance > (_TELLS * dark.step) ** 2:
            _, read = before[p.channel]
            out[p.channel] = max(read**2 + dark.step**2 / 12 - p.variance, 0.0)
    return out


def _is_cut(p: Level, black: np.ndarray) -> bool:
    """Whether code 0 is near enough to the level of a dark to be seen in its noise."""
    return bool(black[p.channel] <= CLEAR * np.sqrt(p.variance))


def _before_cut(dark: Stack, p: Level) -> tuple[float, float]:
    """Black level and read noise (DN) of one channel of a dark before rounding and clipping. Of noise that is
    cut off the variance is the mean of that of the pixels: medians tell it of normal noise alone."""
    at = SITES[p.channel]
    n, each = len(dark.contrasts), dark.variance[at][dark.usable[at]]
    whole = each[each < _WHOLE * float(stats.chi2.isf(1e-6, n)) / n * p.variance]
    variance = float(whole.mean()) if whole.size else p.variance
    level, spread = level_and_spread(dark.mean[at], variance, dark.frames, dark.step)
    return before_rounding(level, variance, dark.step, spread)


def _line(
    curves: list[Curve], levels: list[Level], c: int, first: Stack, cut: float
) -> tuple[float, float, float, float]:
    """Gain and read noise (DN) of one channel and their errors; as stated, with error 0, where the levels do
    not tell them. levels: of this channel, without those of full pixels. cut: variance that darks have lost,
    DN^2."""
    step, r = first.step, first.recording
    span = r.white_level - np.mean(r.black_level)
    if not levels:
        shot = r.shot[c] * span if r.shot else 1.0
        read = np.sqrt(r.read[c]) * span if r.read else max(np.std(first.mean), step)
        return float(shot), float(read), 0.0, 0.0
    # To noise below half a code rounding adds less than step^2/12.
    broad = [p for p in levels if p.variance > step**2 / 3]
    most = np.inf
    if broad and max(p.signal for p in broad) - min(p.signal for p in broad) > 20 * step:
        most = min((p.variance for p in levels if p.variance <= step**2 / 3), default=np.inf)
        levels = broad
    signal = np.maximum([p.signal for p in levels], 0)
    dark = int(np.sum(signal < 1e-3 * max(float(signal.max()), 1.0) + 2 * step))
    line = fit_line(maps_of(curves, levels, c, cut), step**2 / 12) if dark < len(levels) else None
    if line is not None and (line.sure or np.ptp(signal) >= 2 * step):
        read = np.sqrt(max(min(line.offset.value, most), 1e-4 * step**2))
        return max(line.slope.value, 1e-6), read, line.slope.stderr, line.offset.stderr / (2 * read)
    pixels = np.array([p.pixels for p in levels])
    rest = float(np.average([p.variance for p in levels], weights=pixels) - step**2 / 12)
    slope = float(r.shot[c] * span) if r.shot else 1.0
    if dark < len(levels):
        # One level of light: shot noise of the stated gain, or else all of it, and the rest.
        level = float(np.average(signal, weights=pixels))
        slope = min(slope, max(rest, 0.0) / level) if r.shot else max(rest, 0.0) / level
        rest -= slope * level
    return slope, float(np.sqrt(max(rest, 1e-4 * step**2))), 0.0, 0.0


def _shortest_dark(stacks: list[Stack]) -> Stack | None:
    """The shortest dark that shows noise."""
    told = (s for s in stacks if s.recording.kind in DARK and len(s.contrasts))
    return min(told, key=lambda s: s.recording.exposure_s or 0.0, default=None)


def _shortest(stacks: list[Stack]) -> float:
    """Exposure of the shortest dark that shows noise, s; an unknown one is taken as none."""
    dark = _shortest_dark(stacks)
    return 0.0 if dark is None else dark.recording.exposure_s or 0.0


def _of_curve(stacks: list[Stack]) -> list[Stack]:
    """The recordings of the photon-transfer curve: beside light only the shortest darks, for the charge of
    long ones is drawn by warm pixels and follows a curve of its own."""
    if not any(s.recording.kind not in DARK and len(s.contrasts) for s in stacks):
        return stacks
    shortest = _shortest(stacks)
    return [
        s for s in stacks if s.recording.kind not in DARK or alike(s.recording.exposure_s or 0.0, shortest)
    ]


def _before_rounding(dark: Stack, levels: list[Level], black: np.ndarray) -> dict[int, tuple[float, float]]:
    """By channel, black level and read noise (DN) before rounding and clipping where these change them, see
    `physics.core.rounding`."""
    out = {}
    for p in levels:
        if _is_cut(p, black):
            out[p.channel] = _before_cut(dark, p)
        elif np.sqrt(p.variance) <= COARSE * dark.step:
            level, spread = level_and_spread(dark.mean[SITES[p.channel]], p.variance, dark.frames, dark.step)
            out[p.channel] = before_rounding(level, p.variance, dark.step, spread)
    return out


def _shared_by_rows(dark: list[Stack]) -> np.ndarray:
    """Variance that the rows of the darks share, mean of all darks, per channel, DN^2."""
    shared = [row_noise(s) for s in dark if len(s.contrasts)]
    return np.maximum(np.mean(shared, axis=0), 0.0) if shared else np.zeros(4)


def full_level(baseline: GroupBaseline) -> float:
    """Lowest signal at which the pixels are full, DN above black; infinite when none is."""
    return min((p.signal for p in baseline.levels if p.full), default=np.inf)


class Modelled(NamedTuple):
    """What the baseline says of one recording, DN and DN^2: expected may lie below black, signal does not."""

    expected: Float[np.ndarray, "h w"]
    signal: Float[np.ndarray, "h w"]
    variance: Float[np.ndarray, "h w"]


def modelled(stacked: Stack, baseline: GroupBaseline) -> Modelled:
    """Signal and variance of every pixel under the fitted baseline."""
    channel = channel_index(stacked.mean.shape)
    expected = expected_signal(stacked, baseline.black_level)
    signal = np.maximum(expected, 0)
    gain, read = baseline.gain[channel], baseline.read_noise[channel]
    return Modelled(expected, signal, gain * signal + read**2 + stacked.step**2 / 12)


def smooth_part(
    stacked: Stack, baseline: GroupBaseline, by: Modelled, clean: Float[np.ndarray, "h w"] | None
) -> Float[np.ndarray, "h w"] | None:
    """The mean that a fixed pattern is seen beside, DN; None for scenes without a reference of their own.
    clean: the recording's `reference`, where it has one."""
    recording, size = stacked.recording, stacked.mean.shape
    if recording.kind in DARK or recording.kind == "flat":
        return by.expected + mosaic_map(baseline.black_level, size)
    if clean is None or recording.reference == "burst_mean":
        return None
    steady = by.signal < 0.9 * full_level(baseline)
    return affine(stacked, clean, np.sqrt(by.variance), channel_index(size), steady)


def standardise(stacked: Stack, baseline: GroupBaseline, group: int) -> Fields:
    """The fields of one recording under the fitted baseline."""
    recording, size = stacked.recording, stacked.mean.shape
    channel = channel_index(size)
    by = modelled(stacked, baseline)
    signal, variance = by.signal, by.variance
    clean = None if recording.clean is None else reference(recording)
    smooth = smooth_part(stacked, baseline, by, clean)
    static = None if smooth is None else stacked.mean - smooth
    mean = signal + baseline.black_level[channel] if smooth is None else smooth
    if recording.kind in DARK:
        variance = own_variance(stacked, channel, variance, mean)
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
        name=recording.path or f"recording {stacked.number}",
        kind=recording.kind,
        frames=stacked.frames,
        number=stacked.number,
        group=group,
        exposure_s=recording.exposure_s,
        step=stacked.step,
        mean=mean.astype(np.float32),
        signal=signal.astype(np.float32),
        sigma=sigma,
        shot=(baseline.gain[channel] * signal / variance).astype(np.float32),
        usable=usable,
        contrasts=contrasts,
        static=None if static is None else (static * scaled).astype(np.float32),
        clean=clean,
        gain=baseline.gain,
        black=baseline.black_level,
        before=stacked.before,
    )


def most_variance(values: np.ndarray, freedom: int) -> float:
    """Variance of a pixel beyond which it is none of the others', of so many degrees of freedom."""
    middle = median(values) * freedom / stats.chi2.median(freedom)
    return float(stats.chi2.isf(1e-6, freedom) / freedom * max(middle, 1e-9))


def own_variance(stacked: Stack, channel: np.ndarray, modelled: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Darks are standardised by their own variance, in which rounding below a step and dark current are
    included: the temporal one, of a single frame that over the pixels."""
    out = modelled.copy()
    n = max(len(stacked.contrasts), 1)
    values = stacked.variance if len(stacked.contrasts) else (stacked.mean - mean) ** 2
    for c in range(4):
        # Of noise far below a step most pixels never move: one that changes by a code is no outlier.
        out[channel == c] = ordinary_variance(values[channel == c], n, stacked.step**2)
    return out


def ordinary_variance(values: np.ndarray, freedom: int, least: float = 0.0) -> float:
    """Mean variance of the pixels, without those that are far noisier than the others; least: variance that
    is no outlier."""
    kept = values[values < max(most_variance(values, freedom), least)]
    return max(float(kept.mean()) if kept.size else 0.0, 1e-6)
