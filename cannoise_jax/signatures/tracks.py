"""How many particles hit a recording, and what charge they left.

A pixel that stands out in one frame alone says that there was a hit, not all of it: where many fall pixels
are hit in several frames, a track is broken where it crosses another one's pixel, and its ends are faint. So
frames are seen from the median of their pixel, short gaps are bridged, and the charge is that of all
pixels in and beside a track.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from cannoise_jax.physics.robust import median
from cannoise_jax.signatures.fields import Fields, frame_fields

_LEAST_FRAMES = 5
"""From which on the median of a pixel over the frames, or the mean of those before, has little of a hit."""
_OF_MEDIAN = np.pi / 2
"""Variance of a median over that of a mean, of normal noise."""
CELL = np.ones((3, 3), bool)
"""A pixel and its eight neighbours, of which a track goes on in one."""


class Tracks(NamedTuple):
    """Number of tracks, and their charge together, electrons."""

    number: int
    charge_e: float


def tracks(
    field: Fields, may_be_hit: Bool[np.ndarray, "h w"], limit: Float[np.ndarray, "h w"] | float
) -> Tracks | None:
    """The tracks through these pixels; None of few frames. limit: standard deviations from which on one has
    been hit."""
    if max(field.before, field.frames) < _LEAST_FRAMES:
        return None
    sigma = field.sigma.astype(np.float32)
    if field.before:  # from the mean of the frames before
        noise = sigma * np.float32(np.sqrt(1 + 1 / field.before))
        frames = frame_fields(field, static=False) * noise
    else:
        frames = frame_fields(field, static=False) * (sigma * np.float32(np.sqrt(1 - 1 / field.frames)))
        frames -= median(frames, 0)
        noise = sigma * np.sqrt(1 + _OF_MEDIAN / field.frames)
    least = limit * noise
    number, charge = 0, 0.0
    gain = max(float(np.mean(field.gain)), 1e-9)
    for frame in frames:
        hit = (frame > least) & may_be_hit & field.usable
        number += int(ndimage.label(ndimage.binary_closing(hit, CELL) | hit, CELL)[1])
        charge += float(frame[ndimage.binary_dilation(hit, CELL) & field.usable].sum(dtype=np.float64)) / gain
    return Tracks(number, charge)
