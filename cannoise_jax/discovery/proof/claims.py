"""What a name says beside how strong it is: that a pattern is the same in every recording, that pixels have
two levels, that lines have nothing of the frame before. Each is a statistic whose scale does not grow with
the strength of the mechanism, and is held to its own effect size: however much of the mismatch a name takes
away, in nats, it is not true of a pattern that other recordings have not got.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float

from cannoise_jax.discovery.compare.compared import Compared
from cannoise_jax.discovery.compare.families import (
    IN_ONE_FRAME,
    LEVELS,
    NEXT_LINES,
    TAILS,
    TEMPORAL,
    UNSTEADY,
    of,
)
from cannoise_jax.discovery.compare.measure import of_sets
from cannoise_jax.discovery.compare.moves import LINE_LAGS
from cannoise_jax.discovery.compare.table import lines_of
from cannoise_jax.discovery.proof.own_part import Borne, drawn_structures, own_part
from cannoise_jax.discovery.search.name import UNKNOWN, Doubt
from cannoise_jax.discovery.search.steps import Step
from cannoise_jax.physics.robust import median
from cannoise_jax.signatures import bank
from cannoise_jax.signatures.events import by_exposure
from cannoise_jax.signatures.fields import Fields, channel_index, quoted_at

_SHARED = 0.5
"""Share of a pattern's variance that recordings have in common, below which it is not the same in all."""
_SURE = 4.0
"""Standard deviations from which on that is no chance."""
_SHOWN = 0.05
"""Share of the noise of a recording's mean that the pattern has there, from which on it says whether the
pattern is in it. Other patterns correlate by some 0.02 with it (dark current of the KAF-1001E with its PRNU):
there that is less than half of the pattern; where it has 0.0005, as dark current in a flat of 23 s, far more.
"""
_FEWEST = 32
"""Lines or pixels from which on that is told."""
_OF_LEVEL = 0.25
"""Share of what scenes are off by that follows the signal, from which on it is no error of each pixel."""
_OF_ONE_LEVEL, _LEVELS = 64, 256
"""Pixels of like signal, at least, and so many levels at most: twice over what a wave of 64 periods needs."""
_FAR = 4.0
"""Standard deviations at which what a pixel is off by is cut: far ones would stand for all of their level."""
_MORE_LEVELS = 0.25
"""Share of the pixels that jump which leave more than pixels of two levels do. Two levels 3 to 9 standard
deviations apart, of any share of time, or apart by an exponential law, are within 0.1 of one size of jump (6
to 12 frames); three levels, 3 to 6 standard deviations from one to the next, lie at 0.31 to 0.96."""
_CHANCE = 1e-3
"""Probability of that share by chance (Smirnov)."""
_FEWEST_PIXELS = 20
"""Pixels that jump, recorded and drawn, below which nothing is told of their levels."""
_GROWS, _NO_PROPORTION = 0.01, 1e-4
"""Chance of hits that come as often at every exposure below which they grow with it, as those of particles do
beside what a slow read-out takes up, and of hits in proportion to it below which they are not."""
_REMEMBERED, _REMEMBERED_Z = 0.25, 4.0
"""Correlation of lines with those of the frame before, beyond what the simulator has, and the standard
deviations from which on that is no chance: six correlations are looked at for each name."""
FAR_OUT = (of(TEMPORAL, TAILS), UNSTEADY, IN_ONE_FRAME, LEVELS)
"""Families that count values far out, of single frames and of pixels."""
_OF_EVIDENCE = 0.02
"""Share of the evidence for a name, in nats, from which on what differs of such values may be what it was
found by. Of what passed for charge of the clocking, 17,000 nats of steps of one size, all was left."""


