"""Averages and medians of the very frames beside which they lie: masters that were left in the folder.

Of frames of noise v each, two differ by D_ij = 2 v. An average m of n of them shares its noise with each of
those: D_mj = v (1 - 1/n), less than the noise of j alone, which no frame of noise of its own comes near. The
three-frame difference (see `one_noise`) gives it less than no noise, v_m = (D_mi + D_mj - D_ij) / 2 = -v / n;
medians alike. A pattern of changing strength gives that too, for a frame in the middle of its range, but then
others, of like strength, lie as near to one another. So an average is a frame that most others lie nearer to
than to any other, some of them nearer than their own noise.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from cannoise_jax.recordings.one_noise import (
    CODES,
    ERROR,
    FEWEST,
    LEAST_SIDE,
    SIGMAS,
    mean_square,
    middle_of,
    noises_of,
    step_of,
)
from cannoise_jax.recordings.recording import Recording

AVERAGED = "an average or median of the frames beside it, which it lies nearer to than they do to one another"
_MOST = 12
"""Of the other frames that are compared, with one another too: 66 pairs."""
_QUIET = 0.7
"""Of the noise of the frame in the middle, by variances, from which on a frame is looked at: an average of
two has half of it."""
_NEARER = 0.8
"""Of the mean square of differences of two frames: an average comes to half of it, where a frame has no part
in it to three quarters at most, and a frame of its own to all of it."""
_SHARE = 0.75
"""Of the other frames that have to lie nearest: some may be of another gain, or were rejected from it."""
_PATTERN = 0.2
"""Of the square of what two frames differ by, the share that may be no noise of theirs."""
_FEW, _FEW_SHARE = 2, 0.25
"""Number and share of the frames up to which they may be averages of the others."""
_ROUNDING = 0.11
"""Of the square of a code: what rounding adds to the bulk of the mean square of differences."""
_ROUNDED = 0.99
"""Share of the pixels that the rounding of an average of two leaves within a code of their mean."""


def own_averages(recording: Recording) -> tuple[int, ...]:
    """Numbers of the frames that are averages of others, from 0; none of fewer than three frames. Where there
    are several, one may hide the next."""
    if recording.count < FEWEST or min(recording.size) < LEAST_SIDE:
        return ()
    noises = noises_of(recording)
    quiet = noises.variances < _QUIET * noises.centre
    most = max(_FEW, _FEW_SHARE * recording.count)
    if noises.centre <= 0 or not 0 < np.sum(quiet) <= most:
        return ()
    which, others = np.flatnonzero(quiet).tolist(), np.flatnonzero(~quiet).tolist()
    if recording.count == FEWEST:
        found = [n for n in which if noises.below_none[n] and _is_mean_of_two(recording, n, others)]
    else:
        found = _nearest_to_most(recording, which, others, noises.below_none)
    return tuple(found)


def _nearest_to_most(
    recording: Recording, which: Sequence[int], others: Sequence[int], below: Bool[np.ndarray, "t"]
) -> list[int]:
    """Those of the frames that most of the others lie nearer to than to one another, and nearer than by their
    own noise: some, or all taken together, or the two beside (those that are `below`)."""
    if len(others) < FEWEST:
        return []
    some = np.unique(np.linspace(0, len(others) - 1, _MOST).round().astype(int))
    held = [middle_of(recording, others[n]) for n in some]
    between = np.full((len(held), len(held)), np.inf)
    for i, first in enumerate(held):
        for j, second in enumerate(held[:i]):
            between[i, j] = between[j, i] = mean_square(first, second, recording)
    like = _of_noise_alone(between)
    if len(like) < FEWEST:
        return []
    held, between = [held[n] for n in like], between[np.ix_(like, like)]
    nearest, usual = between.min(1), float(np.median(between[between < np.inf]))
    if usual < CODES * step_of(recording, others[0]) ** 2:
        return []  # rounding is most of what differs
    error = SIGMAS * ERROR * np.sqrt((1 + 1 / 4) / held[0].size)

    def is_average(number: int) -> bool:
        own = middle_of(recording, number)
        near = np.array([mean_square(own, other, recording) for other in held])
        shared = near - _ROUNDING * step_of(recording, number) ** 2
        one = np.any(shared < (1 - error) / 2 * nearest)
        together = np.median(shared) < (1 - error / np.sqrt(len(held))) / 2 * usual
        return bool((below[number] or one or together) and np.mean(near < _NEARER * nearest) >= _SHARE)

    return [n for n in which if is_average(n)]


def _of_noise_alone(between: Float[np.ndarray, "t t"]) -> list[int]:
    """The frames of like noise, if they differ by it alone (D_ij = v_i + v_j); none where by patterns too, of
    which a frame of its own may be in the middle."""
    count = len(between)
    sums = np.where(np.isinf(between), 0.0, between).sum(1)
    noise = (sums - sums.sum() / (2 * (count - 1))) / (count - 2)
    usual = float(np.median(noise))
    like = np.flatnonzero((noise > _QUIET * usual) & (noise < usual / _QUIET))
    pairs = [(i, j) for i in like for j in like if i < j]
    fits = [abs(between[i, j] / (noise[i] + noise[j]) - 1) < _PATTERN for i, j in pairs]
    return like.tolist() if usual > 0 and fits and np.mean(fits) >= _SHARE else []


def _is_mean_of_two(recording: Recording, number: int, others: Sequence[int]) -> bool:
    """Whether of three frames one is the mean of the others, up to rounding: how near they lie to one
    another does not tell it from a pattern that grows."""
    if len(others) != FEWEST - 1:
        return False
    first, second = (middle_of(recording, n) for n in others)
    step = step_of(recording)
    if mean_square(first, second, recording) < 2 * step**2:
        return False  # noise below a code is within rounding of anything
    rest = middle_of(recording, number) - (first + second) / 2
    return bool(np.mean(np.abs(rest) <= step) >= _ROUNDED)
