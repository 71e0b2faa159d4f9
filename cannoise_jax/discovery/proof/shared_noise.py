"""Whether the tails that a name says are of every pixel by itself: not of noise that pixels next to it share.

Noise whose strength changes from row to row, block to block or place to place is a mixture, and a mixture has
tails that none of its parts has. Where the variance s^2 of pixels that lie side by side is one, their squares
are correlated, by var(s^2), and the excess kurtosis of all is three times that. Tails of single pixels leave
their squares independent. So does a noise of each pixel's own, which is the same in other frames.
"""

from __future__ import annotations

import numpy as np

from cannoise_jax.discovery.proof.white_maps import NOISE, noisy_halves
from cannoise_jax.discovery.search.name import UNKNOWN, Doubt
from cannoise_jax.discovery.search.steps import Step
from cannoise_jax.physics.robust import median
from cannoise_jax.signatures.known_shape import darks
from cannoise_jax.signatures.shape import HEAVY, one_noise

_LAGS = (2, 3, 4)
"""Pixels apart: those next to each other share charge, those far apart no block."""
_SHARE = 0.3
"""Of the excess kurtosis, from which on it is the mixture's."""
_SURE = 6.0
"""Standard errors from which on the squares are correlated."""
_DIAGONAL = ((2, 2), (2, -2), (4, 4), (4, -4))
"""Pixels apart, down and across: of one colour, and in no line of noise together."""
_FEWEST_LINES = 8
"""Lines from which on neighbours are held against each other."""
_HALF = 0.5
"""Of what pixels have in common with themselves in other frames, that those beside each other have: a map of
single pixels has none, one that is smooth over ten pixels and more 0.8 to 1."""


def shared(step: Step) -> Doubt | None:
    """What speaks against a step that names heavy tails; None: nothing does, or it names none."""
    if step.named.mechanism == UNKNOWN or step.named.signature.axes.law != HEAVY:
        return None
    products, errors, fourth = np.zeros(2), np.zeros(2), 0.0
    pairs = number = 0.0
    for _, frame, keep in one_noise(step.before):
        square = np.where(keep, frame.astype(np.float64) ** 2, 0.0)
        mean = float(square.sum() / keep.sum())
        fourth += float(np.sum(square**2)) / mean**2 - 3 * float(keep.sum())
        number += float(keep.sum())
        off = np.where(keep, square / mean - 1, 0.0)
        spread = float(np.mean(off[keep] ** 2))
        for axis in (0, 1):
            for lag in _LAGS:
                one, other = (np.take(off, range(*ends), axis) for ends in _ends(off.shape[axis], lag))
                products[axis] += float(np.sum(one * other))
                errors[axis] += spread**2 * one.size
        pairs += sum(off.size - lag * off.shape[1] for lag in _LAGS)
    if fourth <= 0 or not pairs:
        return None
    z, share = products / np.sqrt(errors), 3 * products / pairs / (fourth / number)
    worst = int(np.argmax(share))
    if z[worst] < _SURE or share[worst] < _SHARE:
        return None
    along = ("in columns", "in rows")[worst]
    said = (
        f"pixels side by side {along} are loud together: {100 * min(share[worst], 1):.0f} % of the tails are"
    )
    return Doubt(
        float(min(share[worst], 1.0)), (f"{said} those of noise that is stronger in places",), instead=True
    )


def shared_map(step: Step) -> Doubt | None:
    """What speaks against a step that gives every pixel a noise of its own: that pixels near by are as noisy,
    in other frames, as it is itself, as where noise is stronger in parts of the frame."""
    found = noisy_halves(step)
    if found is None:
        return None
    usable = found.usable
    one, other = (np.where(usable, half / half[usable].mean() - 1, 0.0) for half in found[:2])
    number = float(usable.sum())
    itself = float(np.sum(one * other)) / number
    pairs = [(one, other, lag) for lag in _DIAGONAL] + [(other, one, lag) for lag in _DIAGONAL]
    beside = float(np.mean([np.sum(a * np.roll(b, lag, (0, 1))) for a, b, lag in pairs])) / number
    error = float(np.sqrt(np.mean(one**2) * np.mean(other**2) / number / len(_DIAGONAL)))
    if beside < _SURE * error or beside < _HALF * itself:
        return None
    share = min(beside / max(itself, beside), 1.0)
    said = f"pixels near each other are noisy together: they have {100 * share:.0f} % of it in common"
    return Doubt(share, (said,), instead=True)


def shared_lines(step: Step) -> Doubt | None:
    """What speaks against a step that gives every row or column a read noise of its own: that what loud lines
    have beyond the others is in the pixel of the next line too, in the same frame, as of an offset that dies
    away along the scan."""
    axes = step.named.signature.axes
    if step.named.mechanism == UNKNOWN or axes.law != NOISE or axes.varies_over not in ("row", "column"):
        return None
    axis = 0 if axes.varies_over == "row" else 1
    power, product, number = np.zeros((3, step.before[0].mean.shape[axis]))
    for f in darks(step.before):
        values = np.moveaxis(f.contrasts * f.usable, 1 + axis, 0)
        power += np.einsum("lnk,lnk->l", values, values)
        product[:-1] += np.einsum("lnk,lnk->l", values[:-1], values[1:])
        number += f.usable.sum(1 - axis) * len(f.contrasts)
    known = number > 0
    if known.sum() < _FEWEST_LINES:
        return None
    level = float(power[known].sum() / number[known].sum())
    beyond = np.where(known, power / np.maximum(number, 1) / level - 1, 0.0)
    pairs = known[:-1] & known[1:]
    together = np.sqrt(np.maximum(beyond[:-1], 0) * np.maximum(beyond[1:], 0)) * pairs
    alike = product[:-1] / np.maximum(number[:-1], 1) / level
    alike = np.where(pairs, alike - median(alike[pairs]), 0.0)
    power_of = float(np.sum(together**2))
    share = float(np.sum(alike * together)) / max(power_of, 1e-30)
    error = 1 / np.sqrt(float(median(number[known])) * max(power_of, 1e-30))
    if share < max(_SURE * error, _SHARE):
        return None
    share = min(share, 1.0)
    said = (
        f"neighbouring {axes.varies_over}s share {100 * share:.0f} % of what makes them loud, frame by frame"
    )
    return Doubt(share, (said,), instead=True)


def _ends(size: int, lag: int) -> tuple[tuple[int, int], tuple[int, int]]:
    return (0, size - lag), (lag, size)
