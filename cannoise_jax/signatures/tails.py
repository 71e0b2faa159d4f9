"""One-sided tails behind pixels that stand out: charge that a CCD leaves behind where it is shifted.

The noise of a frame is as much alike in one direction as in the other, whatever made it so: only what stands
out, a hot pixel, one that a particle hit or one that does not respond, tells behind from before. Of each the
profile on one side is held against that on the other, less the same of the lines beside it, in units of its
own height. Whatever spreads charge evenly (coupling, diffusion), and what lies near by chance, hits both
sides alike, so that the sign of such a difference is a toss of a coin: a sum of odd functions of them over
its own root mean square exceeds a limit less often than 3.18 times as often as a normal value does (Bentkus
and Dzindzalieta, A tight Gaussian bound for weighted sums of Rademacher random variables, Bernoulli 21, 1231
(2015)), whatever the law of the differences and however few they are.

Pixels that stand out and always have a weaker one on the same side would look the same: but no more than a
few of all do, and the shot noise of flats, which passes the same traps, is then not alike along the lines.
"""

from __future__ import annotations

from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import stats

from cannoise_jax.physics.robust import median
from cannoise_jax.signatures.added import strength
from cannoise_jax.signatures.deferred import Deferred, taken_back
from cannoise_jax.signatures.handed import Found, Many
from cannoise_jax.signatures.lag_sums import LAGS, lag_sums
from cannoise_jax.signatures.plain import plain
from cannoise_jax.signatures.score import LEAST_LOG_P, ONE_OF_SEVERAL, ONE_PARAMETER, Score
from cannoise_jax.signatures.signature import CONTRASTS, STATIC, Axes, Signature
from cannoise_jax.signatures.tops import NOISE, REACH, TOPS, Tops

_LENGTHS = (0.3, 1.0, 2.5, 6.0)
"""Pixels, of the tails that are tried."""
_SCATTER = (0.005, 0.02, 0.08)
"""Standard deviations, beside that of noise, that are tried of the first share of a tail."""
_LEAST_SCATTER = 1e-3
"""And the least that is: a fifth of the smallest that is tried."""
_LEAST = 16
"""Pixels that stand out from which on it can be told: the sum of so many over its root mean square is 4 at
most."""
_FIVE = 5.0
"""Standard deviations by which what is detectable moves a statistic (`Score.shift`)."""
_MOST_LEFT = 0.45
"""Share left behind beyond which the tail is no smaller than what it is of."""
_BOUND = 3.18
"""By which the bound is above the chance of a normal value, 1 / (4 P(Z > sqrt 2)): no smaller factor holds
for all sums of random signs (Bentkus and Dzindzalieta, Bernoulli 21, 1231 (2015))."""
_ODD = 4.0
"""Standard deviations beyond which a difference is another one's: it counts for nothing."""
_TYPICAL = 0.3
"""Share of what all pixels tell that those tell at least which have the tail: it is in all, not in a few."""
_FIRST = 0.5
"""Of what a tail has at any distance, what it has at the first at least."""
_LIKELY = 1e-3
"""Chance of such tails without a cause below which flats are asked too."""
_PASSES = 0.15
"""Share of the correlation that this tail would give the shot noise of flats at least: full traps hold
less."""
_SURE = 3.0
"""Standard errors from which on the growth along the lines, or another form, is told."""


class _Differences(NamedTuple):
    """Of every pixel that stands out: differences of both sides at every distance, shares of its height
    `[n, k]`, their standard error by noise `[n]` and its place along the lines, -1 to 1 `[n]`."""

    share: Float[np.ndarray, "n k"]
    error: Float[np.ndarray, "n"]
    place: Float[np.ndarray, "n"]


