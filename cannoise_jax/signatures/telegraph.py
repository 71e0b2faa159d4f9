"""Pixels that jump between two levels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

from cannoise_jax.physics.robust import median
from cannoise_jax.signatures.added import as_map, placed
from cannoise_jax.signatures.blinking import (
    NONE_EXPECTED,
    Expected,
    blinking,
    blinking_again,
    blinking_map,
)
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.handed import Addition, Asked, Found, Many
from cannoise_jax.signatures.heat import above_neighbours
from cannoise_jax.signatures.hot import mask_off
from cannoise_jax.signatures.known_shape import darks
from cannoise_jax.signatures.least import Law, Seen
from cannoise_jax.signatures.multiplicity import SHARED
from cannoise_jax.signatures.rare import (
    FAR_JUMPS,
    MEAN_JUMPS,
    jump_log_ratio,
    sparse_log_p,
    spread_of,
)
from cannoise_jax.signatures.returning import returning_log_p
from cannoise_jax.signatures.score import LEAST_LOG_P, Score
from cannoise_jax.signatures.signature import BLINKING, NO_LAW, Axes, Signature
from cannoise_jax.signatures.sparse import telegraph_amplitude, telegraph_found
from cannoise_jax.signatures.squares import (
    LOOKED_AT,
    READS,
    dark_sigma,
    histogram,
    mask_noisy,
    square_map,
)

_START = 0.005
"""Share of the pixels from which that of a mixture is fitted. From a tenth or ten times as many (1 % of 96 x
128 pixels jumping) 40 rounds gain the same to 0.1 nats."""


def _gained(counts: np.ndarray, centre: np.ndarray, n: int) -> float:
    """Nats that jumps of sizes spread exponentially gain, in the share and of the mean of most likelihood.
    counts, centre: of sums of squares, see `histogram`."""
    best = 0.0
    for mean in MEAN_JUMPS:
        mixed, f = jump_log_ratio(centre, n, mean), _START
        for _ in range(40):
            responsibility = f * np.exp(mixed) / (1 - f + f * np.exp(mixed))
            f = float(np.clip(np.sum(counts * responsibility) / counts.sum(), 1e-6, 0.3))
        best = max(best, float(np.sum(counts * np.log1p(f * np.expm1(mixed)))))
    return best


class Restless(NamedTuple):
    """Whether most of the pixels that stand out in the mean jump, and what is expected of those that do."""

    mostly: bool
    pixels: Expected


def telegraph_again(fields: Many, found: Score[Restless]) -> Score[Restless] | None:
    """Other frames: how much of the variance that those which found the pixels expect of each shows again,
    and the nats by which their frames lie on levels as far apart."""
    told = blinking_again(fields, found.payload.pixels)
    if told is None:
        return telegraph_score(tuple(fields))
    score = _noticed(tuple(fields))
    if score is None:
        return None
    share, error, gain = told
    root = float(np.sqrt(max(share, 0.0)))
    amplitude = found.amplitude * root
    doubt = found.amplitude * error / (2 * max(root, float(np.sqrt(error)), 1e-12))
    return found.replace(
        log_p=score.log_p, gain=gain, penalty=score.penalty, shift=score.shift, amplitude=amplitude,
        error=float(np.hypot(doubt, found.error * root)),
    )  # fmt: skip


def telegraph_score(fields: tuple[Fields, ...]) -> Score[Restless] | None:
    """A small share of pixels with extra fluctuation. What speaks for it is that of sizes spread
    exponentially; share, jump and strength are those of the pixels whose frames lie on levels, none where
    nothing speaks for it."""
    score = _noticed(fields)
    if score is None or not score.log_p < np.log(SHARED.candidate):
        return score
    told = blinking(fields)
    if told is None:
        return score
    return score.replace(
        payload=score.payload._replace(pixels=told.pixels),
        amplitude=told.rms[0],
        error=told.rms[1],
        parameters={
            "fraction": (told.share[0], "1", told.share[1]),
            "jump": (told.jump[0], "DN", told.jump[1]),
        },
    )


def _noticed(fields: tuple[Fields, ...]) -> Score[Restless] | None:
    """What speaks for pixels that jump, by how noisy pixels are, without asking which do and by how much."""
    found = square_map(fields)
    if found is None:
        return None
    whole, usable, n = found
    squares = whole[usable]
    counts, centre = histogram(squares)
    ratios = [jump_log_ratio(centre, n, mean) for mean in FAR_JUMPS]
    number = int(np.sum(squares > stats.chi2.isf(1e-5, n)))
    log_p = sparse_log_p(counts, ratios)
    # Rare events make other pixels noisy the next time.
    returning = returning_log_p(fields, usable) if log_p < LOOKED_AT else None
    if returning is not None:
        log_p = max(log_p, returning)
    sigma = dark_sigma(tuple(darks(fields)))
    shift = float(sigma * np.sqrt(np.sqrt(2 / n / squares.size)))
    return Score(
        log_p=max(log_p, LEAST_LOG_P),
        payload=Restless(_restless(fields, whole, usable, n), NONE_EXPECTED),
        gain=_gained(counts, centre, n),
        penalty=float(np.log(squares.size)),
        amplitude=0.0,
        error=shift,
        shift=shift,
        power=2,
        parameters={"fraction": (0.0, "1", 1 / squares.size), "jump": (sigma, "DN", sigma)},
        where={"axis": "pixel", "pixels": number},
    )


_FEW, _FAR = 10, 4.0
"""Pixels that stand out in the mean from which on they are looked at together, and by how many standard
deviations they do."""
_RESTLESS = 1.5
"""Variance of the typical one of them, over what noise and the shot noise of its charge make, from which on
they jump: of fixed ones it is one, of those that are in either level half of the time two and more."""


def _restless(
    fields: tuple[Fields, ...],
    squares: Float[np.ndarray, "h w"],
    usable: Bool[np.ndarray, "h w"],
    freedom: int,
) -> bool:
    """Whether most of the pixels that stand out in the mean of the darks vary more than their charge lets
    them: a jump of which half is in the mean is as large in the noise. squares, usable, freedom: see
    `square_map`."""
    sums = above_neighbours(fields, "additive")
    if sums is None:
        return False
    u = np.where(sums.information > 0, sums.score / np.sqrt(np.maximum(sums.information, 1e-30)), 0.0)
    off = usable & (u > _FAR * spread_of(u[usable]))
    if off.sum() < _FEW:
        return False
    return bool(median(squares[off]) > _RESTLESS * stats.chi2.median(freedom))


def mask_jumping(fields: Many, score: Score[Restless]) -> Many:
    """Takes the pixels that jump out, and where most of those that stand out in the mean do, all of these:
    some have not jumped in as few frames."""
    left = mask_noisy(fields, score)
    return mask_off(left) if score.payload.mostly else left


_OWN = 0.3
"""Evidence of jumps over that of fixed offsets, from which on both are of the same pixels: those that
jump are off in the mean too. It is half for jumps of 3 to 9 standard deviations, none for fixed offsets."""


def simulated(found: Found) -> Addition:
    """Pixels that are in either level half of the time, at their places; the pattern is half of each jump, or
    what has its variance."""
    jump, share = (found.score.parameters[k][0] for k in ("jump", "fraction"))
    sites = {} if found.pattern is None else {"sites": as_map(found.pattern / (jump / 2))}
    return Addition({"jump_dn": jump, "fraction": share, "rate": 0.5}, sites)


def jumping(
    *, name: str, mechanism: str, covers: tuple[str, ...], fixed: str, growing: str, imprints: tuple[str, ...]
) -> Signature:
    """A few pixels that jump between levels. fixed, growing: signatures of pixels that stand out in the mean,
    whatever the exposure and with it; the evidence of the first is of the jumps too, where they are enough to
    make it, and that of `imprints`, what such pixels leave in means, where most of them jump."""

    def readings(score: Score[Restless], scores: Mapping[str, Score]) -> tuple[tuple[str | None, float], ...]:
        off = scores[fixed].evidence if fixed in scores else 0.0
        warm = scores[growing].evidence if growing in scores else 0.0
        more = [max(off, 0.0)] if off > warm and score.evidence > _OWN * off else []
        if score.payload.mostly:
            more = [max(off, warm), *(max(scores[n].evidence, 0.0) for n in imprints if n in scores)]
        return ((mechanism, score.evidence + sum(more)),)

    def detectable(asked: Asked, score: Score, mechanism: str) -> float:
        frames: dict[int, int] = {}
        for f in (f for fields in asked.looks for f in darks(fields)):
            frames[f.number] = frames.get(f.number, 0) + f.frames
        seen = darks(asked.looks[0])
        sigma = float(np.mean([median(f.sigma) for f in seen])) if seen else 0.0
        return telegraph_found(tuple(frames.values()), sigma, asked.looks[0][0].mean.size, asked.own_log_p)

    def least(sets: tuple[Seen, ...]) -> Law:
        frames = [(float(np.sqrt(np.mean(s.weight**2))), round(s.fresh)) for s in sets]
        return lambda shift: telegraph_amplitude(frames, sets[0].weight.size, shift)

    return Signature(
        name=name,
        axes=Axes("readout", "pixel", BLINKING.time, "additive", "two levels"),
        reads=READS,
        score=telegraph_score,
        absorb=mask_jumping,
        covers=covers,
        rare=True,
        predict=NO_LAW,
        pattern=lambda fields, score, rng: blinking_map(fields),
        simulate=simulated,
        place=placed(BLINKING),
        again=telegraph_again,
        detectable=detectable,
        readings=readings,
        decides=True,
        least=least,
    )
