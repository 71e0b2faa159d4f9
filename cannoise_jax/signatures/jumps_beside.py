"""A few pixels that jump between two levels, among pixels whose noise is unlike.

Both spread the pixels' sums of squares, and either law follows part of the other. So four laws are fitted to
the same sums: neither, noise of a log-normal spread, jumps of exponential sizes, and both together. Jumps are
told where both are needed, against the better of the two alone.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import special

from cannoise_jax.signatures.added import as_map, placed
from cannoise_jax.signatures.fields import helmert, without_pixels
from cannoise_jax.signatures.handed import Addition, Found, Many
from cannoise_jax.signatures.heat import above_neighbours
from cannoise_jax.signatures.known_shape import darks
from cannoise_jax.signatures.pixels import READS, SPREADS, histogram, noisy_map, square_map
from cannoise_jax.signatures.rare import JUMPS, MEAN_JUMPS
from cannoise_jax.signatures.score import LEAST_LOG_P, Score
from cannoise_jax.signatures.signature import (
    BLINKING,
    BY_SHIFT,
    NO_CLOSED_FORM,
    NO_LAW,
    Axes,
    Signature,
)

_NEEDED = 30.0
"""Nats that both laws together must gain over either alone."""
_SHARE = 0.05
"""And over jumps alone as a share of what those gain: jumps of another law than the exponential leave 0.005
and 0.015 of it (two real cameras), jumps beside a log-normal spread of 0.2 to 0.4 some 0.3 to 0.5."""
_TWO_LEVELS = 0.5
"""Share of the pixels that stand out whose values are two levels rather than one with more noise."""
_FEWEST = 20
_WARM = 8.0
"""Standard deviations from which on a pixel's level grows with the exposure."""
_FRAMES = 6
"""Frames of a recording from which on that is told."""
_ROUNDS = 15
_START = 0.005
_MOST = 0.3
_FINER = np.array([-0.66, -0.33, 0.33, 0.66])
"""Spreads between two of the grid, in steps of it."""


class Both(NamedTuple):
    """Sum of squares from which on a pixel is more likely one that jumps, and the share of those pixels."""

    limit: float
    share: float


class _Law(NamedTuple):
    """A fitted law: its gain over neither, nats, spread of the noise, mean jump and share of pixels that
    jump."""

    gain: float
    spread: float
    mean: float
    share: float


@lru_cache(maxsize=1)
def _nodes() -> tuple[np.ndarray, np.ndarray]:
    nodes, weights = np.polynomial.hermite_e.hermegauss(15)
    return nodes, weights / weights.sum()


def _log_ratios(squares: Float[np.ndarray, "b"], n: int, spread: float) -> Float[np.ndarray, "b j"]:
    """Log density of sums of squares over that of equal pixels, for noise of this spread and no jump (the
    first column) or each of `JUMPS`."""
    nodes, weights = _nodes()
    width = np.sqrt(np.log1p(spread**2))
    own = np.exp(2 * (width * nodes - width**2)) if spread else np.ones(1)
    weights = weights if spread else np.ones(1)
    variance = own + np.append(0.0, JUMPS**2 / 4)[:, None]
    logs = -n / 2 * np.log(variance) + 0.5 * squares[:, None, None] * (1 - 1 / variance)
    return special.logsumexp(logs, axis=2, b=weights).clip(-50, 600)


def _fit(counts: np.ndarray, ratios: Float[np.ndarray, "b j"], spread: float) -> tuple[_Law, _Law]:
    """The law of this spread without jumps, and with the jumps that fit best beside it."""
    quiet = ratios[:, 0]
    alone = float(np.sum(counts * quiet))
    best = _Law(alone, spread, 0.0, 0.0)
    for mean in MEAN_JUMPS:
        weight = np.exp(-JUMPS / mean) * np.gradient(JUMPS)
        jumping = special.logsumexp(ratios[:, 1:], axis=1, b=weight / weight.sum())
        f = _START
        for _ in range(_ROUNDS):
            jumps = special.expit(jumping - quiet + np.log(f) - np.log1p(-f))
            f = float(np.clip(np.sum(counts * jumps) / counts.sum(), 1e-6, _MOST))
        gain = float(np.sum(counts * np.logaddexp(np.log1p(-f) + quiet, np.log(f) + jumping)))
        if gain > best.gain:
            best = _Law(gain, spread, float(mean), f)
    return _Law(alone, spread, 0.0, 0.0), best


def _limit(law: _Law, n: int, highest: float) -> float:
    """Sum of squares from which on a pixel is more likely one that jumps."""
    grid = np.geomspace(n, max(highest, 2.0 * n), 400)
    ratios = _log_ratios(grid, n, law.spread)
    weight = np.exp(-JUMPS / law.mean) * np.gradient(JUMPS)
    jumping = special.logsumexp(ratios[:, 1:], axis=1, b=weight / weight.sum())
    more = jumping + np.log(law.share) > ratios[:, 0] + np.log1p(-law.share)
    return float(grid[np.argmax(more)]) if more.any() else float("inf")


def _warm(fields: Many) -> Bool[np.ndarray, "h w"]:
    """Pixels whose level grows with the exposure far beyond those around them: the shot noise of their charge
    is noise of one level."""
    out = np.zeros(fields[0].mean.shape, bool)
    if len({f.exposure_s for f in darks(fields)}) < 2:
        return out
    sums = above_neighbours(fields, "exposure")
    return out if sums is None else sums.score > _WARM * np.sqrt(sums.information)