def _differences(fields: Many, axis: int) -> _Differences | None:
    """One of every pixel, of all recordings together: in these its neighbours are the same."""
    found = [t for f in fields if f.kind != "scene" and (t := TOPS[axis](f)).place.size]
    if not found:
        return None
    every = Tops(*(np.concatenate(part) for part in zip(*found, strict=True)))
    pixels, of = np.unique(every.place, return_inverse=True)
    products, power = np.zeros((pixels.size, REACH)), np.bincount(of, every.power)
    np.add.at(products, of, every.products)
    size = fields[0].mean.shape
    line = pixels % size[1] if axis else pixels // size[1]
    return _Differences(
        products / power[:, None], np.sqrt(NOISE / power), 2 * line / max(size[axis] - 1, 1) - 1.0
    )


def _tail(length: float | np.ndarray) -> np.ndarray:
    """A tail of this length over the distances, 1 at the first."""
    return np.exp(-np.arange(REACH) / length)


class _Told(NamedTuple):
    """What pixels that stand out tell of a tail of one length: log p, the mean tail `[k]` and its scatter
    beside noise."""

    log_p: float
    tail: Float[np.ndarray, "k"]
    scatter: float


def _told(seen: _Differences, length: float, scatter: float) -> _Told:
    """Of tails of this length, which scatter by so much beyond the noise; what lies far out of the others
    counts for nothing (Tukey's biweight)."""
    variance = seen.error**2 + scatter**2
    middle = median(seen.share[variance <= median(variance)], 0)
    limit = _ODD * np.sqrt(variance)[:, None] + 2 * np.abs(middle)
    near = seen.share * np.maximum(1 - np.square(seen.share / limit), 0.0) ** 2
    tail = _tail(length)
    first = near @ tail / float(np.sum(tail**2))
    pull = first / variance
    root = float(np.sqrt(np.sum(pull**2)))
    if not root:
        return _Told(0.0, 0 * tail, scatter)
    log_p = float(np.log(2 * _BOUND) + stats.norm.logsf(abs(float(np.sum(pull))) / root))
    return _Told(min(log_p, 0.0), float(np.sum(pull) / np.sum(1 / variance)) * tail, scatter)


class _Held(NamedTuple):
    """The tail that most pixels have `[k]`, the variance of its error `[k]`, and the weight in it of every
    pixel `[n, k]`. inside: share of the pixels, by what they tell, that are in it at the first distance."""

    tail: Float[np.ndarray, "k"]
    variance: Float[np.ndarray, "k"]
    weight: Float[np.ndarray, "n k"]
    inside: float


def _held(seen: _Differences, told: _Told) -> _Held:
    """The tail about which pixels scatter by as much as most of them do."""
    noise = seen.error[:, None] ** 2
    tail, scatter = told.tail, np.full(REACH, told.scatter**2)
    for _ in range(20):
        variance = noise + scatter
        off = np.square(seen.share - tail)
        weight = np.maximum(1 - off / (_ODD**2 * variance), 0.0) ** 2 / variance
        total = np.maximum(np.sum(weight, 0), 1e-30)
        tail = np.sum(weight * seen.share, 0) / total
        scatter = np.clip(np.sum(weight * (off - noise), 0) / total, _LEAST_SCATTER**2, told.scatter**2)
    error = np.sum(weight**2 * np.maximum(np.square(seen.share - tail), noise), 0) / total**2
    return _Held(tail, error, weight, float(np.sum(weight[:, 0]) / np.sum(1 / variance[:, 0])))


def _echoes(held: _Held, told: _Told) -> bool:
    """Whether pixels show again some way off, and not behind: a tail is highest at the first distance."""
    tail = np.sign(told.tail[0]) * held.tail
    return bool(np.any(tail - tail[0] / _FIRST > _SURE * np.sqrt(held.variance)))


