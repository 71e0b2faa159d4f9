"""The black level that belongs to a flat: that of a dark as long as the flat, because dark charge raises it.

Where no dark is about as long, darks of three or more exposures give it by a straight line (dark current per
channel, EMVA 1288 release 4.0, section 7.1). Fewer cannot tell dark charge from black, and this is said.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import stats

from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.recordings.packing import site
from cannoise_jax.recordings.recording import DARK, PerChannel, Recording, per_channel

_SHORT_S = 0.1  # below it dark charge hardly matters
_ALIKE = 2.0  # times as long or as short: exposures that count as one
_KELVIN = 2.0  # by which darks and flats may differ


class Black(NamedTuple):
    """Black level at an exposure.

    level, error: DN per mosaic site, the standard error. seconds: the exposure it holds for; None: unknown.
    certain: whether the recordings tell it from dark charge. note: how it was come by, empty where it is
    measured at the exposure itself.
    """

    level: PerChannel
    error: PerChannel
    seconds: float | None
    certain: bool
    note: str


def reference_dark(statistics: Sequence[FrameStatistics]) -> FrameStatistics | None:
    """The dark that goes with the flats: nearest exposure, then most frames; without flats the shortest.

    Of darks of unknown exposures it is the darkest.
    """
    return _nearest(statistics, flat_seconds(statistics))


def flat_seconds(statistics: Sequence[FrameStatistics]) -> float | None:
    """The exposure of the flats, the first that states one."""
    flats = (s.recording.exposure_s for s in statistics if s.recording.kind == "flat")
    return next((seconds for seconds in flats if seconds), None)


def black_level(statistics: Sequence[FrameStatistics]) -> Black:
    """The black level at the exposure of the flats, or of the shortest dark where there are none."""
    flats = (s.recording.temperature_c for s in statistics if s.recording.kind == "flat")
    return black_at(statistics, flat_seconds(statistics), next(flats, None))


def black_at(
    statistics: Sequence[FrameStatistics], seconds: float | None, temperature_c: float | None = None
) -> Black:
    """Black level at an exposure, from the darks among `statistics` (of one ISO), or as the recordings state
    it where there are none. temperature_c: of the flat; only darks about as warm count, where both are known.
    """
    darks = [s for s in statistics if s.recording.kind in DARK]
    dark = _nearest(darks, seconds)
    if dark is None:
        return Black(statistics[0].recording.black_level, (0.0,) * 4, seconds, True, "")
    own = _seconds(dark.recording)
    level, error = per_channel(dark.frame_means.mean(0)), _errors(dark)
    if seconds is None or own is None or alike(own, seconds):
        return Black(level, error, own, True, "")
    series = [s for s in darks if _seconds(s.recording) is not None and _as_warm(s, temperature_c)]
    times = sorted({_seconds(s.recording) or 0.0 for s in series})
    if len(times) >= 3:
        level, error = _extended(series, seconds)
        span = f"{times[0]:g} to {times[-1]:g} s"
        return Black(
            level,
            error,
            seconds,
            True,
            f"at the {seconds:g} s of the flats, by a line through darks of {span}",
        )
    return Black(
        level, error, own, False,
        f"of flats at {seconds:g} s taken from a dark of {own:g} s, whose dark charge counts as black: "
        f"record a dark at {seconds:g} s",
    )  # fmt: skip


def alike(first_s: float, second_s: float) -> bool:
    """Whether dark charge is about the same, or hardly matters, at two exposures."""
    first, second = max(first_s, _SHORT_S), max(second_s, _SHORT_S)
    return max(first, second) <= _ALIKE * min(first, second)


def mean_error(s: FrameStatistics, channel: int) -> float:
    """Error of a channel's mean over a recording: from the pixels' noise, or from the scatter of the frames
    where that is significantly larger (chi-square at 99.9 %)."""
    frames = s.frame_means[:, channel]
    pixel = 0.0 if s.total is None else float(site(s.total, channel).mean()) / site(s.mean, channel).size
    if len(frames) < 2:
        return max(np.sqrt(pixel), 1e-6)
    scatter, dof = float(frames.var(ddof=1)), len(frames) - 1
    larger = scatter > pixel * stats.chi2.isf(1e-3, dof) / dof
    return float(np.sqrt((scatter if larger else pixel) / len(frames)))


def _nearest(statistics: Sequence[FrameStatistics], aim: float | None) -> FrameStatistics | None:
    repeated = [s for s in statistics if s.recording.kind in DARK and s.recording.count > 1]

    def distance(s: FrameStatistics) -> tuple[float, float, int]:
        exposure = s.recording.exposure_s
        if exposure is None or exposure <= 0:
            # Of darks of unknown exposures the darkest has the least dark charge.
            bias = s.recording.kind == "bias"
            return 0.0 if bias else 1.0, 0.0 if bias else float(s.frame_means.mean()), -s.recording.count
        # Below a tenth of a second the number of frames counts more.
        away = np.log10(max(exposure, _SHORT_S)) - np.log10(max(aim or _SHORT_S, _SHORT_S))
        return abs(float(away)), 0.0, -s.recording.count

    return min(repeated, key=distance, default=None)


def _seconds(recording: Recording) -> float | None:
    """The exposure of a dark; a bias frame has none to speak of."""
    if recording.exposure_s is None and recording.kind == "bias":
        return 0.0
    return recording.exposure_s


def _as_warm(s: FrameStatistics, temperature_c: float | None) -> bool:
    own = s.recording.temperature_c
    return own is None or temperature_c is None or abs(own - temperature_c) <= _KELVIN


def _errors(s: FrameStatistics) -> PerChannel:
    return per_channel(np.array([mean_error(s, c) for c in range(4)]))


def _extended(series: Sequence[FrameStatistics], seconds: float) -> tuple[PerChannel, PerChannel]:
    """Means of darks at another exposure by a weighted straight line; its error grows with their scatter
    about it where that is significant (chi-square at 99 %)."""
    times = np.array([_seconds(s.recording) or 0.0 for s in series]) - seconds
    design = np.stack([np.ones_like(times), times], -1)
    levels: Float[np.ndarray, "n 4"] = np.array([s.frame_means.mean(0) for s in series])
    values, errors = np.empty(4), np.empty(4)
    for c in range(4):
        # A code's rounding is even over the noise of pixels, but no mean is surer than a thousandth of a DN.
        sigma = np.array([max(mean_error(s, c), 1e-3) for s in series])
        covariance = np.linalg.inv((design / sigma[:, None] ** 2).T @ design)
        line = covariance @ (design.T @ (levels[:, c] / sigma**2))
        square, dof = float(np.sum(((levels[:, c] - design @ line) / sigma) ** 2)), len(times) - 2
        larger = square / dof if square > stats.chi2.isf(0.01, dof) else 1.0
        values[c], errors[c] = line[0], np.sqrt(covariance[0, 0] * larger)
    return per_channel(values), per_channel(errors)
