"""Whether the frames of one recording lie at one level: a flat of another exposure among flats, or a dark
that light reached, is no repeat of the others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cannoise_jax.physics.robust import robust_std
from cannoise_jax.recordings.recording import DARK, Recording

_FEWEST, _MOST_APART = 4, 0.25
"""Frames from which one can be told to be odd, and the share up to which the others are surely the rule."""
_LIGHT, _FLICKER = 0.1, 0.2
"""Share of the light from which a flat is of another one; where a lamp that flickers is looked for."""
_OFFSET, _JUMP = 1.0, 8.0
"""Noises of a pixel from which a dark is of another level; where offsets that jump are looked for."""
_ALIKE = 10.0
"""Times that by which all others differ, which an odd level lies off."""
_SAID = 4
"""Levels that a line names one by one."""
_STRIDE = 3
"""Every so many rows and columns tell a level: an odd number, that all sites are among them."""


class OddLevels(NamedTuple):
    """Frames, from 0, at another level than the others. away: how far each lies from those; others: what all
    of those differ by; shares of the light for flats, DN for darks."""

    numbers: tuple[int, ...]
    away: tuple[float, ...]
    others: float


def odd_levels(recording: Recording, unsteady: bool = False) -> OddLevels | None:
    """The few frames of flats or darks that lie at another level than the others, which agree; None where
    there are none, for scenes and where no level is the rule. unsteady: what changes from frame to frame is
    looked for, so that it has to be far off."""
    dark = recording.kind in DARK
    if recording.count < _FEWEST or recording.kind == "scene":
        return None
    levels, noise, step = _levels(recording)
    centre = float(np.median(levels))
    unit = 1.0 if dark else centre - float(np.mean(recording.black_level))
    if unit <= 0:
        return None
    apart = (levels - centre) / unit
    order = np.argsort(np.abs(apart))
    least = _FLICKER if unsteady else _LIGHT
    if dark:
        least = max((_JUMP if unsteady else _OFFSET) * noise, 4 * step)
    for few in range(1, int(_MOST_APART * recording.count) + 1):
        odd, rule = order[-few:], apart[order[:-few]]
        spread = max(float(np.ptp(rule)), step / unit)
        if np.min(np.abs(apart[odd])) > max(least, _ALIKE * spread):
            odd = np.sort(odd)
            return OddLevels(tuple(odd.tolist()), tuple(apart[odd].tolist()), float(np.ptp(rule)))
    return None


def told_level(recording: Recording, found: OddLevels) -> str:
    """What the levels of the frames are beside that of the others."""
    if recording.kind in DARK:
        why = "another exposure, or light" if max(found.away) > 0 else "another black level"
        apart = _each(found.away, "+.3g")
        return f"{apart} DN from the others, which agree to {found.others:.2g} DN: {why}"
    shares = _each([100 * (1 + away) for away in found.away], ".3g")
    return (
        f"{shares} % of the light of the others, which agree to {100 * found.others:.2g} %: another "
        "exposure, or another light"
    )


def _each(values: Sequence[float], form: str) -> str:
    """Some numbers in words; of many only the ends."""
    said = list(dict.fromkeys(format(v, form) for v in values))
    if len(said) > _SAID:
        return f"{min(values):{form}} to {max(values):{form}}"
    return " and ".join(filter(None, (", ".join(said[:-1]), said[-1])))


def _levels(recording: Recording) -> tuple[np.ndarray, float, float]:
    """Level of every frame, by the fifth of its pixels about the median, as parts of it may show another
    picture; the noise of a pixel; the spacing of the codes. DN."""
    levels, previous, noise, step = [], None, 0.0, 1.0
    for number in range(recording.count):
        frame = np.asarray(recording.frames[number : number + 1])[0][::_STRIDE, ::_STRIDE].astype(np.float64)
        if number < 2:
            codes = np.diff(np.unique(frame).astype(np.int64))
            step = float(np.gcd.reduce(codes)) if codes.size else 1.0
        if previous is not None and number < 4:
            noise = max(noise, robust_std(frame - previous) / np.sqrt(2))
        previous = frame if number < 3 else None
        low, high = np.quantile(frame, (0.4, 0.6))
        levels.append(frame.clip(low, high).mean())
    return np.array(levels), noise, step
