"""Whether the tails that a name says are on both sides alike, as those of its law are.

A law that is its own mirror image has no third moment. What has tails on one side alone, as charge that comes
now and then has, has one: values z standard deviations out add z^3 to it and z^4 to the fourth, so that the
third is a good part of the fourth where they are mostly on one side, however strong they are. Shot noise of
dark charge leans as well, by as much as the charge tells.
"""

from __future__ import annotations

import numpy as np

from cannoise_jax.discovery.search.name import UNKNOWN, Doubt
from cannoise_jax.discovery.search.steps import Step, without_all
from cannoise_jax.signatures.known_shape import known_skewness
from cannoise_jax.signatures.shape import HEAVY, one_noise

_TYPICAL = 3.0
"""Standard deviations at which most of what makes tails lies."""
_LEANS = 0.5
"""Of the third moment that the tails would make on one side, from which on they are not on both: three in
four of the far values are on one."""
_SURE = 6.0
"""Standard errors from which on that is no chance."""
_FAR = 6.0
"""Standard deviations of what pixels have of the third moment, beyond which one counts for nothing: it jumps
between levels, which need not be as often the one as the other."""


def one_sided(steps: tuple[Step, ...], n: int) -> Doubt | None:
    """What speaks against a step that names heavy tails; None: nothing does, or it names none."""
    named = steps[n].named
    if named.mechanism == UNKNOWN or named.signature.axes.law != HEAVY:
        return None
    alone = without_all((s for s in steps[n + 1 :] if not s.named.signature.frozen), steps[n].before)
    third, frames = np.zeros(alone[0].mean.shape), np.zeros(alone[0].mean.shape)
    fourth = 0.0
    for field, values, keep in one_noise(alone):
        z = np.where(keep, values.astype(np.float64), 0.0)
        mean = float(z.sum() / keep.sum())
        unit = float(np.sqrt(np.sum(np.square(z - mean)[keep]) / keep.sum()))
        z = np.where(keep, (z - mean) / unit, 0.0)
        third += np.where(keep, z**3 - 3 * z - known_skewness(field), 0.0)
        fourth += float(np.sum(z**4)) - 3 * float(keep.sum())
        frames += keep
    told = frames > 0
    if fourth <= 0 or not told.any():
        return None
    of_pixel = third[told]
    limit = _FAR * float(np.sqrt(np.mean(np.square(of_pixel))))
    of_pixel = of_pixel[np.abs(of_pixel) < limit]
    whole, error = float(of_pixel.sum()), float(np.sqrt(np.sum(of_pixel**2)))
    share = abs(whole) * _TYPICAL / fourth
    if abs(whole) < _SURE * error or share < _LEANS:
        return None
    side = "above" if whole > 0 else "below"
    skewness = whole / float(frames.sum())
    said = f"its tails are on one side: far values lie {side}, by a skewness of {skewness:.2f}"
    return Doubt(min(share, 1.0), (said,), instead=True)
