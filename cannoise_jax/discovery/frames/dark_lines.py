"""Offsets of rows and columns that darks show: no part of the light of a flat.

Its smooth surface would take up what of them is smooth. In the darks that is left to the pattern, so that
both together would look like gains of lines.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from cannoise_jax.discovery.frames.contrasts import Stack, robust_mean
from cannoise_jax.physics.robust import NOISE_OF_MEDIAN, median, robust_std
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import DARK, Recording

_LONGER, _SHORT_S = 10.0, 0.1
"""Exposure of a dark, over that of a flat, and in seconds, up to which what it collected is taken to be small
beside offsets."""
_TOLD = 0.5
"""Share of the variance of lines that must be no chance."""


Known = Sequence[tuple[Recording, Float[np.ndarray, "h w"] | None]]
"""Darks with the lines that each shows."""


def beside_darks(stacks: Sequence[Stack]) -> tuple[Stack, ...]:
    """The stacks, flats with the lines that darks show."""
    known = [(s.recording, lines_of(s)) for s in stacks if s.recording.kind in DARK]
    return tuple(s._replace(lines=lines_for(s.recording, known)) for s in stacks)


def lines_for(recording: Recording, known: Known) -> Float[np.ndarray, "h w"] | None:
    """Of a flat, the lines of the dark nearest in exposure at its gain, DN; None: none are known."""
    seconds = recording.exposure_s or 0.0
    longest = max(_LONGER * seconds, _SHORT_S)
    like = [
        (abs((dark.exposure_s or 0.0) - seconds), lines is None, n)
        for n, (dark, lines) in enumerate(known)
        if dark.iso == recording.iso and (dark.exposure_s or 0.0) <= longest
    ]
    return known[min(like)[-1]][1] if like and recording.kind == "flat" else None


def lines_of(dark: Stack) -> Float[np.ndarray, "h w"] | None:
    """Offsets of the rows and columns of every site of the mosaic, as far as they differ by more than chance
    and than lines that are new in every frame do, DN; None where there are none, or one frame only."""
    if not len(dark.contrasts):
        return None
    out = np.zeros(dark.mean.shape)
    for at in SITES:
        left = dark.mean[at].astype(np.float64) - robust_mean(dark.mean[at])
        for axis in (1, 0):
            offsets = median(left, axis)
            moving = [np.var(median(c[at], axis)) for c in dark.contrasts]
            chance = NOISE_OF_MEDIAN * robust_std(left, 0) ** 2 / left.shape[axis]
            chance += float(np.mean(moving)) / dark.frames
            share = 1 - chance / max(float(np.var(offsets)), 1e-30)
            if share < _TOLD:
                continue
            part = np.expand_dims(share * (offsets - np.mean(offsets)), axis)
            left = left - part
            out[at] += part
    return out if out.any() else None
