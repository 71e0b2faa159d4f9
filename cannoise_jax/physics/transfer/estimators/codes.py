"""The lattice of stored codes and its ends, and offsets of channels and amplifiers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int
from scipy import stats

from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.black import black_level, reference_dark
from cannoise_jax.physics.transfer.estimate import (
    Z90,
    Estimate,
    Estimates,
    NotMeasurable,
    normal_estimate,
    scatter_estimate,
)
from cannoise_jax.physics.transfer.estimators.pick import column_offsets, darkest, repeated_darks
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.lost_bit import lost_bit
from cannoise_jax.recordings.codes import code_histogram, code_lattice, share_above

_POPULATED = 50  # counts on both sides that make an empty code a missing one
_RUN = 10
"""Gaps in a row whose median tells how far apart codes lie there."""
_BESIDE = 3.0
"""Of the median gap, up to which two codes are neighbours."""


def quantization(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """step_dn of the codes; exact, so its interval has no width."""
    steps = [s.code_step for s in statistics if s.code_step > 0]
    if not steps:
        return NotMeasurable("the codes lie on no lattice: record more frames at several levels")
    return {"step_dn": _exact(min(steps))}


def missing_codes(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """period: median distance in code steps of codes that never occur between populated ones; phase: which
    of them; above: share of their values that the next code has; exact. Codes of a table or a digital gain
    lie further apart everywhere, or in a part of the range: no code of a converter is missing then."""
    if why := lost_bit(statistics):
        return NotMeasurable(why)
    histogram = np.sum([code_histogram(s.recording.frames) for s in statistics], axis=0)
    if why := spread_apart(histogram):
        return NotMeasurable(why, answered=True)
    step = int(min((s.code_step for s in statistics if s.code_step > 0), default=0))
    if not step:
        return NotMeasurable("the codes lie on no lattice: record more frames at several levels")
    codes = np.flatnonzero(histogram)
    counts = histogram[np.arange(codes[0], codes[-1] + 1, step)]
    around = np.minimum(np.roll(counts, 1), np.roll(counts, -1))
    missing = np.flatnonzero((counts == 0) & (around >= _POPULATED))
    missing = missing[(missing > 0) & (missing < len(counts) - 1)]
    if len(missing) < 2:
        populated = int(np.sum(counts >= _POPULATED))
        return NotMeasurable(f"no missing codes among {populated} well-populated ones", answered=True)
    period, index = int(median(np.diff(missing))), codes[0] // step + np.arange(len(counts))
    phase = int(np.bincount(index[missing] % period).argmax())
    found = {"period": period, "phase": phase, "above": share_above(index, counts, period, phase)}
    return {name: _exact(float(value)) for name, value in found.items()}


def spread_apart(histogram: Int[np.ndarray, "65536"]) -> str:
    """How codes lie further apart than their step where a table or a digital gain made them; empty where they
    do not. Where codes are well populated a gap is none of sparse light."""
    codes = np.flatnonzero(histogram)
    crowded = histogram[codes] >= _POPULATED
    gaps = np.diff(codes)[crowded[1:] & crowded[:-1]] / max(code_lattice(histogram).step, 1.0)
    # Between levels of the light nothing is recorded.
    wide = gaps[gaps <= _BESIDE * median(gaps)] if len(gaps) else gaps
    parts = [p for p in np.array_split(gaps, max(len(gaps) // _RUN, 1)) if len(p)]
    usual = [int(median(p)) for p in parts]
    if len(wide) < _RUN or max(usual) < 2 or (len(set(usual)) == 1 and len(set(wide.tolist())) == 1):
        return ""
    low, high = min(usual), max(usual)
    apart = f"{low}" if low == high else f"{low} to {high}"
    return f"codes lie {apart} steps apart, as of a table or a digital gain: none of a converter is missing"


def joined_codes(histogram: Int[np.ndarray, "65536"], step: int) -> Int[np.ndarray, "65536"] | None:
    """For every code the one it has where those that are populated lie one step apart, as they did before a
    digital gain; None where they lie so anyway, outliers apart."""
    crowded = np.flatnonzero(histogram >= _POPULATED)
    if len(crowded) < 2:
        return None
    low, high = int(crowded[0]), int(crowded[-1])
    used = low + np.flatnonzero(histogram[low : high + 1])
    gaps = np.diff(used)
    if not np.any((gaps > step) & (np.minimum(histogram[used[1:]], histogram[used[:-1]]) >= _POPULATED)):
        return None
    out = np.arange(len(histogram))
    joined = low + step * np.arange(len(used))
    out[low : high + 1] = np.interp(out[low : high + 1], used, joined)
    out[high + 1 :] -= high - int(joined[-1])
    return out


def black_clipping(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """level_dn: the code at which darks pile up, above the black level; known to half a code step."""
    dark = darkest(statistics)
    if dark is None:
        return repeated_darks(statistics)
    ends = [
        low - black
        for low, black in zip(dark.low, dark.recording.black_level, strict=True)
        if np.isfinite(low)
    ]
    if not ends:
        return NotMeasurable("darks are not cut off: no values pile up at their lower end", answered=True)
    half = max(dark.code_step, 1.0) / 2
    value = float(np.mean(ends))
    return {"level_dn": Estimate(value, half / np.sqrt(3), (value - half, value + half))}


def black_level_errors(statistics: Sequence[FrameStatistics]) -> tuple[Estimate, ...] | NotMeasurable:
    """True minus stated black level of each mosaic site, DN, from the means of darks frame by frame: what all
    pixels of a frame do together is in the errors. Of the exposure of the flats, see `transfer.black`."""
    dark, black = reference_dark(statistics), black_level(statistics)
    if dark is None:
        return repeated_darks(statistics)
    if not black.certain:
        return NotMeasurable(f"black level {black.note}")
    if np.isfinite(dark.low).any():
        return NotMeasurable(
            "darks are cut off at their lower end: record with a black level above the noise"
        )
    stated = np.asarray(dark.recording.black_level)
    if black.note or dark.rounded is not None:  # darks are longer than the flats, or rounded to one code
        found = zip(np.subtract(black.level, stated), black.error, strict=True)
        return tuple(normal_estimate(value, error) for value, error in found)
    offsets = dark.frame_means - stated
    return tuple(scatter_estimate(offsets[:, c]) for c in range(4))


def bookkeeping(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """black_dn: mean over the channels of true minus stated black level, from darks. white_error: only where
    a recording saturates, of the code at which its values pile up; known to half a code step."""
    errors = black_level_errors(statistics)
    dark, black = reference_dark(statistics), black_level(statistics)
    if isinstance(errors, NotMeasurable) or dark is None:
        return errors if isinstance(errors, NotMeasurable) else repeated_darks(statistics)
    stated = np.asarray(dark.recording.black_level)
    found = {"black_dn": scatter_estimate((dark.frame_means - stated).mean(1))}
    if black.note or dark.rounded is not None:
        found["black_dn"] = normal_estimate(
            float(np.mean([e.value for e in errors])), float(np.mean(black.error))
        )
    tops = [(float(np.nanmax(s.high)), s) for s in statistics if np.isfinite(s.high).any()]
    if tops:
        code, saturated = max(tops, key=lambda top: top[0])
        step = max(saturated.code_step, 1.0)
        # The stated level may lie between two codes: a white pixel then holds the lower one.
        highest = np.floor(saturated.recording.white_level / step) * step
        span, half = float(highest - stated.mean()), step / 2
        value = (code - found["black_dn"].value - float(stated.mean())) / span - 1
        stderr = float(np.hypot(half / np.sqrt(3), found["black_dn"].stderr)) / span
        reach = (half + Z90 * found["black_dn"].stderr) / span
        found["white_error"] = Estimate(value, stderr, (value - reach, value + reach))
    return found


def channel_offset(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """sigma_dn: rms of the four channels' errors of the stated black level. Of a population of cameras four
    values are known, so the interval is that of chi-square with four degrees of freedom."""
    dark, black = reference_dark(statistics), black_level(statistics)
    if dark is None:
        return repeated_darks(statistics)
    if not black.certain:
        return NotMeasurable(f"black level {black.note}")
    offsets = np.subtract(black.level, dark.recording.black_level)
    noise = float(np.mean(np.square(black.error)))
    square = max(float(np.mean(offsets**2)) - noise, 0.0)
    low, high = 4 / stats.chi2.ppf((0.95, 0.05), 4)
    sigma = float(np.sqrt(square))
    return {
        "sigma_dn": Estimate(
            sigma, sigma / np.sqrt(8), (sigma * float(np.sqrt(low)), sigma * float(np.sqrt(high)))
        )
    }


def amplifier_mismatch(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """step_dn: offset of the right half of the frame less that of the left, in the average of the darks."""
    dark = darkest(statistics)
    if dark is None:
        return repeated_darks(statistics)
    columns = column_offsets(dark).mean(0)
    middle = len(columns) // 2
    left, right = columns[:middle], columns[middle:]
    error = np.sqrt(left.var(ddof=1) / len(left) + right.var(ddof=1) / len(right))
    return {"step_dn": normal_estimate(float(right.mean() - left.mean()), float(error), len(columns) - 2)}


def _exact(value: float) -> Estimate:
    return Estimate(float(value), 0.0, (float(value), float(value)))
