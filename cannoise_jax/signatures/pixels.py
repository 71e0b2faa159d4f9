"""Pixels that have a noise of their own each."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import special, stats

from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.noise_of_lines import LEAST_SHARE
from cannoise_jax.signatures.added import as_map, placed
from cannoise_jax.signatures.charge_noise import own_charge
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.handed import Addition, Found, Many
from cannoise_jax.signatures.jumps import CHANCE, merely_noisy
from cannoise_jax.signatures.known_shape import darks, known_kurtosis, kurtosis_doubt
from cannoise_jax.signatures.least import (
    Law,
    Seen,
    grows,
)
from cannoise_jax.signatures.score import Score, skewed_log_p
from cannoise_jax.signatures.shape import parabola_peak
from cannoise_jax.signatures.signature import (
    BLINKING,
    BY_SHIFT,
    NO_LAW,
    Axes,
    Signature,
    unchanged,
)
from cannoise_jax.signatures.squares import (
    LOOKED_AT,
    READS,
    dark_sigma,
    histogram,
    square_map,
    sum_of_squares,
)

_SPREADS = (0.015, 0.02, 0.03, 0.04, 0.05, 0.065, 0.08, 0.12, 0.17, 0.25, 0.35, 0.5, 0.7, 1.0)
"""Relative spreads of the pixels' noise that are tried; a parabola goes between."""


_MOSTLY = 0.5
"""Of the noisy pixels that the law of all has, from which on they are no kind of their own: of read noise of
another strength in each it has 0.7 to 0.9, of a few that jump beside others that hardly differ 0.1."""
_TRIED = np.arange(-5, 12.01, 0.25)
"""Logarithms of a pixel's read noise that are tried, in widths of the law of all of them: the quietest are of
that law, the noisiest need not be."""
_OF_NO_LAW = 1e-3
"""Share of the pixels whose noise may be any of these."""
_SURE_OF_DOUBT = 0.2
"""Relative standard error of what doubt about charges adds to the scatter of the noise of pixels."""
_LOUDEST = 12.0
"""Logarithm of the variance of the noisiest of those, over that of most."""


def _known_dispersion(fields: tuple[Fields, ...]) -> tuple[float, float]:
    """What the kurtosis of rounding and of Poisson noise, and doubt about the charge of pixels, add to the
    variance of a pixel's sum of squares over all darks, and its standard error."""
    chosen = darks(fields)
    weight = np.array([len(f.contrasts) ** 2 / (len(f.contrasts) + 1.0) for f in chosen])
    known = [float(np.mean(known_kurtosis(f)[0])) for f in chosen]
    usable = np.all([f.usable for f in chosen], axis=0)
    doubt: np.ndarray | float = sum((len(f.contrasts) * np.asarray(f.answers.doubt) for f in chosen), 0.0)
    of_charge = float(np.mean(np.broadcast_to(doubt, usable.shape)[usable] ** 2)) if usable.any() else 0.0
    # As sure as the errors of charges are, which follow from the noise of the same frames.
    of_kurtosis = float(np.linalg.norm(weight * [kurtosis_doubt(f) for f in chosen]))
    return float(weight @ known) + of_charge, float(np.hypot(of_kurtosis, _SURE_OF_DOUBT * of_charge))


def _dispersion_log_p(squares: np.ndarray, n: int, known: float, doubt: float) -> tuple[float, float]:
    """Over-dispersion of the sums of squares against chi-square, far pixels capped; log p and z. known: what
    rounding and Poisson noise add to the variance of a sum of squares, doubt: its standard error."""
    cap = stats.chi2.isf(1e-4, n)
    grid = np.linspace(0, cap, 4001)
    density = stats.chi2.pdf(grid, n)
    density[0] = 0 if not np.isfinite(density[0]) else density[0]
    weight = density * (grid[1] - grid[0])
    weight[-1] += stats.chi2.sf(cap, n)
    weight /= weight.sum()
    value = (grid - n) ** 2
    mean = float(np.sum(weight * value))
    variance = float(np.sum(weight * (value - mean) ** 2))
    # The scale is fitted on the same pixels: what a common factor does to the mean is projected out.
    linear = float(np.sum(weight * (value - mean) * (grid - n)) / np.sum(weight * (grid - n) ** 2))
    third = float(np.sum(weight * (value - mean - linear * (grid - n)) ** 3))
    variance = float(np.sum(weight * (value - mean - linear * (grid - n)) ** 2))
    capped = np.minimum(squares, cap)
    total = float(np.sum((capped - n) ** 2 - mean - known - linear * (capped - n)))
    z = total / np.sqrt(variance * squares.size + (doubt * squares.size) ** 2)
    skewness = third / variance**1.5 / np.sqrt(squares.size)
    return skewed_log_p(z, skewness, 1), z


