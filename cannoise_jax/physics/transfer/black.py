"""The black level that belongs to a flat: that of darks as long as the flat, because dark charge raises it.

EMVA 1288 release 4.0, section 6.3, takes the mean and the variance of every flat less those of darks of its
own exposure. Where no dark is as long, those next to it in exposure give both by a straight line (section
7.1); beyond the darks it takes three exposures. Fewer cannot tell dark charge from black, and this is said.
`of_one_dark` brings flats of many exposures above one dark, so that one black level and one read noise serve
all.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import stats

from cannoise_jax.physics.transfer.fit import robust_mean_square
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.views import less
from cannoise_jax.recordings.packing import site
from cannoise_jax.recordings.recording import DARK, PerChannel, Recording, mosaic_map, per_channel

_SHORT_S = 0.1
"""Exposures below it count as one where darks show no charge that grows in them."""
_SAME = 1.02
"""Ratio of exposures that are one: files round them."""
_ALIKE = 2.0
"""Ratio of exposures that count as one where nothing better is at hand."""
_KELVIN = 2.0
"""By which darks and flats may differ."""
_GROWN = 4.0
"""Standard errors by which short darks have to rise for their charge to count."""


class Black(NamedTuple):
    """Black level at an exposure.

    level, error: DN per mosaic site, the standard error. seconds: the exposure it holds for; None: unknown.
    certain: whether the recordings tell it from dark charge. note: how it was come by, empty where it is
    measured at the exposure itself. excess: variance of darks of that exposure beyond that of the reference
    dark, DN^2 per site; None where no dark near tells.
    """

    level: PerChannel
    error: PerChannel
    seconds: float | None
    certain: bool
    note: str
    excess: PerChannel | None = None


def reference_dark(statistics: Sequence[FrameStatistics]) -> FrameStatistics | None:
    """The dark whose noise is read noise: repeated, of the shortest exposure, a bias before all; then of most
    frames. Of darks of unknown exposures it is the darkest."""
    repeated = [s for s in statistics if s.recording.kind in DARK and s.recording.count > 1]
    least = _least_seconds(repeated)

    def order(s: FrameStatistics) -> tuple[bool, float, float, int]:
        seconds = _seconds(s.recording)
        if seconds is None:
            return True, 0.0, float(s.frame_means.mean()), -s.recording.count
        return False, max(seconds, least), 0.0, -s.recording.count

    return min(repeated, key=order, default=None)


def dark_like(
    flat: FrameStatistics, statistics: Sequence[FrameStatistics], reference: FrameStatistics
) -> FrameStatistics:
    """The repeated dark as long as a flat; the one given where none is, or the flat stands above that."""
    own = flat.recording.exposure_s if flat.dark_shot is None else None
    darks = [s for s in statistics if s.recording.kind in DARK and s.variance is not None]
    same = [
        s for s in darks if own and s.recording.exposure_s and as_long(s.recording.exposure_s, own, darks)
    ]
    return max(same, key=lambda s: s.recording.count, default=reference)


def flat_seconds(statistics: Sequence[FrameStatistics]) -> float | None:
    """The shortest exposure of the flats that any states."""
    flats = (s.recording.exposure_s for s in statistics if s.recording.kind == "flat")
    return min((seconds for seconds in flats if seconds), default=None)


def black_level(statistics: Sequence[FrameStatistics]) -> Black:
    """The black level of the reference dark; where it is longer than the flats that at the shortest of
    these."""
    dark = reference_dark(statistics)
    if dark is None:
        return Black(statistics[0].recording.black_level, (0.0,) * 4, None, True, "")
    flats = [s.recording for s in statistics if s.recording.kind == "flat" and s.recording.exposure_s]
    own = _seconds(dark.recording)
    at_reference = Black(per_channel(mean_level(dark)), _errors(dark), own, True, "")
    if not flats or own is None:
        return at_reference
    first = min(flats, key=lambda r: r.exposure_s or 0.0)
    black = black_at(statistics, first.exposure_s, first.temperature_c)
    shorter = (first.exposure_s or 0.0) * _SAME < own
    return black if shorter or not black.certain else at_reference


def of_one_dark(statistics: Sequence[FrameStatistics]) -> list[FrameStatistics]:
    """The statistics with every flat above the reference dark: its means less what darks of its own exposure
    have beyond that one, what they have in the variance stated beside it. Flats for which no dark near tells
    stay as they are."""
    dark = reference_dark(statistics)
    if dark is None or black_level(statistics).note:
        return list(statistics)
    level = mean_level(dark)
    out = []
    for s in statistics:
        own = s.recording
        if own.kind == "flat" and own.exposure_s and s.dark_shot is None:
            black = black_at(statistics, own.exposure_s, own.temperature_c)
            if black.certain and black.excess is not None:
                charge = mosaic_map(per_channel(np.asarray(black.level) - level), own.size)
                s = less(s, charge.astype(np.float64), dark_shot=black.excess)
        out.append(s)
    return out


def black_of(statistics: Sequence[FrameStatistics], flat: FrameStatistics) -> Black:
    """The black level that the means of a flat stand on: at its own exposure, or, once it stands above the
    reference dark (`of_one_dark`), of that one with the errors of both."""
    black = black_at(statistics, flat.recording.exposure_s, flat.recording.temperature_c)
    dark = reference_dark(statistics)
    if flat.dark_shot is None or dark is None:
        return black
    return black._replace(level=per_channel(mean_level(dark)))


def black_at(
    statistics: Sequence[FrameStatistics], seconds: float | None, temperature_c: float | None = None
) -> Black:
    """Black level at an exposure, from the darks among `statistics` (of one ISO), or as the recordings state
    it where there are none. temperature_c: of the flat; only darks about as warm count, where both are known.
    """
    darks = [s for s in statistics if s.recording.kind in DARK]
    dark = _nearest(darks, seconds)
    reference = reference_dark(darks)
    if dark is None or reference is None:
        return Black(statistics[0].recording.black_level, (0.0,) * 4, seconds, True, "")
    own = _seconds(dark.recording)
    near = Black(per_channel(mean_level(dark)), _errors(dark), own, True, "", _excess(dark, reference))
    if seconds is None or own is None or as_long(own, seconds, darks):
        return near
    series = [s for s in darks if _seconds(s.recording) is not None and _as_warm(s, temperature_c)]
    times = sorted({_seconds(s.recording) or 0.0 for s in series})
    span = f"{times[0]:g} to {times[-1]:g} s" if times else ""
    said = f"at the {seconds:g} s of the flats, by a line through darks of {span}"
    repeated = [s for s in series if s.variance is not None]
    between = _between(repeated, seconds)
    if between is not None:
        (low, high), weight = between
        parts = (1 - weight, low), (weight, high)
        level = sum(w * mean_level(s) for w, s in parts)
        error = np.sqrt(sum(np.square(w * np.asarray(_errors(s))) for w, s in parts))
        excess = sum(w * np.asarray(_excess(s, reference)) for w, s in parts)
        return Black(per_channel(level), per_channel(error), seconds, True, said, per_channel(excess))
    if len(times) >= 3:
        return Black(*_extended(series, seconds), seconds, True, said)
    if alike(own, seconds, _ALIKE, _SHORT_S):
        return near._replace(excess=None)
    return near._replace(
        certain=False, excess=None,
        note=f"of flats at {seconds:g} s taken from a dark of {own:g} s, whose dark charge counts as black: "
        f"record a dark at {seconds:g} s",
    )  # fmt: skip


def mean_level(dark: FrameStatistics) -> Float[np.ndarray, "4"]:
    """Mean of a dark before rounding, DN per site."""
    level = dark.frame_means.mean(0)
    return level if dark.rounded is None else level - np.asarray(dark.rounded[0])


def stand_in(statistics: Sequence[FrameStatistics]) -> tuple[float, float] | None:
    """The exposure of a flat and that of the dark, up to twice as long or short, that stands for one as long:
    the first of which that is so; None where darks tell the black level of all."""
    darks = [s for s in statistics if s.recording.kind in DARK]
    repeated = [s for s in darks if s.variance is not None]
    times = {t for s in darks if (t := _seconds(s.recording)) is not None}
    for seconds in sorted({s.recording.exposure_s or 0.0 for s in statistics if s.recording.kind == "flat"}):
        dark = _nearest(darks, seconds or None)
        own = None if dark is None else _seconds(dark.recording)
        if not seconds or own is None or len(times) >= 3 or _between(repeated, seconds):
            continue
        if not as_long(own, seconds, darks) and alike(own, seconds, _ALIKE, _SHORT_S):
            return seconds, own
    return None


def _excess(dark: FrameStatistics, reference: FrameStatistics) -> PerChannel | None:
    """Variance of the pixels of a dark beyond that of the reference dark, DN^2; each without pixels that are
    far noisier than the others."""
    if dark is reference:
        return (0.0,) * 4
    if dark.variance is None or reference.variance is None:
        return None
    parts = [
        [
            robust_mean_square(site(v, c), s.dof)[0]
            for s, v in ((dark, dark.variance), (reference, reference.variance))
        ]
        for c in range(4)
    ]
    return per_channel(np.array([one - other for one, other in parts]))


def _between(
    darks: Sequence[FrameStatistics], seconds: float
) -> tuple[tuple[FrameStatistics, FrameStatistics], float] | None:
    """The darks next to an exposure, of most frames among equals, and the weight of the longer one; None
    where it lies beyond all."""
    below = [s for s in darks if (_seconds(s.recording) or 0.0) < seconds]
    above = [s for s in darks if (_seconds(s.recording) or 0.0) > seconds]
    if not below or not above:
        return None
    low = max(below, key=lambda s: (_seconds(s.recording) or 0.0, s.recording.count))
    high = min(above, key=lambda s: (_seconds(s.recording) or 0.0, -s.recording.count))
    start, end = (_seconds(s.recording) or 0.0 for s in (low, high))
    return (low, high), (seconds - start) / (end - start)


def _least_seconds(darks: Sequence[FrameStatistics]) -> float:
    """The exposure below which darks hold no charge that matters: a tenth of a second, or none where darks
    within it rise with their exposure."""
    short = [
        s for s in darks if (seconds := _seconds(s.recording)) is not None and seconds <= _ALIKE * _SHORT_S
    ]
    if len(short) < 2:
        return _SHORT_S
    first, last = (pick(short, key=lambda s: _seconds(s.recording) or 0.0) for pick in (min, max))
    rise = mean_level(last) - mean_level(first)
    error = np.hypot(_errors(last), _errors(first))
    return 0.0 if float(np.mean(rise)) > _GROWN * float(np.sqrt(np.mean(error**2) / 4)) else _SHORT_S


def alike(first_s: float, second_s: float, ratio: float = _ALIKE, least: float = _SHORT_S) -> bool:
    """Whether dark charge is about the same, or hardly matters, at two exposures."""
    first, second = max(first_s, least), max(second_s, least)
    return max(first, second) <= ratio * min(first, second)


def as_long(first_s: float, second_s: float, darks: Sequence[FrameStatistics]) -> bool:
    """Whether a dark of one exposure is as long as a flat of another: as files round them, or both too short
    for the charge of these darks to matter."""
    return alike(first_s, second_s, _SAME, _least_seconds(darks))


def mean_error(s: FrameStatistics, channels: Sequence[int]) -> float:
    """Error of the mean of some channels over a recording: from the pixels' noise, or from the scatter of the
    frames where that is significantly larger (chi-square at 99.9 %)."""
    frames = s.frame_means[:, list(channels)].mean(1)
    noise = [0.0 if s.total is None else float(site(s.total, c).mean()) for c in channels]
    pixel = float(np.mean(noise)) / (site(s.mean, channels[0]).size * len(noise))
    if len(frames) < 2:
        return max(np.sqrt(pixel), 1e-6)
    scatter, dof = float(frames.var(ddof=1)), len(frames) - 1
    larger = scatter > pixel * stats.chi2.isf(1e-3, dof) / dof
    return float(np.sqrt((scatter if larger else pixel) / len(frames)))


def _nearest(statistics: Sequence[FrameStatistics], aim: float | None) -> FrameStatistics | None:
    """The repeated dark nearest to an exposure, then of most frames; of unknown ones the reference."""
    repeated = [s for s in statistics if s.recording.kind in DARK and s.recording.count > 1]
    known = [s for s in repeated if _seconds(s.recording) is not None]
    if aim is None or not known:
        return reference_dark(repeated)
    least = max(_least_seconds(known), 1e-9)

    def distance(s: FrameStatistics) -> tuple[float, int]:
        away = np.log(max(_seconds(s.recording) or 0.0, least) / max(aim, least))
        return round(abs(float(away)), 6), -s.recording.count

    return min(known, key=distance)


def _seconds(recording: Recording) -> float | None:
    """The exposure of a dark; a bias frame has none to speak of."""
    if recording.exposure_s is None and recording.kind == "bias":
        return 0.0
    return recording.exposure_s


def _as_warm(s: FrameStatistics, temperature_c: float | None) -> bool:
    own = s.recording.temperature_c
    return own is None or temperature_c is None or abs(own - temperature_c) <= _KELVIN


def _errors(s: FrameStatistics) -> PerChannel:
    errors = np.array([mean_error(s, [c]) for c in range(4)])
    return per_channel(errors if s.rounded is None else np.hypot(errors, s.rounded[1][:4]))


def _extended(series: Sequence[FrameStatistics], seconds: float) -> tuple[PerChannel, PerChannel]:
    """Means of darks at another exposure by a weighted straight line; its error grows with their scatter
    about it where that is significant (chi-square at 99 %)."""
    times = np.array([_seconds(s.recording) or 0.0 for s in series]) - seconds
    design = np.stack([np.ones_like(times), times], -1)
    levels: Float[np.ndarray, "n 4"] = np.array([mean_level(s) for s in series])
    values, errors = np.empty(4), np.empty(4)
    for c in range(4):
        # A code's rounding is even over the noise of pixels, but no mean is surer than a thousandth of a DN.
        sigma = np.array([max(mean_error(s, [c]), 1e-3) for s in series])
        covariance = np.linalg.inv((design / sigma[:, None] ** 2).T @ design)
        line = covariance @ (design.T @ (levels[:, c] / sigma**2))
        square, dof = float(np.sum(((levels[:, c] - design @ line) / sigma) ** 2)), len(times) - 2
        larger = square / dof if square > stats.chi2.isf(0.01, dof) else 1.0
        values[c], errors[c] = line[0], np.sqrt(covariance[0, 0] * larger)
    return per_channel(values), per_channel(errors)
