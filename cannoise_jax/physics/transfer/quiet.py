"""Temporal noise of darks that are quieter than a code, told from what rounding leaves of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import special

from cannoise_jax.physics.core.rounding import COARSE, before_rounding, level_and_spread
from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.estimate import Estimate, normal_estimate
from cannoise_jax.physics.transfer.fit import robust_mean_square
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.rails import is_cut_off
from cannoise_jax.physics.transfer.views import pixel_variance, with_all_sites
from cannoise_jax.recordings.codes import code_histograms
from cannoise_jax.recordings.packing import ALL, site
from cannoise_jax.recordings.recording import DARK, per_channel

BELOW_A_CODE = (
    "the noise of the darks is so far below a code that rounding hides it: record darks and flats at a "
    "higher gain, or flats of several levels"
)
PATTERN_BELOW_A_CODE = (
    "the noise of the darks is so far below a code that rounding hides their fixed pattern: record darks and "
    "flats at a higher gain"
)
TOO_FEW_CODES = "the noise spans too few codes: record darks at a higher gain"
_HALF = 0.5
"""Noise, codes, from which the variance of a pixel depends on its place between codes by less than 3 %."""
_DITHERED = 0.2
"""Variance v of noise and pattern together, codes squared, from which rounded means follow an offset to
within 4 %, 2 exp(-2 pi^2 v). A smaller one does not show: half of the values at the next code are of one
sixth whatever the noise."""
_OTHERS = 0.01
"""Share of the values of darks at two neighbouring codes that may be elsewhere: hits and hot pixels are."""
_TOLD = 10
"""Values at the codes beside those two from which they tell the noise to some percent, if they are three
times those at the next: hits and hot pixels fill all alike."""
_SPARSE = 0.3
"""Temporal variance, codes squared, below which the variances of single pixels are mostly 0 or of few kinds,
so that outliers among them are told by their size."""
_TWO_CODES = 4.5
"""Over the number of frames, the variance of a pixel that lies two codes away in one of them, 4 of it, with
what the mean of its row adds: of noise of a third of a code two frames in 70 pairs do."""
_STILL = 1e-3
"""Temporal variance of pixels that never change, codes squared: that of the frame's mean, which is taken
out."""
_UNSEEN = 3.0
"""Values expected at a code where none is, with a chance of 5 %."""


class QuietNoise(NamedTuple):
    """read: temporal noise before rounding, DN. square: the temporal variance of what is stored, DN^2. level:
    mean before rounding, DN."""

    read: Estimate
    square: float
    level: Estimate


def noise_below_a_code(dark: FrameStatistics, step: float, c: int) -> QuietNoise | None:
    """The noise of darks that are quieter than about a code, None of others: what rounds to their variance at
    the levels of these pixels; that variance less step^2 / 12 is something else."""
    hidden = hidden_in_a_code(dark, step, c)
    if dark.variance is None or loses_noise(dark, step, c):
        return None
    square, stderr = square_below_a_code(pixel_variance(dark, c), dark.dof, step)
    if not hidden and not 0 < square < (COARSE**2 + 1 / 12) * step**2:
        return None
    if (at_two := _at_two_codes(dark, step, c)) is not None:
        top, level = at_two
        return QuietNoise(Estimate(0.5 * top, top / np.sqrt(12), (0.0, top)), square, level)
    origin = _origin(dark, step)
    mean, spread = level_and_spread(site(dark.mean, c) - origin, square, dark.recording.count, step)
    found = [
        before_rounding(mean, max(v, 1e-6 * step**2), step, spread)
        for v in (square, square - stderr, square + stderr)
    ]
    level, read = (
        normal_estimate(value, 0.5 * abs(high - low)) for value, low, high in zip(*found, strict=True)
    )
    return QuietNoise(read, square, level.shifted(origin))


def _origin(dark: FrameStatistics, step: float) -> float:
    """How far above a multiple of their spacing the codes of a dark lie, DN: those of a table anywhere."""
    if dark.spacing is None or step <= 1:
        return 0.0
    codes = dark.spacing.codes
    return float(codes[np.argmin(np.abs(codes - median(dark.mean)))] % step)


def with_rounding_told(s: FrameStatistics) -> FrameStatistics:
    """A dark with what rounding adds to its means, where noise of less than half a code makes that matter:
    light that lifts the values off that place between two codes does not add it."""
    if s.recording.kind not in DARK or not coarse(s):
        return s
    means = s.frame_means.mean(0)
    if s.recording.cfa == "MONO":  # of which one read noise is told, of all sites
        own = noise_below_a_code(with_all_sites(s), step_of(s), ALL)
        found, means = [own] * 4, np.full(4, means.mean())
    else:
        found = [noise_below_a_code(s, step_of(s), c) for c in range(4)]
    added = [0.0 if q is None else float(m - q.level.value) for m, q in zip(means, found, strict=True)]
    errors = [0.0 if q is None else q.level.stderr for q in found]
    return replace(s, rounded=(per_channel(np.array(added)), per_channel(np.array(errors))))


def _at_two_codes(dark: FrameStatistics, step: float, c: int) -> tuple[float, Estimate] | None:
    """The most that the noise of darks at one code or two neighbours can be, DN, and their level before
    rounding; None of others. They tell the share of the upper code alone: of level l and noise s only
    (l - edge) / s, of any s up to where a third code shows."""
    counts = code_histograms(dark.recording.frames)
    counts = np.pad(counts.sum(0) if c == ALL else counts[c], 3 * int(step))
    first = int(np.argmax(counts)) % int(step)
    codes = counts[first :: int(step)]
    at = int(np.argmax(codes[:-1] + codes[1:]))
    lower, upper = (int(v) for v in codes[at : at + 2])
    third, fourth = (int(codes[at - k] + codes[at + 1 + k]) for k in (1, 2))
    number = int(counts.sum())
    others = number - lower - upper
    if others > _OTHERS * number or third > max(_TOLD, 3 * fourth):
        return None
    seen = -float(special.ndtri((third + _UNSEEN * (1 + np.sqrt(third))) / number))
    low = float(first - 3 * int(step) + at * int(step))
    if not lower or not upper:  # the level lies half a code from either edge at best
        level = low if lower else low + step
        half = 0.5 * step
        return half / seen, Estimate(level, step / np.sqrt(12), (level - half, level + half))
    # The edge between both lies `away` deviations from the level; the next, a code further, is not reached.
    above = float(special.ndtri(upper / (lower + upper)))
    top, edge = step / (seen + abs(above)), low + 0.5 * step
    ends = sorted((edge, edge + above * top))
    level = edge + 0.5 * above * top
    return top, Estimate(level, abs(above) * top / np.sqrt(12), (ends[0], ends[1]))


def square_below_a_code(variance: Float[np.ndarray, "h w"], dof: float, step: float) -> tuple[float, float]:
    """Mean of the temporal variances of pixels, DN^2, and its error. Where most hardly ever change code,
    those that do are no outliers, by two codes in one of few frames neither."""
    square, keep = robust_mean_square(variance, dof)
    kept = variance[keep]
    if square < _SPARSE * step**2:
        kept = variance[variance < max(1.0, _TWO_CODES / (dof + 1)) * step**2]
        square = float(kept.mean())
    return square, float(kept.std() / np.sqrt(kept.size))


def mean_square_of(dark: FrameStatistics, c: int) -> tuple[float, float]:
    """Temporal variance of one channel, DN^2, and its error."""
    variance = pixel_variance(dark, c)
    square, keep = robust_mean_square(variance, dark.dof)
    return square, float(variance[keep].std() / np.sqrt(keep.sum()))


def unchanging(dark: FrameStatistics) -> bool:
    """Whether the frames of a dark are one, several times, or most of its pixels at one code in all of them:
    then what changes from frame to frame shows in the few others alone."""
    if dark.total is None:
        return False
    if not np.any(dark.total):
        return True
    still = dark.total < _STILL * step_of(dark) ** 2
    return bool(np.mean(still & (dark.mean == median(dark.mean))) > 0.5)


def coarse(dark: FrameStatistics) -> str:
    """Why the noise of single pixels does not show in a repeated dark: it is below half a code, so that it
    depends on how near to the next code each pixel is; empty where it is not."""
    if dark.variance is None:
        return ""
    squares = [square_below_a_code(pixel_variance(dark, c), dark.dof, step_of(dark))[0] for c in range(4)]
    quiet = float(np.mean(squares)) < (_HALF**2 + 1 / 12) * step_of(dark) ** 2
    return TOO_FEW_CODES if quiet else ""


def pattern_below_a_code(dark: FrameStatistics) -> str:
    """Why a fixed pattern does not show in a repeated dark: it and the noise are so far below a code that
    rounding makes another of it; empty where they are not."""
    if dark.variance is None or not coarse(dark):
        return ""
    return "" if all(dither(dark, c) for c in range(4)) else PATTERN_BELOW_A_CODE


def unseen_offsets(darks: Sequence[FrameStatistics]) -> float:
    """Variance that the fixed offsets of pixels may have where no repeated dark shows them, DN^2; 0 where one
    does, or none is given."""
    repeated = [s for s in darks if s.variance is not None]
    if not repeated or not all(pattern_below_a_code(s) for s in repeated):
        return 0.0
    return _DITHERED * max(step_of(s) for s in repeated) ** 2


def dither(s: FrameStatistics, c: int) -> float:
    """Variance of what rounding sees of one channel, codes squared: noise and offsets of its pixels, without
    those four codes away. 0 where it is too little to be told from what is stored."""
    step, mean = step_of(s), site(s.mean, c)
    offsets = float(mean[np.abs(mean - median(mean)) < 4 * step].var())
    square, _ = square_below_a_code(pixel_variance(s, c), s.dof, step)
    found = (square * (1 - 1 / s.recording.count) + offsets) / step**2 - 1 / 12
    return found if found > _DITHERED else 0.0


def rounding_of_offsets(s: FrameStatistics, c: int) -> float:
    """Variance that rounding adds to the mean of each pixel, DN^2, where offsets are spread over codes:
    step^2 / (2 pi^2) sum exp(-4 pi^2 k^2 v) / k^2 of a temporal noise of v codes squared; none of noise of a
    code and more."""
    step = step_of(s)
    quiet = noise_below_a_code(s, step, c)
    if quiet is None:
        return 0.0
    k = np.arange(1, 64)
    noise = 4 * np.pi**2 * (quiet.read.value / step) ** 2
    return step**2 / (2 * np.pi**2) * float(np.sum(np.exp(-noise * k**2) / k**2))


def step_of(s: FrameStatistics) -> float:
    """Spacing of the codes of a recording, DN; 1 where they are too few to show it."""
    return max(s.code_step, 1.0)


def loses_noise(dark: FrameStatistics, step: float, c: int) -> bool:
    """Whether the lower end of its noise is cut off, and not a noise of less than a code piled up there."""
    return is_cut_off(dark, c) and not hidden_in_a_code(dark, step, c)


def hidden_in_a_code(dark: FrameStatistics, step: float, c: int) -> bool:
    """Whether most values are at one code, above 0, and the others at most at the next: noise of less than a
    code, which looks like values that pile up there."""
    if dark.variance is None or not is_cut_off(dark, c) or dark.low[c] <= 0:
        return False
    return bool(np.quantile(pixel_variance(dark, c), 0.99) < step**2)
