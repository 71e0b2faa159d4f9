"""What the black level holds of dark charge: the exposure of the dark that tells it is not 0."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cannoise_jax.physics.robust import median
from cannoise_jax.signatures.fields import Fields, mean_of_frames, native


def charge_in_black(darks: Sequence[Fields], longest: float) -> dict[int, float]:
    """By gain setting, what the black level holds of dark charge, DN: the level of the shortest dark, which a
    flat's mean is told above, has that of its own exposure. Of flats over their exposures it would be a bend
    of its own. By the dark whose exposure is nearest to that of the longest flat, s."""
    out: dict[int, float] = {}
    for group in {f.group for f in darks}:
        all_of = [f for f in darks if f.group == group]
        own = [f for f in all_of if f.static is not None and f.exposure_s]
        by_time = sorted(((float(f.exposure_s or 0.0), n) for n, f in enumerate(own)))
        # An exposure that is not stated counts as none where the black level is told.
        if not by_time or any((f.exposure_s or 0.0) < by_time[0][0] for f in all_of):
            continue
        (least, first), *others = by_time
        more = [(abs(np.log(t / longest)), t, n) for t, n in others if t > least]
        if not more:
            continue
        _, seconds, near = min(more)
        short, other = native(own[first]), native(own[near])
        kept = short.usable & other.usable
        risen = float(median((mean_of_frames(other) - mean_of_frames(short))[kept])) if kept.any() else 0.0
        out[group] = max(risen, 0.0) * least / (seconds - least)
    return out
