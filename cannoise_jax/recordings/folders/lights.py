"""Frames of one kind and exposure by the light that they were taken under.

A photon-transfer series may change the lamp instead of the exposure. Its frames agree in all that headers
state, and are no repeats of each other: temporal noise from all of them together would be that of the lamp.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from cannoise_jax.recordings.folders.shots import Shot

JUMP = 0.1
"""Levels above black that lie further apart than this share are of two lights. Lamps flicker by less, and a
sky that changes so much from one frame to the next gives no repeats."""


def level_of(shots: Sequence[Shot]) -> float:
    """Median level of the shots, DN, mean over the mosaic's sites."""
    return float(np.median([np.mean(s.medians) for s in shots]))


def by_light(shots: Sequence[Shot], black: float) -> list[list[Shot]]:
    """The shots parted where their sorted levels jump, dimmest first; each part in the order given.

    black: level of the darks, DN. Where no part would have two frames, the light drifts from frame to frame:
    all stay together.
    """
    levels = [level_of([s]) - black for s in shots]
    order = sorted(range(len(shots)), key=levels.__getitem__)
    parts = [order[:1]]
    for dim, bright in pairwise(order):
        # Medians are whole codes.
        if levels[bright] - levels[dim] > max(JUMP * levels[bright], 2 * shots[bright].step):
            parts.append([])
        parts[-1].append(bright)
    made = [[shots[i] for i in sorted(part)] for part in parts]
    return made if any(sum(s.shape[0] for s in part) > 1 for part in made) else [list(shots)]
