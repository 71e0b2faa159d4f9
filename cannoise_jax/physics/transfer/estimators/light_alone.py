"""A flat and what it holds beside its light: the pattern of darks as warm, or else a dimmer flat.

The dark charge of flats that no dark is as warm as has its pattern in none of the darks, and would pass for
unlike sensitivities. Two flats of one exposure and temperature hold the same of it, so that the brighter less
the dimmer has that of the light alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cannoise_jax.physics.transfer.estimate import NotMeasurable
from cannoise_jax.physics.transfer.estimators.dark_map import DarkMap, dark_map
from cannoise_jax.physics.transfer.estimators.pick import steady_pixels
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.one_temperature import unlike_darks
from cannoise_jax.physics.transfer.views import less
from cannoise_jax.recordings.join import ALIKE_KELVIN
from cannoise_jax.recordings.packing import ALL
from cannoise_jax.recordings.recording import Recording, mosaic_map

_DIMMER = 0.7
"""Of the level of a flat, up to which another is enough dimmer for their difference to stand out."""
_SAME = 1.02
"""Ratio of exposures that are one: files round them."""


class LightAlone(NamedTuple):
    """A flat with the level of its light alone, what is to be taken out of it pixel by pixel, and a note on
    that where it is no dark."""

    flat: FrameStatistics
    dark: DarkMap | None
    note: str = ""


def light_alone(
    statistics: Sequence[FrameStatistics], flat: FrameStatistics, channel: int = ALL
) -> LightAlone | NotMeasurable:
    """The flat above darks as warm; above the dimmest flat as long and as warm where there are none; what to
    record where there is neither. channel: see `dark_map`."""
    if not unlike_darks(flat.recording, [s.recording for s in statistics]):
        return LightAlone(flat, dark_map(statistics, flat, channel))
    least = _DIMMER * float(np.mean(flat.level))
    dimmer = [s for s in statistics if _as_dark(s, flat.recording) and float(np.mean(s.level)) < least]
    celsius, seconds = flat.recording.temperature_c, flat.recording.exposure_s
    if not dimmer:
        return NotMeasurable(
            f"no dark is as warm as the flats, so what their pixels hold without light is not known: record "
            f"darks of {seconds:g} s at {celsius:.4g} C, or flats of two levels at that exposure"
        )
    below = min(dimmer, key=lambda s: float(np.mean(s.level)))
    black = mosaic_map(flat.recording.black_level, flat.recording.size).astype(np.float64)
    found = DarkMap(np.zeros(flat.mean.shape), steady_pixels(below), ((below, 1.0),))
    note = f"from the growth of the light between two flats of {seconds:g} s, for no dark is as warm"
    return LightAlone(less(flat, below.mean - black), found, note)


def _as_dark(s: FrameStatistics, flat: Recording) -> bool:
    """Whether a repeated flat holds the same dark charge as another."""
    own = s.recording
    if own.kind != "flat" or s.variance is None or own.temperature_c is None or not own.exposure_s:
        return False
    assert flat.temperature_c is not None and flat.exposure_s
    alike = max(own.exposure_s, flat.exposure_s) <= _SAME * min(own.exposure_s, flat.exposure_s)
    return alike and own is not flat and abs(own.temperature_c - flat.temperature_c) <= ALIKE_KELVIN