def lasting(step: Step) -> Doubt | None:
    """What speaks against a step that names a pattern that stays: that recordings share little of it.
    Products of different recordings hold the pattern alone, squares whatever else is in their means."""
    signature, score = step.named.signature, step.named.score
    axes = signature.axes
    if step.named.mechanism == UNKNOWN or (axes.time, axes.law) != ("frozen", "white"):
        return None
    if axes.scales not in ("additive", "codes", "signal", "exposure"):
        return None
    if axes.varies_over not in ("row", "column", "pixel"):
        return None
    # What grows with the exposure is quoted at the longest, and told per second.
    longest = quoted_at(step.before, axes.scales)
    claimed = (score.amplitude / longest) ** 2 if longest else 0.0
    sums = []
    # Of a pattern that multiplies the light darks hold nothing.
    told = [f for f in step.before if f.static is not None and (f.lit or axes.scales != "signal")]
    for field in told:
        seconds = quoted_at((field,), axes.scales)
        one = score.replace(amplitude=score.amplitude * seconds / longest) if seconds and longest else None
        found = signature.predict((field,), one) if one is not None else None
        if found is None or found.pattern is None or claimed <= 0:
            continue
        doubt = np.broadcast_to(np.asarray(found.doubt, np.float64), np.shape(found.pattern)).ravel()
        doubt = np.maximum(doubt, 1e-9 * claimed)
        own = np.ravel(found.pattern) / doubt, np.maximum(1 / doubt - 1 / claimed, 0.0)
        if median(own[1]) * claimed < _SHOWN:
            continue
        sums.append((field.lit, *_apart(*own, _channels(field, np.shape(found.pattern)))))
    if len(sums) < 2:
        return None
    lit, *each = (np.array(v) for v in zip(*sums, strict=True))
    dark_and_lit = [(v[lit].sum(0), v[~lit].sum(0)) for v in each]
    # Darks alone may be of one level, which to each column of a converter's errors is one place.
    pairs = {
        "recordings": _of_pairs(*each),
        "darks and flats": tuple(a * b for a, b in dark_and_lit),
    }
    for what, (product, weight) in pairs.items():
        used = weight > 0
        if used.sum() < _FEWEST:
            continue
        common = float(product[used].sum() / weight[used].sum())
        error = float(np.sqrt(np.sum((product - claimed * weight)[used] ** 2)) / weight[used].sum())
        if common > _SHARED * claimed or claimed - common < _SURE * error:
            continue
        share = 1 - max(common, 0.0) / claimed
        said = f"{what} have {100 * (1 - share):.0f} % of the pattern in common: it does not stay"
        return Doubt(share, (said,), instead=True)
    return None


def _channels(field: Fields, shape: tuple[int, ...]) -> np.ndarray:
    """What the places of a pattern share but for the pattern: the site of a pixel, nothing of a line."""
    whole = shape == field.mean.shape
    return channel_index(field.mean.shape).ravel() if whole else np.zeros(int(np.prod(shape)), int)


def _apart(
    score: Float[np.ndarray, "k"], information: Float[np.ndarray, "k"], alike: np.ndarray
) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k"]]:
    """Both without what all places have in common, which is a level and no pattern: rare values of one sign
    lift the means of all pixels, in every recording."""
    level = np.bincount(alike, score) / np.maximum(np.bincount(alike, information), 1e-300)
    return score - level[alike] * information, information


def _of_pairs(
    score: Float[np.ndarray, "r k"], information: Float[np.ndarray, "r k"]
) -> tuple[Float[np.ndarray, "k"], Float[np.ndarray, "k"]]:
    """Products of the scores of different recordings, summed over the pairs, and of a pattern of
    variance one."""
    first, second = ((v.sum(0) ** 2 - (v**2).sum(0)) / 2 for v in (score, information))
    return first, second


