"""Whether noisy pixels jump between levels, or merely have more noise than the others.

A sum of squares says how noisy a pixel is, not how. Of every noisy one two laws of its frames are compared,
which have the same variance: normal noise of its own, and the noise of the other pixels, or somewhat more, at
two levels, or at the three of two traps alike. Both have the mean of each recording's frames free; the levels
have one number more, their distance.

Whatever its noise, a normal pixel's frames over their own standard deviation have one law, which does not
depend on that standard deviation (Basu's theorem): that the pixels were chosen by it changes nothing.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats

from cannoise_jax.signatures.charge_noise import by_charge, own_charge
from cannoise_jax.signatures.fields import Fields, each_frame
from cannoise_jax.signatures.handed import Many
from cannoise_jax.signatures.known_shape import darks

CHANCE = 1e-4
"""Share of the pixels alike that are as noisy as those that count as noisy."""
_FEWEST, _FRAMES = 10, 4
"""Noisy pixels, and frames of a dark, from which on they are looked at."""
_MOST = 1_000_000
"""Values of noisy pixels that are looked at."""
_MOST_NATS = 5.0
"""What one pixel may count: a few of three levels or more speak for noise by hundreds of nats."""
_SURE = 2.0
"""Standard errors by which the mean must speak for noise. Of darks of 8 to 30 frames it is -0.3 to -1.7 nats
of normal noise and 1.8 to 2.7 of two levels; of two traps alike 0 to 0.7."""
_HIGH = (0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.95)
"""Shares of the time in the higher of two levels that are tried."""
_HIGH_OF_TWO = (0.3, 0.5, 0.7)
"""The same of each of two traps."""
_BASE = (1.0, 1.7)
"""Variances within a level, over that of most pixels, that are tried."""
_OFFSETS = 16
"""Places of the mean between the levels that are tried."""


def merely_noisy(
    fields: Many, squares: Float[np.ndarray, "h w"], usable: Bool[np.ndarray, "h w"], freedom: int
) -> bool:
    """Whether the frames of the noisy pixels speak for normal noise. squares, usable, freedom: see
    `squares.square_map`. False where too few are noisy to tell."""
    seen = [f for f in darks(tuple(fields)) if f.frames >= _FRAMES]
    if not seen:
        return False
    noisy = np.flatnonzero(usable & (squares > stats.chi2.isf(CHANCE, freedom)))
    if noisy.size < _FEWEST:
        return False
    most = max(_MOST // sum(f.frames for f in seen), _FEWEST)
    noisy = noisy[:: -(-noisy.size // most)]
    frames = [
        (x - x.mean(0)) * np.sqrt((len(x) - 1) / len(x))
        for x in frames_of(seen, noisy, own_charge(tuple(fields)))
    ]
    each = np.clip(jumps_over_noise(frames), -_MOST_NATS, _MOST_NATS)
    return bool(np.mean(each) < -_SURE * np.std(each) / np.sqrt(each.size))


def frames_of(
    seen: list[Fields], pixels: Int[np.ndarray, "k"], charge: Float[np.ndarray, "h w"] | None
) -> list[Float[np.ndarray, "t k"]]:
    """Of every dark the frames of some pixels, by number, in units of the noise that their charge leaves."""
    out = []
    for f in seen:
        noise = np.broadcast_to(np.sqrt(by_charge(f, charge)), f.mean.shape).ravel()[pixels]
        out.append(np.stack([frame.ravel()[pixels] for frame in each_frame(f, static=False)]) / noise)
    return out


def jumps_over_noise(frames: list[Float[np.ndarray, "t k"]]) -> Float[np.ndarray, "k"]:
    """Log-likelihood of levels over that of normal noise, of every pixel. frames: of each recording, about
    their mean, in units of the noise of most pixels."""
    freedom = sum(len(x) - 1 for x in frames)
    variance = np.maximum(sum(np.sum(x**2, 0) for x in frames) / freedom, 1.0)
    normal = -0.5 * freedom * (np.log(variance) + 1)
    best = np.full(variance.shape, -np.inf)
    for base in _BASE:
        for traps, shares in ((1, _HIGH), (2, _HIGH_OF_TWO)):
            for share in shares:
                jump = np.sqrt(np.maximum(variance - base, 0) / (traps * share * (1 - share)))
                levels = stats.binom.logpmf(np.arange(traps + 1), traps, share)
                best = np.maximum(best, sum(at_levels(x, jump, levels, base) for x in frames))
    return best - normal - 0.5 * np.log(freedom)


def at_levels(
    x: Float[np.ndarray, "t k"],
    jump: Float[np.ndarray, "k"] | float,
    levels: Float[np.ndarray, "n"],
    base: float,
    kept: Bool[np.ndarray, "t k"] | None = None,
    most: int = _OFFSETS,
) -> Float[np.ndarray, "k"]:
    """Log-likelihood of frames about their mean, which lies at the likeliest place between the levels.
    levels: log share of the time in each. kept: frames that count, all where not given. most: places that
    are tried."""
    best, number = np.full(x.shape[1], -np.inf), len(x) if kept is None else kept.sum(0)
    steps = min(most, (levels.size - 1) * len(x))
    for place in np.linspace(0, levels.size - 1, steps + 1):
        each = [w - 0.5 * (x + (place - n) * jump) ** 2 / base for n, w in enumerate(levels)]
        told = np.logaddexp.reduce(each)
        best = np.maximum(best, np.sum(told if kept is None else np.where(kept, told, 0.0), 0))
    return best - 0.5 * number * np.log(base)
