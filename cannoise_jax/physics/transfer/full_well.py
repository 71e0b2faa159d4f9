"""Flats whose pixels are full below the highest code: their signal stays and their noise collapses.

EMVA 1288 (release 4.0, section 6.6) takes saturation from the maximum of the temporal variance, which needs
no codes that pile up. Here a flat is full where a dimmer one of the same setting has four times its variance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.views import pixel_variance

_COLLAPSED = 0.25
"""Variance of a full flat over that of a dimmer one, at most: shot noise grows with the signal, and of a
response that lacks 40 % at its end a third is left."""
_ENOUGH = 1 << 14
"""Pixels whose median variance is known to 2 %."""
NEARLY = 0.9
"""Share of the full signal up to which hardly a pixel is full: full wells spread by a few per cent."""


def full_signal(lit: Sequence[FrameStatistics], c: int) -> float:
    """Mean of the fullest flat of one channel, DN; infinite where none is full."""
    flats = [s for s in lit if s.recording.kind == "flat" and s.variance is not None]
    means = np.array([float(s.frame_means[:, c].mean()) for s in flats])
    noises = np.array([_noise(s, c) for s in flats])
    full = [
        bool((noises[means < mean] > noise / _COLLAPSED).any())
        for mean, noise in zip(means, noises, strict=True)
    ]
    return float(means[full].max()) if any(full) else float("inf")


def _noise(s: FrameStatistics, c: int) -> float:
    variance = pixel_variance(s, c).ravel()
    return float(median(variance[:: max(variance.size // _ENOUGH, 1)]))


def full_codes(statistics: Sequence[FrameStatistics]) -> list[float]:
    """Codes of flats that are left out because every pixel of them is full, DN; none above the white level,
    which no sensor gave."""
    codes = [(s.recording.full_code, s.recording.white_level) for s in statistics]
    return [code for code, white in codes if code is not None and code <= white]


def below_full(s: FrameStatistics, full: float, black: float, c: int) -> bool:
    """Whether hardly a pixel of a flat is full. full: see `full_signal`; black: DN."""
    return float(s.frame_means[:, c].mean()) - black < NEARLY * (full - black)