def by_level(step: Step) -> Doubt | None:
    """What speaks against a step that names errors of each reference, which know nothing of the signal: that
    those of pixels of one signal are alike, wherever they lie. Products of the means of two halves of such
    pixels hold what they share alone."""
    axes = step.named.signature.axes
    if step.named.mechanism == UNKNOWN or (axes.time, axes.law, axes.scales) != ("frozen", "white", "scene"):
        return None
    rng, products, numbers = np.random.default_rng(0), [], []
    for field in step.before:
        if field.kind != "scene" or field.static is None:
            continue
        kept = field.usable
        off = (np.asarray(field.static, np.float64) * field.sigma)[kept] / np.sqrt(field.frames)
        bins = min(off.size // _OF_ONE_LEVEL, _LEVELS)
        if bins < 2:
            continue
        level = np.empty(off.size, int)
        level[np.argsort(field.signal[kept], kind="stable")] = np.arange(off.size) * bins // off.size
        half = rng.integers(0, 2, off.size)
        # Far ones would stand for all of their level.
        limit = _FAR * float(np.sqrt(np.mean(off**2)))
        values = np.clip(off - off.mean(), -limit, limit)
        first, second = (
            np.bincount(level[half == h], values[half == h], bins)
            / np.maximum(np.bincount(level[half == h], minlength=bins), 1)
            for h in (0, 1)
        )
        products.append(first * second)
        numbers.append(np.bincount(level, minlength=bins))
    claimed = step.named.score.amplitude**2
    if not products or claimed <= 0:
        return None
    product, number = np.concatenate(products), np.concatenate(numbers)
    alike = float(product @ number / number.sum())
    error = float(np.sqrt(np.sum((product * number) ** 2)) / number.sum())
    share = min(alike / claimed, 1.0)
    if share < _OF_LEVEL or alike < _SURE * error:
        return None
    what = f"{100 * share:.0f} % of it is alike wherever the signal is: a curve of the signal, not of places"
    return Doubt(share, (what,), instead=True)


def whatever_exposure(step: Step) -> Doubt | None:
    """What speaks against a name for hits that grow in number with the exposure, whatever they look like: as
    many in short darks as in long ones, as those of the read-out or of its surroundings."""
    axes = step.named.signature.axes
    claimed = (axes.time, axes.law, axes.scales) == ("redrawn", "sparse", "exposure")
    if step.named.mechanism == UNKNOWN or not claimed:
        return None
    same, proportional = by_exposure(step.before)
    if same < np.log(_GROWS) or proportional > np.log(_NO_PROPORTION):
        return None
    return Doubt(1.0, ("there are as many in short darks as in long ones",), instead=True)


def two_levels(whole: Compared) -> Doubt | None:
    """What speaks against a name for pixels that jump between two levels: that many leave more than that."""
    recorded, simulated = np.zeros(1), np.zeros(1)
    for name, measured in whole.recorded.items():
        sets = of_sets(whole.simulated[name], LEVELS)
        if LEVELS in measured.families and sets:
            recorded = recorded + measured.families[LEVELS].values.sum(0)
            simulated = simulated + np.sum([s.values for s in sets], (0, 1))
    number = [float(v.sum()) for v in (recorded, simulated)]
    if min(number) < _FEWEST_PIXELS:
        return None
    more = float(np.max(np.cumsum(simulated) / number[1] - np.cumsum(recorded) / number[0]))
    if more < _MORE_LEVELS or np.exp(-2 * more**2 / (1 / number[0] + 1 / number[1])) > _CHANCE:
        return None
    said = f"{100 * more:.0f} % of the pixels that jump have more than two levels"
    return Doubt(more, (said,), instead=True)


def empty(whole: Compared, each: list[Borne], step: Step) -> Doubt | None:
    """What speaks against a name for rare values far out, of much evidence, whose draws move nothing of such
    values, where they differ: what stands out is then of another size, or comes otherwise."""
    signature = step.named.signature
    if not signature.rare or signature.frozen or any(b.own.any() for b in each):
        return None
    left = [(j, j.found) for j in whole.judgements if j.family in FAR_OUT and j.where in whole.seen]
    left = [(j, found) for j, found in left if found.size]
    nats = sum(float(np.sum(j.z[found] ** 2)) / 2 for j, found in left)
    if not left or nats < _OF_EVIDENCE * step.named.score.gain:
        return None
    return Doubt(1.0, tuple(lines_of(whole, left)[:3]))


_MEMORIES = np.linspace(-0.98, 0.98, 99)


def memory(correlation: Float[np.ndarray, "k"], frames: int) -> Float[np.ndarray, "k"]:
    """What of each frame the next one has, an autoregression of order one, told by the correlation of one
    with the next once the mean of so many is out of them: of independent frames that is -1 / (frames - 1).
    None of two, which are each other's reverse then."""
    return np.zeros_like(correlation) if frames < 3 else np.interp(correlation, _seen(frames), _MEMORIES)


@lru_cache
def _seen(frames: int) -> list[float]:
    """The correlation that each of `_MEMORIES` leaves of so many frames."""
    at = np.arange(frames)
    centred = np.eye(frames) - 1 / frames
    each = [centred @ m ** np.abs(at[:, None] - at) @ centred for m in _MEMORIES]
    return [float(np.trace(c, 1) / (frames - 1) / (np.trace(c) / frames)) for c in each]


def forgetful(whole: Compared, each: list[Borne]) -> Doubt | None:
    """What speaks against a name for lines that are redrawn: that they have much of the frame before, or of
    its reverse. each: what the mechanism bears on."""
    lines = [np.zeros(2, bool)]
    where = []
    for b, cells in drawn_structures(each):
        moved = cells.reshape(bank.counts(whole.seen[b.judged.where].size).shape)
        lines.append(np.array([moved[:, :-1, -1].any(), moved[:, -1, :-1].any()]))
        where.append(b.judged.where)
    mine = np.repeat(np.any(lines, 0), len(LINE_LAGS))
    found = [j for j in whole.judgements if j.family == NEXT_LINES and j.where in where]
    if not found or not mine.any():
        return None
    z = np.sum([j.z for j in found], 0) / np.sqrt(len(found))
    more = np.mean([j.recorded - j.simulated for j in found], 0)
    # Of the same lines the mean of few frames takes most of what they remember.
    frames = [whole.seen[j.where].frames for j in found]
    kept = [memory(j.recorded, n) - memory(j.simulated, n) for j, n in zip(found, frames, strict=True)]
    same = np.tile(np.array(LINE_LAGS) == 0, 2)
    more = np.where(same, np.mean(kept, 0), more)
    told = mine & (np.abs(z) > _REMEMBERED_Z) & (np.abs(more) > _REMEMBERED)
    if not told.any():
        return None
    k = int(np.argmax(np.where(told, np.abs(more), 0)))
    part = own_part(each)
    side = "rows" if k < len(LINE_LAGS) else "columns"
    does = "remember" if more[k] > 0 else "turn over what they were in"
    said = f"{side} {does} the frame before: a correlation of {more[k]:.2f} beyond the simulator's"
    return Doubt(part.after / max(part.before, 1e-9), (said,), instead=True)