def _two_levels(fields: Many, chosen: Bool[np.ndarray, "h w"]) -> bool:
    """Whether most of the chosen pixels have two levels rather than one with more noise: in the darks, by the
    likelihood of the best split of their values against that of a normal law of a width of their own."""
    more = np.zeros(int(chosen.sum()))
    for f in darks(fields):
        if f.frames < _FRAMES or len(f.contrasts) < f.frames - 1:
            continue
        values = np.sort(f.contrasts[: f.frames - 1, chosen].T @ helmert(f.frames), axis=1)
        k, n = np.arange(1, f.frames), f.frames
        low, square = np.cumsum(values, 1)[:, :-1], np.sum(values**2, 1)
        within = square[:, None] - low**2 / k - (values.sum(1)[:, None] - low) ** 2 / (n - k)
        split = -within / 2 + k * np.log(k / n) + (n - k) * np.log(1 - k / n)
        variance = values.var(1)
        more += split.max(1) + 0.5 * n * (np.log(np.maximum(variance, 1)) + np.minimum(variance, 1))
    return more.size >= _FEWEST and float(np.mean(more > 0)) > _TWO_LEVELS


def beside_score(fields: Many) -> Score[Both] | None:
    """Pixels that jump beside noise that is unlike from pixel to pixel, where both are needed."""
    found = square_map(fields)
    if found is None:
        return None
    n, told = found[2], found[1] & ~_warm(fields)
    squares = found[0][told]
    if not squares.size:
        return None
    counts, centre = histogram(squares)
    jumps_alone = _fit(counts, _log_ratios(centre, n, 0.0), 0.0)[1].gain
    grid = np.array(SPREADS)
    coarse = [_fit(counts, _log_ratios(centre, n, s), s) for s in grid]
    fits = list(coarse)
    for k in {int(np.argmax([pair[which].gain for pair in coarse])) for which in (0, 1)}:
        near = np.interp(k + _FINER, np.arange(grid.size), np.log(grid))
        fits += [_fit(counts, _log_ratios(centre, n, s), s) for s in np.exp(near)]
    spread_alone = max(alone.gain for alone, _ in fits)
    both = max((law for _, law in fits), key=lambda law: law.gain)
    needed = both.gain - jumps_alone > max(_NEEDED, _SHARE * jumps_alone) and both.share > 0
    needed = needed and both.gain - spread_alone > _NEEDED
    limit = _limit(both, n, float(squares.max())) if needed else float("inf")
    gain = both.gain - spread_alone if needed and _two_levels(fields, told & (found[0] > limit)) else 0.0
    sigma = float(np.mean([np.median(f.sigma) for f in darks(fields)]))
    amplitude = sigma * np.sqrt(both.share * both.mean**2 / 2) if gain else 0.0
    number = max(both.share * squares.size, 1.0)
    return Score(
        # Three parameters more than the spread alone, over a grid of means.
        log_p=float(np.clip(-gain + np.log(len(MEAN_JUMPS) * squares.size), LEAST_LOG_P, 0.0)),
        gain=gain,
        penalty=float(np.log(squares.size)),
        amplitude=float(amplitude),
        error=float(max(amplitude, 1e-6 * sigma) / np.sqrt(number)),
        shift=float(sigma * np.sqrt(np.sqrt(2 / n / squares.size))),
        power=2,
        parameters={
            "fraction": (both.share, "1", both.share / np.sqrt(number)),
            "jump": (both.mean * sigma, "DN", both.mean * sigma / np.sqrt(number)),
        },
        where={"axis": "pixel", "pixels": round(both.share * squares.size)},
        payload=Both(limit if gain else float("inf"), both.share),
    )


def _jumping(fields: Many, score: Score[Both]) -> Bool[np.ndarray, "h w"] | None:
    found = square_map(fields)
    return None if found is None else (found[0] > score.payload.limit) & found[1] & ~_warm(fields)


def beside_absorb(fields: Many, score: Score[Both]) -> Many:
    """Takes the pixels that are more likely ones that jump out of every field."""
    jumping = _jumping(fields, score)
    return fields if jumping is None else without_pixels(fields, jumping)


def jumping_beside(*, name: str, covers: tuple[str, ...], before: tuple[str, ...]) -> Signature:
    """A few pixels that jump between levels, where the noise of all others is unlike. before: signatures that
    know one of the two laws."""

    def pattern(fields: Many, score: Score[Both], rng: np.random.Generator) -> np.ndarray:
        jumping = _jumping(fields, score)
        return noisy_map(fields, float(np.mean(jumping)) if jumping is not None else 0.0)

    def simulate(found: Found) -> Addition:
        jump, share = (found.score.parameters[k][0] for k in ("jump", "fraction"))
        sites = {} if found.pattern is None else {"sites": as_map(found.pattern / (jump / 2))}
        return Addition({"jump_dn": jump, "fraction": share, "rate": 0.5}, sites)

    return Signature(
        name=name,
        axes=Axes("readout", "pixel", BLINKING.time, "additive", "two levels"),
        reads=READS,
        score=beside_score,
        absorb=beside_absorb,
        covers=covers,
        rare=True,
        predict=NO_LAW,
        pattern=pattern,
        simulate=simulate,
        place=placed(BLINKING),
        detectable=BY_SHIFT,
        least=NO_CLOSED_FORM,
        before=lambda score: before if score.gain > 0 else (),
    )
