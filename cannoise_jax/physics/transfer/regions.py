"""Whether a sensor is one all over the frame: amplifiers of their own have another noise and another gain
each, and what their pixels do would be taken for that of single pixels or columns."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import stats

from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.fit import median_quotient
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.recordings.packing import SITES

_GRID = 4
"""Regions along either side."""
_FEWEST = 64
"""Pixels of a region whose median variance means anything."""
_UNEVEN = 1.5
"""Ratio of variances from which regions are unlike: of seven real cameras they differ by 1.15 at most, the
two amplifiers of one frame by twice to four times."""
_SIGMAS = 6.0
"""Standard errors by which they have to differ beyond that."""
_CLIPPED = 0.05
"""Share of the variances of a part, on either side, that count as no further out."""
_BESIDE = 8
"""Columns, or rows, of one colour on either side of the middle that tell a step there."""
_DEGREE = 4
"""Of the polynomial that the light along a side is taken for, so that its slope is no step."""
_FRAMES, _BY_CHANCE = 4, 1e-6
"""Frames that tell whether halves move, and the chance of as large a step in the middle of them."""
_BANDS, _PART = 4, 0.3
"""Of rows, or columns, that show a step between amplifiers each by itself, and of it what each shows at
least: vignetted light leans in all of them."""
_STEP, _OTHERS = 0.01, 8.0
"""Of the light, the step from which two halves have gains of their own, and times the usual step elsewhere:
light is smooth, and columns differ all over the frame."""


def uneven_noise(dark: FrameStatistics) -> str:
    """Between which values the temporal noise of the parts of a repeated dark lies; empty where it is one.
    Parts that are dead do not count. Of variances with two modes, as of pixels that jumped in some frames and
    those that did not, a median may be of either: means of parts have to differ as much."""
    if dark.variance is None:
        return ""
    variance = dark.variance if dark.dead is None else np.where(dark.dead, np.nan, dark.variance)
    rows, columns = (np.array_split(np.arange(n), _GRID) for n in variance.shape)
    parts = [variance[np.ix_(r, c)] for r in rows for c in columns]
    parts = [alive for part in parts if (alive := part[np.isfinite(part)]).size >= _FEWEST]
    if len(parts) < 2:
        return ""
    below, medians, above = np.array([_median(part) for part in parts]).T
    least = dark.code_step**2 / 12
    if below.max() <= _UNEVEN * max(above.min(), least):
        return ""
    means = [np.clip(part, *np.quantile(part, (_CLIPPED, 1 - _CLIPPED))).mean() for part in parts]
    if max(means) <= _UNEVEN * max(min(means), least):
        return ""
    low, high = np.sqrt(np.array([medians.min(), medians.max()]) / median_quotient(dark.dof))
    return (
        f"the noise of the dark differs between parts of the frame ({low:.3g} to {high:.3g} DN), as of "
        "amplifiers of their own: calibrate each part by itself (where it is a glow: record shorter darks)"
    )


def _median(values: Float[np.ndarray, "n"]) -> tuple[float, float, float]:
    """The median with ends that it lies between whatever the law of the values: the number of them below it
    is binomial. Two such intervals are apart by `_SIGMAS` standard errors of a difference."""
    ordered, n = np.sort(values), values.size
    away = int(np.ceil(_SIGMAS / np.sqrt(2) * np.sqrt(n) / 2))
    low, high = max(n // 2 - away, 0), min(n // 2 + away, n - 1)
    return float(ordered[low]), float(median(values)), float(ordered[high])


def drifting_halves(dark: FrameStatistics | None) -> str:
    """That the halves of a repeated dark move against each other from frame to frame, as the offsets of two
    amplifiers do; empty where they do not. What columns do each by itself steps as much elsewhere."""
    if dark is None or dark.variance is None or dark.recording.count < _FRAMES:
        return ""
    columns = dark.column_means.mean(1)
    columns = columns - columns.mean(0)
    if columns.shape[1] < 6 * _BESIDE:
        return ""
    sums = np.cumsum(np.pad(columns, ((0, 0), (1, 0))), axis=1)
    means = (sums[:, _BESIDE:] - sums[:, :-_BESIDE]) / _BESIDE
    power = np.mean((means[:, _BESIDE:] - means[:, :-_BESIDE]) ** 2, axis=0)
    dof, at = dark.recording.count - 1, columns.shape[1] // 2 - _BESIDE
    away = np.abs(np.arange(len(power)) - at) > _BESIDE
    usual = float(median(power[away])) / median_quotient(dof)
    if power[at] < stats.chi2.isf(_BY_CHANCE, dof) / dof * usual or power[at] < power[away].max():
        return ""
    half = columns.shape[1] // 2
    moves = float(np.std(columns[:, half:].mean(1) - columns[:, :half].mean(1), ddof=1))
    return (
        f"the halves of the darks, left and right, move against each other by {moves:.2g} DN from frame to "
        "frame, as of two amplifiers: noise that pixels share is not told beside that: calibrate each half "
        "by itself"
    )


def uneven_halves(flat: FrameStatistics | None, dark: FrameStatistics | None) -> str:
    """That the light of a flat steps in the very middle of the frame, as two amplifiers of unlike gains make
    it; empty where it does not."""
    if flat is None or dark is None or flat.mean.shape != dark.mean.shape:
        return ""
    light = flat.mean - dark.mean
    for lines, axis in (("columns", 0), ("rows", 1)):
        steps = [found for site in SITES if (found := _middle_step(median(light[site], axis=axis)))]
        if len(steps) == len(SITES) and min(steps) * max(steps) > 0 and _all_along(light, axis, min(steps)):
            half = light.shape[1 - axis] // 2
            return (
                f"the light of {flat.recording.path or 'the flats'} steps by {100 * np.mean(steps):+.2g} % "
                f"from {lines[:-1]} {half} to {half + 1}, in the middle of the frame, as of two amplifiers: "
                "gain, and what differs between pixels, are those of both: calibrate each half by itself"
            )
    return ""


def _all_along(light: Float[np.ndarray, "h w"], axis: int, step: float) -> bool:
    """Whether the light steps to the same side in every band of rows (axis 0) or columns, as amplifiers make
    it do: shadows of dust in the middle do so over a part of it."""
    for band in np.array_split(np.arange(light.shape[axis] // 2 * 2), _BANDS):
        profile = median(np.take(light, band, axis), axis=axis)
        middle = len(profile) // 2
        left, right = (
            float(median(profile[middle + a : middle + b])) for a, b in ((-_BESIDE, 0), (0, _BESIDE))
        )
        if (right / max(left, 1e-9) - 1) * np.sign(step) < _PART * abs(step):
            return False
    return True


def _middle_step(profile: Float[np.ndarray, "n"]) -> float:
    """Share of the light by which a profile steps in its middle; 0 where it does not stand out of the steps
    elsewhere."""
    beside = min(_BESIDE, len(profile) // 6)
    if beside < 3:
        return 0.0
    place = np.linspace(-1, 1, len(profile))
    upper = (np.arange(len(profile)) >= len(profile) // 2)[:, None]
    terms = np.concatenate([np.polynomial.legendre.legvander(place, _DEGREE), upper], 1)
    found = np.linalg.lstsq(terms, profile, rcond=None)[0]
    # What is left is of the step, and of light that is no polynomial, which does not step in a few columns.
    sums = np.convolve(profile - terms[:, :-1] @ found[:-1], np.ones(beside) / beside, "valid")
    steps = sums[beside:] - sums[:-beside]
    at = len(profile) // 2 - beside
    step = float(steps[at])
    away = np.abs(np.arange(len(steps)) - at) >= beside
    usual = float(median(np.abs(steps[away])))
    share = step / max(float(median(profile)), 1e-9)
    return share if abs(share) > _STEP and abs(step) > _OTHERS * usual else 0.0
