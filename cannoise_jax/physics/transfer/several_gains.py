"""Whether the flats of one setting have one gain: those of two settings that no file states have not."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.black import dark_like, reference_dark
from cannoise_jax.physics.transfer.fit import median_quotient
from cannoise_jax.physics.transfer.frames import FrameStatistics, of_variance
from cannoise_jax.physics.transfer.full_well import below_full, full_signal
from cannoise_jax.physics.transfer.rails import LINEAR, below_rail
from cannoise_jax.physics.transfer.smoothed import moving
from cannoise_jax.physics.transfer.views import dark_shot, pixel_variance
from cannoise_jax.recordings.packing import site

_RISES, _FALLS = 1.3, 1.8
"""Ratio of the gains of a brighter flat and of a dimmer one beyond which they are those of two settings. The
gain of one setting falls with the light where the response bends (by 1.4 at 0.7 of white that lacks 15 %) or
full pixels push charge away, but hardly rises: of ten flats of four real cameras by 1.07."""
_SIGMAS = 6.0
"""Standard errors by which they have to differ beyond that."""
_SYSTEMATIC = 0.02
"""Relative error of a gain besides that of its noise."""
_UNEVEN = 0.05
"""Logarithm of the ratio of gains from which their difference is worth saying."""
OF_TWO_OFFSETS = (
    "flats and darks are of two offsets (black levels), record both with one, or the response bends"
)
_GROWS = 0.6
"""Power of the signal with which shot noise (DN^2) grows from each flat to the next up to which values are
none of the light: raw ones have 1, a square root 0. Pixels that fill up have less in the brightest alone."""
_ENOUGH = 0.05
"""Share of the pixels of a flat that have to be below the rail."""


class _Gain(NamedTuple):
    """Gain of one flat by its own dark, DN/e-, its relative error, and its signal, DN. straight: whether it
    is dim enough for a straight response."""

    flat: FrameStatistics
    value: float
    error: float
    signal: float
    straight: bool


def several_gains(statistics: Sequence[FrameStatistics]) -> str:
    """Which two flats are of gains that no one setting has, each less the dark as long as itself; empty where
    all are of one, or fewer than two can be told."""
    dark = reference_dark(statistics)
    flats = [s for s in statistics if s.recording.kind == "flat" and s.variance is not None]
    if dark is None:
        return ""
    seen = [g for s in flats if (g := _gain(s, dark_like(s, statistics, dark))) is not None]
    if said := _of_a_curve(seen):
        return said
    worst: tuple[float, _Gain, _Gain] | None = None
    for dim in seen:
        for bright in seen:
            if bright.signal <= dim.signal:
                continue
            excess = _excess(dim, bright)
            if excess > 0 and (worst is None or excess > worst[0]):
                worst = excess, dim, bright
    if worst is None or moving(worst[1].flat) or moving(worst[2].flat):  # that is another fault
        return ""
    low, high = sorted(worst[1:], key=lambda g: g.value)
    first, second = (g.flat.recording.path or g.flat.recording.camera for g in (low, high))
    one_file = first == second
    what = (
        "split the file into one of each setting" if one_file else "put each setting into a folder of its own"
    )
    curve = ", or a tone curve (gamma): record raw data" if _steady(seen) else ""
    return (
        f"{first}: a gain of {low.value:.2g} DN/e-; {second}: {high.value:.2g}: flats and darks of two gain "
        f"settings that no file states: {what}{curve}"
    )


def uneven_gain(statistics: Sequence[FrameStatistics], c: int) -> str:
    """Between which gains the flats of one channel lie, each by itself, where no straight line of photon
    transfer is through them; empty where one is. Full flats do not count."""
    dark, lit = reference_dark(statistics), [s for s in statistics if s.recording.kind == "flat"]
    if dark is None:
        return ""
    full, black = full_signal(lit, c), float(dark.frame_means[:, c].mean())
    flats = [s for s in lit if s.variance is not None and below_full(s, full, black, c)]
    seen = [
        g for s in flats if (g := _gain(s, dark_like(s, statistics, dark), (c,))) is not None and g.straight
    ]
    if len(seen) < 2:
        return ""
    low, high = (pick(seen, key=lambda g: g.value) for pick in (min, max))
    room = _SIGMAS * float(np.hypot(low.error, high.error))
    if np.log(high.value / low.value) < max(room, _UNEVEN):
        return ""
    shown = (
        f"flats of {low.signal:.0f} DN show {low.value:.3g} DN/e-, of {high.signal:.0f} DN {high.value:.3g}: "
    )
    if (away := _of_another_offset(seen)) is not None:
        gain, offset = away
        return (
            f"{shown}the flats lie on one line of {gain:.3g} DN/e- which meets the noise of the darks "
            f"{abs(offset):.0f} DN {'above' if offset > 0 else 'below'} their level: {OF_TWO_OFFSETS}"
        )
    return (
        f"{shown}not one straight line through the darks, so that the gain is neither (a response that "
        "bends, flats of another offset, two gains in one frame, light that changes)"
    )


def _of_another_offset(seen: Sequence[_Gain]) -> tuple[float, float] | None:
    """Slope of the line on which three flats or more lie, DN/e-, and the signal at which it meets the noise
    of the darks; None where they lie on none, or it passes through the darks."""
    if len({round(g.signal) for g in seen}) < 3:
        return None
    signal = np.array([g.signal for g in seen])
    shot = np.array([g.value for g in seen]) * signal
    error = np.array([g.error for g in seen]) * shot
    terms = np.stack([signal, np.ones(len(seen))], 1) / error[:, None]
    (slope, start), *_ = np.linalg.lstsq(terms, shot / error)
    if slope <= 0 or np.max(np.abs(terms @ (slope, start) - shot / error)) > 2:
        return None
    offset = -start / slope
    sure = np.sqrt(np.linalg.inv(terms.T @ terms)[1, 1]) / slope
    return (float(slope), float(offset)) if abs(offset) > _SIGMAS * sure else None


def _of_a_curve(seen: Sequence[_Gain]) -> str:
    """That the noise of three flats or more hardly grows with their light, from each to the next."""
    if len({round(g.signal) for g in seen}) < 3 or any(moving(g.flat) for g in seen):
        return ""
    ordered = sorted(seen, key=lambda g: g.signal)
    for dim, bright in pairwise(ordered):
        light = float(np.log(bright.signal / dim.signal))
        noise = light + float(np.log(bright.value / dim.value))
        if noise + 3 * float(np.hypot(dim.error, bright.error)) > _GROWS * light:
            return ""
    first, last = ordered[0], ordered[-1]
    names = [g.flat.recording.path or g.flat.recording.camera for g in (first, last)]
    light = last.signal / first.signal
    return (
        f"{names[1]}: {light:.2g} times the signal of {names[0]}, and {light * last.value / first.value:.2g} "
        "times its shot noise (DN^2): values of a tone curve (gamma, square root) tell no gain: record raw "
        "data"
    )


def _steady(seen: Sequence[_Gain]) -> bool:
    """Whether the gains of three flats or more rise, or fall, from each signal to the next."""
    gains = np.array([g.value for g in sorted(seen, key=lambda g: g.signal)])
    steps = np.diff(gains)
    return len(gains) > 2 and bool(np.all(steps > 0) or np.all(steps < 0))


def _excess(dim: _Gain, bright: _Gain) -> float:
    """By how much the logarithms of two gains differ beyond what one setting and their errors allow."""
    change = float(np.log(bright.value / dim.value))
    room = _SIGMAS * float(np.hypot(bright.error, dim.error))
    falls = -change - np.log(_FALLS) if bright.straight else -np.inf
    return max(change - np.log(_RISES), falls) - room


def _gain(flat: FrameStatistics, dark: FrameStatistics, channels: Sequence[int] = range(4)) -> _Gain | None:
    """Variance over signal, both less those of the dark, of the median pixel; None for flats without light,
    or of too few pixels."""
    gains, signals, errors, unknown = [], [], [], [0.0]
    straight = True
    for c in channels:
        usable = below_rail(flat, c)
        if usable.mean() < _ENOUGH:
            return None
        mean, variance = (float(median(v[usable])) for v in (site(flat.mean, c), pixel_variance(flat, c)))
        added, doubt = (0.0, 0.0) if dark.rounded is None else (v[c] for v in dark.rounded)
        signal = mean - float(median(site(dark.mean, c))) + added
        if signal <= 0:
            return None
        straight &= mean < LINEAR * flat.recording.white_level
        read = 0.0 if dark.variance is None else float(median(pixel_variance(dark, c)))
        read /= median_quotient(dark.dof) if dark.variance is not None else 1.0
        shot = variance / median_quotient(flat.dof) - read - dark_shot(flat, c)
        if shot <= read:  # then the read noise, and the dark that is taken for it, would tell the gain
            return None
        gains.append(shot / signal / float(median(site(of_variance(flat), c))))
        # The median of a mean square is worth 0.6 of the mean.
        errors.append(np.sqrt(2 / (0.6 * usable.sum() * flat.dof)) * (1 + read / shot))
        if dark.rounded is not None:  # what rounding makes of its variance is as large as that
            unknown.append(float(np.hypot(read / shot, doubt / signal)))
        signals.append(signal)
    error = float(np.linalg.norm((np.mean(errors) / np.sqrt(len(errors)), _SYSTEMATIC, max(unknown))))
    return _Gain(flat, float(np.mean(gains)), error, min(signals), straight)
