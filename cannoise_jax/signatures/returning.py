"""Whether pixels that are noisy in some frames are so in others: telegraph pixels are, but rare events fall
elsewhere the next time.

The frames of every dark are taken in two halves, every other one in each, which are judged about their own
means, so that they share no noise. Of the pixels that are loudest in one half those that are in the other too
are as many as chance leaves, a hypergeometric number, whatever the law of the noise (Fisher's exact test).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

from cannoise_jax.signatures.fields import Fields, each_frame
from cannoise_jax.signatures.handed import Many
from cannoise_jax.signatures.known_shape import darks

_LOUDEST = (1e-2, 1e-3)
"""Shares of the pixels that count as the loudest."""
_FRAMES = 4
"""Of a dark from which on both halves have noise."""


def halves(fields: tuple[Fields, ...]) -> tuple[np.ndarray, np.ndarray] | None:
    """Sums of squares `[h, w]` of both halves of the frames of the darks; None where they are too few.

    The shot noise of each pixel's charge is left in: divided out by the mean of all frames it would tie the
    halves together, and pixels of much charge are noisy again."""
    told = [f for f in darks(fields) if f.frames >= _FRAMES]
    if not told:
        return None
    first, second = np.zeros((2, *told[0].mean.shape))
    for f in told:
        frames = np.stack(list(each_frame(f, static=False)))
        for total, half in ((first, frames[::2]), (second, frames[1::2])):
            total += np.sum(np.square(half - half.mean(0)), 0)
    return first, second


def returning_log_p(fields: Many, usable: Bool[np.ndarray, "h w"]) -> float | None:
    """log p that no more pixels are among the loudest of both halves than by chance; None where frames are
    too few to tell. usable: pixels that count."""
    found = halves(tuple(fields))
    number = int(usable.sum())
    if found is None or number * _LOUDEST[0] < 1:
        return None
    first, second = (_order(half[usable], n) for n, half in enumerate(found))
    logs = []
    for share in _LOUDEST:
        top = int(np.ceil(share * number))
        both = int(np.sum((first < top) & (second < top)))
        logs.append(float(stats.hypergeom.logsf(both - 1, number, top, top)))
    return min(0.0, min(logs) + float(np.log(len(logs))))


def _order(values: Float[np.ndarray, "k"], half: int) -> np.ndarray:
    """The rank of every value, 0 for the largest. Equal ones, which noise of few codes has, in an order of
    each half's own."""
    out = np.empty(values.size, int)
    out[np.lexsort((np.random.default_rng(half).random(values.size), -values))] = np.arange(values.size)
    return out
