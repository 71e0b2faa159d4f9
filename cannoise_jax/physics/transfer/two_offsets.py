"""Whether flats stand on another offset (black level) than the darks, told by their noise and by their light.

Shot noise grows in proportion to the signal, and the signal in proportion to the exposure of one lamp: above
a wrong offset both are straight lines that miss the dark by the same signal. A response that bends, which
either alone could be, moves the two apart: of the light it takes a share that grows with the signal, of the
variance over the signal three times as much, so that one line passes above the dark and the other below. A
shutter that opens late moves the light alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from cannoise_jax.physics.transfer.black import dark_like, reference_dark
from cannoise_jax.physics.transfer.fit import robust_mean_square
from cannoise_jax.physics.transfer.frames import FrameStatistics, of_variance
from cannoise_jax.physics.transfer.full_well import below_full, full_signal
from cannoise_jax.physics.transfer.rails import below_rail
from cannoise_jax.physics.transfer.views import dark_shot, pixel_variance
from cannoise_jax.recordings.packing import site

_LEVELS = 3
"""Flats of exposures of their own that a line and what is off it need."""
_STEADY = 0.005
"""Share of the signal by which flats of one lamp may miss the line: lamps and shutters are steadier. Of the
shot noise it is allowed besides what chance makes."""
_BY_LIGHT, _BY_NOISE, _AGREE = 5.0, 3.5, 3.0
"""Standard errors from which on light and noise say that an offset is there, and up to which they agree on
it, beside a fifth."""
_MATTERS = 0.01
"""Share of the dimmest signal from which on an offset is worth saying."""
_ENOUGH = 0.5
"""Share of the pixels of a flat that have to be below the rail."""


class _Points(NamedTuple):
    """Of every flat and channel: signal above the dark and shot noise (DN, DN^2), its error, and exposure."""

    channel: Int[np.ndarray, "n"]
    signal: Float[np.ndarray, "n"]
    shot: Float[np.ndarray, "n"]
    error: Float[np.ndarray, "n"]
    seconds: Float[np.ndarray, "n"]


def two_offsets(statistics: Sequence[FrameStatistics]) -> str:
    """By how much flats stand on another offset than the darks; empty where they do not, or where fewer than
    three exposures of one lamp tell."""
    seen = _points(statistics)
    if seen is None:
        return ""
    channels = (seen.channel[:, None] == np.unique(seen.channel)).astype(float)
    error = np.hypot(seen.error, _STEADY * seen.shot)
    if not error.all():
        return ""
    by_light = _line(channels * seen.seconds[:, None], seen.signal, _STEADY * seen.signal)
    by_noise = _line(channels * seen.signal[:, None], seen.shot, error)
    if by_light is None or by_noise is None or by_noise.slope <= 0:
        return ""
    offset, sure = -by_noise.start / by_noise.slope, by_noise.error / by_noise.slope
    if abs(offset) < _BY_NOISE * sure or abs(by_light.start) < _BY_LIGHT * by_light.error:
        return ""
    if abs(by_light.start) < _MATTERS * float(seen.signal.min()):
        return ""
    if abs(by_light.start - offset) > _AGREE * sure + 0.2 * abs(offset):
        return ""
    return (
        f"noise and light of the flats both meet the dark {abs(by_light.start):.0f} DN "
        f"{'above' if offset > 0 else 'below'} its level: flats and darks are of two offsets (black "
        f"levels): the gain is wrong with it ({by_noise.slope:.3g} DN/e- by the noise of the flats alone), "
        "record both with one"
    )


def _points(statistics: Sequence[FrameStatistics]) -> _Points | None:
    reference, lit = reference_dark(statistics), [s for s in statistics if s.recording.kind == "flat"]
    flats = [s for s in lit if s.variance is not None and s.recording.exposure_s]
    if reference is None or len({s.recording.exposure_s for s in flats}) < _LEVELS:
        return None
    found, full = [], [full_signal(lit, c) for c in range(4)]
    for s in flats:
        dark = dark_like(s, statistics, reference)
        for c in range(4):
            level = float(dark.frame_means[:, c].mean())
            usable = below_rail(s, c)
            if usable.mean() < _ENOUGH or not below_full(s, full[c], level, c):
                continue
            noise, inside = robust_mean_square(pixel_variance(s, c)[usable], s.dof)
            read = 0.0 if dark.variance is None else robust_mean_square(pixel_variance(dark, c), dark.dof)[0]
            signal = float(site(s.mean, c)[usable][inside].mean()) - level
            shot = (noise - read - dark_shot(s, c)) / float(site(of_variance(s), c).mean())
            error = noise * np.sqrt(2 / (inside.sum() * s.dof))
            found.append((c, signal, shot, error, float(s.recording.exposure_s or 0.0)))
    if len({seconds for *_, seconds in found}) < _LEVELS or min(signal for _, signal, *_ in found) <= 0:
        return None
    return _Points(*(np.array(column) for column in zip(*found, strict=True)))


class _Line(NamedTuple):
    """Mean slope of the channels, what all have where there is nothing, and its standard error."""

    slope: float
    start: float
    error: float


def _line(terms: Float[np.ndarray, "n c"], values: np.ndarray, error: np.ndarray) -> _Line | None:
    """Straight lines through the channels that start alike; None where the values lie on none."""
    weighed = np.concatenate([terms, np.ones((len(terms), 1))], 1) / error[:, None]
    found, *_ = np.linalg.lstsq(weighed, values / error)
    if np.max(np.abs(weighed @ found - values / error)) > _AGREE:
        return None
    doubt = np.linalg.pinv(weighed.T @ weighed)[-1, -1]
    return _Line(float(np.mean(found[:-1])), float(found[-1]), float(np.sqrt(doubt)))
