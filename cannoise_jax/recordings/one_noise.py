"""Whether the frames of one recording have one temporal noise: averages and other gain settings have not.

The noise of every frame is taken from its differences to the next two, D_ij = v_i + v_j, so that fixed
patterns cancel: v_1 = (D_12 + D_13 - D_23) / 2. The last two frames take those before: over a whole recording
the pattern of dark charge changes where the sensor warms up, and would be noise of theirs. What rows do
together, smooth light and its drift cancel between the neighbours of one colour in a row.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from cannoise_jax.recordings.recording import DARK, Recording

_RATIO = 1.35**2
"""Of the variances of two frames: beyond it they are of another noise. An average of two frames has half the
variance, repeats of one setting differ by a few per cent."""
SIGMAS = 4.5
"""Errors of a variance by which it has to lie beyond that too: of a hundred honest recordings of a thousand
frames one holds such a frame by chance."""
ERROR = 2.2
"""Relative error of a mean square of differences of neighbours, times the root of their number."""
_BULK = 0.9
"""Share of the differences that counts, the smallest: hits and noisy pixels stay out."""
_SIDE = 512
"""Rows and columns that are looked at, about the middle."""
CODES = 0.5
"""Of the square of a code: the variance of a difference that rounding may bring or take where noise is less
than a code, and the level of a frame moves by part of one."""
_GAP = 4.0
"""How much further two levels are apart than all that their frames scatter: then they are two settings, and
not dark charge that grows."""
FEWEST = 3
"""Frames from which one can be told to be odd."""
LEAST_SIDE = 8
_MOST_APART = 0.25
"""Share of the frames up to which those of another noise are left out and the others surely the rule."""
_ABOVE = 3.0
"""Noises by which louder darks have to be brighter for light to be the likely reason."""
_MOST_NUMBERS = 4


def numbered(which: Sequence[int]) -> str:
    """Frames in a message, by number."""
    if len(which) == 1:
        return f"frame {which[0]}"
    if list(which) == list(range(which[0], which[-1] + 1)):
        return f"frames {which[0]} to {which[-1]}"
    more = f" and {len(which) - _MOST_NUMBERS} more" if len(which) > _MOST_NUMBERS else ""
    return f"frames {', '.join(map(str, which[:_MOST_NUMBERS]))}{more}"


class Apart(NamedTuple):
    """Frames of another temporal noise than most of their recording.

    numbers: which, from 0. others: those of one noise. ratio: their noise over that of the others (standard
    deviations), the furthest from one. few: whether the others are surely the rule. lit: whether they are
    darks that are brighter too.
    """

    numbers: tuple[int, ...]
    others: tuple[int, ...]
    ratio: float
    few: bool
    lit: bool


class Noises(NamedTuple):
    """Temporal variance of every frame in units of its own, DN^2 up to one common factor, the error of that,
    and the mean signal above black, DN."""

    variances: Float[np.ndarray, "t"]
    errors: Float[np.ndarray, "t"]
    signal: Float[np.ndarray, "t"]

    @property
    def centre(self) -> float:
        """The variance of the frame in the middle, of two there the lower one."""
        return float(np.sort(self.variances)[(len(self.variances) - 1) // 2])

    @property
    def below_none(self) -> Bool[np.ndarray, "t"]:
        """The frames that lie nearer to two others than frames of noise of their own can."""
        return self.variances < -SIGMAS * self.errors


def apart(recording: Recording) -> Apart | None:
    """The frames of another temporal noise than the rest; None where all are alike, for scenes, which may
    move, and for fewer than three frames, of which none can be told to be the odd one. Averages
    of frames that are there too are to be taken out before (see `own_average`)."""
    if recording.count < FEWEST or recording.kind == "scene" or min(recording.size) < LEAST_SIDE:
        return None
    noises = noises_of(recording)
    variances, errors, signal = noises
    centre = noises.centre
    # Less than none: the frames differ by a pattern of changing strength, which is no noise of theirs.
    if centre <= 0 or np.any(noises.below_none):
        return None
    seen = signal
    if recording.kind == "bias" or (recording.kind == "dark" and _in_two(signal)):
        signal = np.zeros_like(signal)
    coarse = CODES * step_of(recording) ** 2
    alike = np.stack([_alike(variances, errors, signal, coarse, at) for at in range(len(variances))])
    # The rule is the noise that most frames share; of equal numbers that of the frame in the middle, of two
    # there the quieter one.
    order = np.lexsort((np.abs(variances - centre), -alike.sum(1)))
    rule = int(order[0])
    odd = np.flatnonzero(~alike[rule])
    if not len(odd):
        return None
    others = np.flatnonzero(alike[rule])
    ratios = np.sqrt(np.maximum(variances[odd], 0.0) / np.median(variances[others]))
    furthest = int(np.argmax(np.abs(np.log(np.maximum(ratios, 1e-3)))))
    few = len(odd) <= _MOST_APART * len(variances)
    above = float(np.median(seen[odd]) - np.median(seen[others]))
    lit = recording.kind in DARK and above > _ABOVE * np.sqrt(centre) and ratios[furthest] > 1
    return Apart(tuple(odd.tolist()), tuple(others.tolist()), float(ratios[furthest]), few, lit)


def words(recording: Recording, found: Apart, number: Sequence[int]) -> str:
    """Which frames are of another noise than which others, and what they may be; number: of every frame as
    the file counts them, from 0."""
    odd, others = found.numbers, found.others
    names = short_names(recording.sources) if len(recording.sources) == recording.count else ()
    reason = " light reached them (they are brighter too), or" if found.lit else ""
    reason = " an average, or" if found.ratio < 1 else reason
    reason = f" light that moves,{reason or ' or'}" if recording.kind == "flat" else reason
    which = numbered([number[k] + 1 for k in odd])
    which += f" ({names[odd[0]]}{f' and {len(odd) - 1} more' if len(odd) > 1 else ''})" if names else ""
    beside = f" ({names[others[0]]} ...)" if names else ""
    has = "has" if len(odd) == 1 else "have"
    return (
        f"{recording.path or recording.camera}: {which} {has} {found.ratio:.2g} times the temporal noise "
        f"of the other {len(others)}{beside}:{reason} another gain setting"
    )


def short_names(files: Sequence[str]) -> list[str]:
    """The files below the folder that holds them all."""
    parents = [Path(file).parent for file in files]
    shared = os.path.commonpath(parents) if len(set(parents)) > 1 else parents[0]
    return [str(Path(file).relative_to(shared)) for file in files]


def step_of(recording: Recording, number: int = 0) -> float:
    """Spacing of the codes of a frame, DN."""
    codes = np.unique(np.asarray(recording.frames[number : number + 1]))
    return float(np.gcd.reduce(np.diff(codes))) if len(codes) > 1 else 1.0


def _alike(
    variances: Float[np.ndarray, "t"],
    errors: Float[np.ndarray, "t"],
    signal: Float[np.ndarray, "t"],
    coarse: float,
    at: int,
) -> np.ndarray:
    """Which frames may have the noise of frame `at`.

    Where the light, or dark charge, differs shot noise does too, by the ratio of the signals at most. (Of
    biases, and of darks of two levels, the signals are taken for none.)
    """
    floor = 3 * np.sqrt(max(variances[at], 0.0))  # below it the signal has no shot noise to speak of
    light = (signal + floor) / (signal[at] + floor) if floor > 0 else np.ones_like(signal)
    low, high = (variances[at] * pick(light, 1.0) for pick in (np.minimum, np.maximum))
    room = SIGMAS * np.hypot(errors, errors[at]) + coarse
    return (variances >= low / _RATIO - room) & (variances <= high * _RATIO + room)


def _in_two(levels: Float[np.ndarray, "t"]) -> bool:
    """Whether levels are two, the one of three frames or more: of a sensor that warms up they are spread
    out."""
    order = np.sort(levels)
    steps = np.diff(order)
    if len(order) <= FEWEST:
        return False
    at = int(np.argmax(steps))
    return bool(steps[at] > _GAP * (order[-1] - order[0] - steps[at]))


def noises_of(recording: Recording) -> Noises:
    """The temporal noise of every frame, of the middle of the frames."""
    count = recording.count
    signal, near, far = np.empty(count), np.zeros(count), np.zeros(count)
    held = [middle_of(recording, 0)]
    size = max(held[0].size, 1)
    for number in range(count):
        signal[number] = held[0].mean()
        held += [middle_of(recording, after) for after in range(number + len(held), min(number + 3, count))]
        first, *later = held
        for steps, other in zip((near, far), later, strict=False):
            steps[number] = mean_square(first, other, recording)
        held = later
    # D of each frame to its two, and of these to one another: of frame t those after it, of the last two
    # those before; of three frames there is one choice.
    at, back = np.arange(count - 2), [max(count - 2, 2), count - 1]
    ahead = np.array([near[at], far[at], near[at + 1]])
    behind = np.array([[near[t - 1], far[t - 2], near[t - 2]] for t in back]).T
    if count == FEWEST:
        behind[:, 0] = near[0], near[1], far[0]
    sides = np.concatenate([ahead, behind], 1)
    values = (sides[0] + sides[1] - sides[2]) / 2
    errors = ERROR / 2 * np.sqrt(np.sum(sides**2, 0) / size)
    return Noises(values, errors, np.maximum(signal, 0.0))


def middle_of(recording: Recording, number: int) -> Float[np.ndarray, "h w"]:
    """The middle of a frame, DN above black."""
    top, left = (max((n - _SIDE) // 2, 0) // 2 * 2 for n in recording.size)
    frame = np.asarray(recording.frames[number : number + 1])[0]
    black = float(np.mean(recording.black_level))
    return frame[top : top + _SIDE, left : left + _SIDE].astype(np.float64) - black


def mean_square(first: np.ndarray, second: np.ndarray, recording: Recording) -> float:
    """Mean square of the bulk of the differences between two frames, of neighbours of one colour."""
    a, b = first.mean(), second.mean()
    lit = recording.kind not in DARK and min(a, b) > 0
    # Each frame scaled by half of what tells the lights apart, so that the pattern of pixels cancels.
    scale = np.sqrt(b / a) if lit else 1.0
    change = first * scale - second / scale
    change = np.abs(change[:, 2:] - change[:, :-2]).ravel()
    bulk = np.partition(change, int(_BULK * (change.size - 1)))[: int(_BULK * (change.size - 1)) + 1]
    return float(np.mean(bulk**2))