def tail_score(fields: Many, *, axis: int) -> Score[Deferred] | None:
    """Tails along columns (axis 0) or rows (1). Amplitude: share of the charge that comes out late, of a
    pixel in the middle; below 0 in the parameters where it comes out above, or on the left. None where too
    few pixels stand out to tell, and where they have a tail that the shot noise of flats has not: it may be
    of the pixels that stand out, or of charge that traps let go one by one."""
    seen = _differences(fields, axis)
    if seen is None or seen.place.size < _LEAST:
        return None
    told = [_told(seen, length, scatter) for length, scatter in product(_LENGTHS, _SCATTER)]
    best = min(told, key=lambda t: t.log_p)
    log_p = min(0.0, best.log_p + float(np.log(len(told))))
    held = _held(seen, best)
    deferred, errors, gain = _fitted(seen, held, axis)
    if held.inside < _TYPICAL or deferred.share * best.tail[0] <= 0 or _echoes(held, best):
        log_p = 0.0
    if log_p < np.log(_LIKELY) and not _passes(fields, deferred):
        return None  # the tail is there, and is no charge that all packets leave behind
    least = min(_least_seen(seen, scatter, deferred.length) for scatter in _SCATTER)
    if log_p == 0.0 and not np.isfinite(least):
        return None
    return _score(deferred, log_p, gain, errors, min(least, _MOST_LEFT), int(seen.place.size))


def _least_seen(seen: _Differences, scatter: float, length: float) -> float:
    """A fifth of the share left behind whose sum is, over its root mean square, five; infinite where so few
    pixels stand out that none is: the sum of n alike is at most the root of n. scatter: of the tails."""
    tail = _tail(length)
    variance = (seen.error**2 + scatter**2) / float(np.sum(tail**2))
    one, two = float(np.sum(1 / variance)), float(np.sum(variance**-2.0))
    # A first share a moves the sum by a times `one`, and its mean square by a^2 times `two`.
    room = one**2 - _FIVE**2 * two
    if room <= 0:
        return np.inf
    first = _FIVE * np.sqrt(one / room)
    kept = first / float(1 - np.exp(-1 / length))
    return float(kept / (1 + kept) / _FIVE)


def _score(
    found: Deferred, log_p: float, gain: float, errors: tuple[float, float, float], least: float, pixels: int
) -> Score[Deferred]:
    return Score(
        log_p=max(log_p, LEAST_LOG_P),
        gain=gain if log_p < 0 else 0.0,
        penalty=ONE_PARAMETER + 2 * ONE_OF_SEVERAL,
        amplitude=abs(found.share),
        error=errors[0],
        shift=least,
        power=1,
        parameters={
            "fraction": (found.share, "1", errors[0]),
            "length_px": (found.length, "px", errors[1]),
            "growth": (found.growth, "1", errors[2]),
        },
        where={"axis": "pixel", "along": ("column", "row")[found.axis], "pixels": pixels},
        payload=found,
    )


_SIDES = (("below", "above"), ("on the right", "on the left"))
"""Of a pixel, where its tail is."""
_TRIED = np.geomspace(0.15, 40.0, 120)
"""Lengths, pixels, of which the nearest is taken."""


def _fitted(seen: _Differences, held: _Held, axis: int) -> tuple[Deferred, tuple[float, float, float], float]:
    """Share, length and growth, the standard error of each, and what they gain, nats."""
    shapes = np.stack([_tail(length) for length in _TRIED])
    power = np.sum(shapes**2 / held.variance, 1)
    heights = shapes @ (held.tail / held.variance) / power
    at = int(np.argmax(heights**2 * power))
    length, height = float(_TRIED[at]), float(heights[at])
    let_go = 1 - np.exp(-1 / length)
    kept = abs(height) / let_go
    share = kept / (1 + kept)
    # By how much the tail changes with the share and with the length.
    by_share = let_go * shapes[at] / (1 - share) ** 2
    by_length = abs(height) * shapes[at] * (np.arange(REACH) - np.exp(-1 / length) / let_go) / length**2
    slopes = np.stack([by_share, by_length])
    known = np.einsum("ak,bk->ab", slopes, slopes / held.variance)
    unit = np.sqrt(np.maximum(np.diag(known), 1e-30))
    doubt = np.linalg.inv(known / np.outer(unit, unit) + 1e-9 * np.eye(2)) / np.outer(unit, unit)
    growth, grown = _growth(seen, held, shapes[at], float(np.sign(height)))
    beyond = float(np.sign(height)) * (held.tail - height * shapes[at])
    told = np.abs(beyond) > _SURE * np.sqrt(held.variance)
    found = Deferred(
        axis,
        float(np.sign(height) * min(share, _MOST_LEFT)),
        length,
        growth,
        tuple(np.where(told, beyond, 0.0).tolist()),
    )
    errors = (float(np.sqrt(doubt[0, 0])), float(np.sqrt(doubt[1, 1])), grown)
    return found, errors, 0.5 * height**2 * float(power[at])