def spread_score(fields: tuple[Fields, ...]) -> Score[bool] | None:
    """A read noise of its own for every pixel (log-normal): marginal likelihood of the sums of squares.
    Payload: whether the noisy pixels are of that kind, and do not jump."""
    found = square_map(fields)
    if found is None:
        return None
    whole, usable, n = found
    squares = whole[usable]
    log_p, z = _dispersion_log_p(squares, n, *_known_dispersion(fields))
    nodes, weights = np.polynomial.hermite_e.hermegauss(15)
    counts, centre = histogram(squares)
    best, at = 0.0, 0.0
    gains = []
    share = read_share(fields)
    odd = np.log(_OF_NO_LAW) + _any_noise(centre, n)
    alike = np.logaddexp(np.log1p(-_OF_NO_LAW), odd)
    for spread in _SPREADS:
        width = np.sqrt(np.log1p(spread**2))
        variance = 1 + share * np.expm1(2 * (width * nodes - width**2))
        log_terms = -n / 2 * np.log(variance) + 0.5 * centre[:, None] * (1 - 1 / variance)
        top = log_terms.max(1, keepdims=True)
        spreads = top[:, 0] + np.log(np.exp(log_terms - top) @ (weights / weights.sum()))
        # A few pixels of any noise, as hits make them, are in both laws.
        gains.append(float(np.sum(counts * (np.logaddexp(np.log1p(-_OF_NO_LAW) + spreads, odd) - alike))))
    k = int(np.argmax(gains))
    if gains[k] > 0:
        best, at = gains[k], parabola_peak(np.array(_SPREADS), np.array(gains), k)
    # chi-square dispersion grows by 4 spread^2 n^2, of the part of the noise that has the spread.
    unit = 4 * share**2 * n**2 / np.sqrt(_dispersion_variance(n) * squares.size) * squares.size
    error = 1 / (unit * max(2 * at, 1 / np.sqrt(unit)))
    return Score(
        log_p=log_p,
        payload=log_p < LOOKED_AT
        and _explains(at, share, squares, n)
        and merely_noisy(fields, whole, usable, n),
        gain=best,
        penalty=0.5 * float(np.log(squares.size)),
        amplitude=at,
        error=float(error),
        shift=float(1 / np.sqrt(unit)),
        power=2,
        parameters={"spread": (at, "1", float(error))},
        where={"axis": "pixel", "z": z},
    )


def read_share(fields: tuple[Fields, ...]) -> float:
    """Share of the variance of the darks that is read noise: neither rounding nor the shot noise of dark
    charge differs from pixel to pixel with it."""
    chosen = darks(fields)
    shares = [float(median(1 - f.shot - f.step**2 / 12 / f.sigma**2)) for f in chosen]
    return max(float(np.average(shares, weights=[len(f.contrasts) for f in chosen])), LEAST_SHARE)


def _explains(spread: float, share: float, squares: np.ndarray, n: int) -> bool:
    """Whether a log-normal law of this spread, of this share of the variance, has at least `_MOSTLY` of the
    noisy pixels."""
    limit, width = stats.chi2.isf(CHANCE, n), np.sqrt(np.log1p(spread**2))
    chance = stats.norm.pdf(_TRIED) / np.sum(stats.norm.pdf(_TRIED))
    variance = 1 + share * np.expm1(2 * (width * _TRIED - width**2))
    expected = float(chance @ stats.chi2.sf(limit / variance, n))
    return bool(expected > _MOSTLY * np.mean(squares > limit))


def _any_noise(squares: np.ndarray, n: int) -> np.ndarray:
    """Log-likelihood of sums of squares of louder noise, evenly in its logarithm, over that of the noise that
    most have."""
    logs = np.linspace(0.0, _LOUDEST, 60)
    terms = -n / 2 * logs + 0.5 * squares[:, None] * (1 - np.exp(-logs))
    return special.logsumexp(terms, axis=1) - np.log(logs.size)


def _dispersion_variance(n: int) -> float:
    """Variance of (chi2_n - n)^2 with its linear part projected out."""
    return 8.0 * n**2 + 16.0 * n


