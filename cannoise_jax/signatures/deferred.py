"""Charge that comes out late, put back into the pixels that it was left behind by."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cannoise_jax.signatures.fields import Fields, map_contrasts
from cannoise_jax.signatures.score import Score

_STANDS_OUT = 5.0
"""Standard deviations of the noise from which on a value is taken to be charge."""


class Deferred(NamedTuple):
    """A share of the charge that comes out along an axis (0: columns, 1: rows) with pixels read later, below
    0: with those above or on the left; length: pixels over which what comes out falls to 1/e; growth: share
    at the last pixel read over that in the middle, less 1. beyond: what the next pixels have beyond such a
    tail, as shares of what is left of the charge, which traps of several kinds make of it."""

    axis: int
    share: float
    length: float
    growth: float
    beyond: tuple[float, ...] = ()


def shifted_out(x: Float[np.ndarray, "n h w"], by: Deferred) -> Float[np.ndarray, "n h w"]:
    """Images of charge as it comes out; what was read before the first line was as bright as that."""
    return _through(x, by, back=False)


def put_back(x: Float[np.ndarray, "n h w"], by: Deferred) -> Float[np.ndarray, "n h w"]:
    """Images of charge as it was before `shifted_out`."""
    return _through(x, by, back=True)


def _through(x: Float[np.ndarray, "n h w"], by: Deferred, back: bool) -> Float[np.ndarray, "n h w"]:
    lines = np.moveaxis(x.astype(np.float64), 1 + by.axis, 0)
    lines = lines[::-1] if by.share < 0 else lines
    place = np.linspace(-1, 1, len(lines)) if len(lines) > 1 else np.zeros(1)
    left, stays = abs(by.share) * (1 + by.growth * place), np.exp(-1 / by.length)
    out = np.empty_like(lines)
    out[0] = lines[0]
    held = left[0] * lines[0] / (1 - stays)
    more = [(n, part) for n, part in enumerate(by.beyond, 1) if part]
    before = out if back else lines
    for k in range(1, len(lines)):
        late = (1 - stays) * held
        for n, part in more:
            at = max(k - n, 0)
            late = late + part * (1 + by.growth * place[at]) * (1 - left[at]) * before[at]
        out[k] = (lines[k] - late) / (1 - left[k]) if back else (1 - left[k]) * lines[k] + late
        held = stays * held + left[k] * (out[k] if back else lines[k])
    out = out[::-1] if by.share < 0 else out
    return np.moveaxis(out, 0, 1 + by.axis).astype(np.float32)


def taken_back(fields: tuple[Fields, ...], score: Score[Deferred]) -> tuple[Fields, ...]:
    """The fields without the tails of what stands out of the noise, and without what neighbours share of the
    shot noise. The read noise was not shifted, and stays as it is."""
    return tuple(_without(f, score.payload) for f in fields)


def _without(field: Fields, by: Deferred) -> Fields:
    charge = np.sqrt(np.clip(field.shot, 0, 1)).astype(np.float32)
    sigma = field.sigma.astype(np.float32)

    def late(x: Float[np.ndarray, "n h w"]) -> Float[np.ndarray, "n h w"]:
        """What of it came out late, or is missing for that."""
        return x - put_back(x * sigma, by) / sigma

    def back(x: Float[np.ndarray, "n h w"]) -> Float[np.ndarray, "n h w"]:
        far = np.where(np.abs(x) > _STANDS_OUT, x, np.float32(0))
        moved = late(far)
        if charge.any():
            moved = moved + charge * late(charge * (x - far))
        return (x - field.usable * moved).astype(np.float32)

    if field.kind == "scene" and field.static is not None:  # against a reference that was not shifted
        tail = (shifted_out(field.signal[None], by)[0] - field.signal) * field.weight
        static = field.static - np.float32(np.sqrt(field.frames)) * tail
        field = field._replace(static=static.astype(np.float32))
    return map_contrasts(field, back)