def _growth(
    seen: _Differences, held: _Held, tail: Float[np.ndarray, "k"], sign: float
) -> tuple[float, float]:
    """By how much more is left behind at the last pixel read than in the middle, as a share, and its standard
    error; 0 where it is not told from none."""
    weight = held.weight @ tail**2
    first = sign * (held.weight * seen.share) @ tail / np.maximum(weight, 1e-30)
    place, total = sign * seen.place, max(float(np.sum(weight)), 1e-30)
    middle, centre = (float(np.sum(weight * v)) / total for v in (first, place))
    power = float(np.sum(weight * (place - centre) ** 2))
    if not power > 0 or not middle > 0:
        return 0.0, 0.0
    slope = float(np.sum(weight * (place - centre) * (first - middle))) / power
    rest = first - middle - slope * (place - centre)
    error = float(np.sqrt(np.sum((weight * (place - centre) * rest) ** 2))) / power
    level = middle - slope * centre
    if slope < _SURE * error or level <= 0:
        return 0.0, error / middle
    return float(np.clip(slope / level, 0.0, 1.0)), error / level


def _passes(fields: Many, found: Deferred) -> bool:
    """Whether the shot noise of flats may have passed the same traps: pixels next to each other along the
    lines share some of it, as far as flats tell."""
    score, information = lag_sums(tuple(f for f in fields if f.kind != "scene"), "shot")
    at = LAGS.index((0, 1) if found.axis else (1, 0))
    if not information[at] > 0:
        return True
    stays = float(np.exp(-1 / found.length))
    share = abs(found.share)
    first = share * (1 - stays)
    rest = first**2 / (1 - stays**2)
    expected = ((1 - share) * first + stays * rest) / ((1 - share) ** 2 + rest)
    return bool(score[at] / information[at] + 3 / np.sqrt(information[at]) > _PASSES * expected)


def tails(
    axis: int,
    *,
    name: str,
    before: tuple[str, ...],
    covers: tuple[str, ...],
    lifted_by: tuple[str, ...] = (),
) -> Signature:
    """Charge that comes out behind, along columns (axis 0) or rows (1). before: signatures of what a tail
    looks like, too, which are judged once it is taken back."""

    def beside(found: Found) -> dict[str, float]:
        return {"length_px": found.score.payload.length, "growth": found.score.payload.growth}

    def says(entry: dict[str, Any]) -> tuple[str, tuple[float, float]]:
        told = {name: each["value"] for name, each in entry["parameters"].items()}
        side = _SIDES[axis][int(told["fraction"] < 0)]
        grows = ", more the farther it was shifted" if told["growth"] > 0 else ""
        low, high = entry["amplitude"]["ci90"]
        return (
            f"A share of the charge comes out late, with the pixels {side}, over {told['length_px']:.2g} px"
            f"{grows}: {entry['amplitude']['value']:.3g}",
            (low, high),
        )

    return plain(
        name=name,
        axes=Axes("pixel", "pixel", "redrawn", "signal", "one-sided tail"),
        reads=CONTRASTS | STATIC | {"shot"},
        score=partial(tail_score, axis=axis),
        absorb=taken_back,
        covers=covers,
        lifted_by=lifted_by,
        before=lambda score: before,
        found_in=before,
        simulate=strength("fraction", signed="fraction", beside=beside),
        says=says,
        single_pixels=True,
        approximate=True,
    )