def noise_factors(fields: Many, spread: float, rng: np.random.Generator) -> np.ndarray:
    """A draw of every pixel's read noise over the mean one `[H, W]`, log-normal of relative spread
    `spread` but for a few, given its sums of squares. What darks of a gain setting have beyond the quietest
    of them is other noise, the same in all pixels: the shot noise of dark current above all."""
    groups = _by_read_share(fields)
    width = np.sqrt(np.log1p(spread**2))
    chance = (1 - _OF_NO_LAW) * stats.norm.pdf(_TRIED) / np.sum(stats.norm.pdf(_TRIED))
    prior = np.log(chance + _OF_NO_LAW / _TRIED.size)
    shape = groups[0][1].shape
    best, factor = np.full(shape, -np.inf), np.ones(shape)
    for step, own in zip(_TRIED * width - width**2, prior, strict=True):  # mean square of the law 1
        score = own + rng.gumbel(size=shape)
        for share, squares, freedom in groups:
            variance = 1 + share * (np.exp(2 * step) - 1)
            score -= 0.5 * (freedom * np.log(variance) + squares / variance)
        better = score > best
        best, factor = np.where(better, score, best), np.where(better, np.exp(step), factor)
    return factor


def _by_read_share(fields: Many) -> list[tuple[float, np.ndarray, int]]:
    """Of darks alike in it: the share that read noise has of their variance, the sum of squares of every
    pixel in units of the noise, and its degrees of freedom."""
    chosen = [f for f in fields if not f.lit and len(f.contrasts)]
    level = [float(median(f.sigma)) ** 2 / f.unit**2 for f in chosen]
    least: dict[int, float] = {}
    for f, v in zip(chosen, level, strict=True):
        least[f.group] = min(v, least.get(f.group, v))
    shares = [
        round(max(least[f.group] - (f.step / f.unit) ** 2 / 12, LEAST_SHARE * v) / v, 2)
        for f, v in zip(chosen, level, strict=True)
    ]
    charge = own_charge(fields)
    out = []
    for share in sorted(set(shares)):
        own = tuple(f for f, s in zip(chosen, shares, strict=True) if s == share)
        out.append((share, sum_of_squares(own, charge), sum(len(f.contrasts) for f in own)))
    return out


def read_map(sets: tuple[Seen, ...]) -> Law:
    """Spread a of the read noise over pixels, the same in all frames: its relative variance 2 g a, g normal,
    against the information of every pixel, and the heavy tails that it gives to every frame."""
    information = sum(s.frames * s.read**2 / 2 for s in sets)
    single = sum(s.frames * np.sum(s.read**4) for s in sets)
    return grows(16 * (float(np.sum(np.square(information))) + float(single) / 2) / 2, 2)


PEAKED = 0.25
"""Relative spread of the noise from which on all pixels together have a law with a narrow peak: its excess
kurtosis is then 3 (exp(4 w^2) - 1), 0.8, as `shape` has it for tails."""


def with_factors(parameter: str) -> Callable[[Found], Addition]:
    """Adds the mechanism with its amplitude as `parameter`, and the noise factors that were measured."""

    def simulate(found: Found) -> Addition:
        maps = {} if found.pattern is None else {"factor": as_map(found.pattern)}
        return Addition({parameter: found.score.amplitude}, maps)

    return simulate


def placed_beyond(found: Found) -> Addition | None:
    """Noise factors without a name, as noise beyond that of the quietest, DN."""
    if found.pattern is None:
        return None
    beyond = np.maximum(found.pattern**2 - np.quantile(found.pattern, 0.05) ** 2, 0)
    return placed(BLINKING)(found._replace(pattern=dark_sigma(found.fields) * np.sqrt(beyond)))


def own_noise(
    *,
    name: str,
    parameter: str,
    covers: tuple[str, ...],
    smooth: tuple[str, ...] = (),
    before: tuple[str, ...] = (),
) -> Signature:
    """A read noise of its own for every pixel. smooth: signatures that take the counts of codes to be as
    smooth as those of normal noise. before: those of pixels that jump, which are judged later where most of
    the noisy ones do not."""

    def pattern(fields: Many, score: Score, rng: np.random.Generator) -> np.ndarray:
        return noise_factors(fields, score.amplitude, rng)

    return Signature(
        name=name,
        axes=Axes("readout", "pixel", "frozen", "additive", "log-normal variance"),
        reads=READS,
        score=spread_score,
        absorb=unchanged,
        covers=covers,
        before=lambda score: before if score.payload else (),
        hides=lambda score: smooth if score.amplitude > PEAKED else (),
        predict=NO_LAW,
        pattern=pattern,
        simulate=with_factors(parameter),
        place=placed_beyond,
        detectable=BY_SHIFT,
        least=read_map,
    )
