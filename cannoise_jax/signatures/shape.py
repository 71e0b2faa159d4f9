"""Shape of the noise of all pixels together: heavy and light tails, and skewness."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import optimize, special, stats

from cannoise_jax.physics.core.grammar import Point, amplitude_name
from cannoise_jax.physics.robust import median
from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures.fields import Fields, each_frame
from cannoise_jax.signatures.handed import Addition, Found
from cannoise_jax.signatures.known_shape import known_kurtosis, known_skewness, kurtosis_doubt, rounded_enough
from cannoise_jax.signatures.least import (
    pooled,
)
from cannoise_jax.signatures.score import ONE_PARAMETER, Score, normal_log_p, skewed_log_p
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    CONTRASTS,
    COVERS_NOTHING,
    NO_CLOSED_FORM,
    NO_LAW,
    NO_PATTERN,
    NO_PLACE,
    NOT_SIMULATED,
    STATIC,
    Axes,
    Signature,
    unchanged,
)

HEAVY = "heavy tails"
"""The law of noise with more values far out than normal noise has."""
_SHAPES = (0.12, 0.09, 0.06, 0.03, 0.0, -0.03, -0.06, -0.1, -0.14, -0.18, -0.22)
"""Shapes of the Tukey lambda law that are tried (Joiner and Rosenblatt, J. Am. Stat. Assoc. 66, 394): at
0.135 it has the fourth moment of a normal law, at 0 that of a logistic one, at -0.25 none."""
_LONGEST = -0.2
"""Shape beyond which tails are so long that no sample shows their fourth moment; that of this one is 19."""
_PLACES = np.geomspace(1e-13, 0.6, 4000)
"""Probabilities at which a law is tabulated; the other half is its mirror image."""


_HE4_SKEWNESS = 14.7
"""Third moment of the Hermite polynomial He4 of a normal value over the 3/2th power of its second: 1728 /
24^1.5.
"""
_EDGES = np.linspace(-8, 8, 1601)
"""Bins of a hundredth of a standard deviation."""
_BEYOND = 8
"""Values of normal noise that lie beyond where its fourth moment is cut off."""


_LIGHTEST = 2.0
"""Negative excess kurtosis of two values that are as likely: no law has more. What shows more, as shot noise
of another skewness than its gain says, is none of read noise."""
_ALIKE = 0.8
"""Of the largest share of read noise, as a fourth moment has it, that from which darks are of one law."""


class _Capped(NamedTuple):
    """He4 of normal values cut off at `at` standard deviations: mean and variance, and how much of a small
    excess kurtosis it shows."""

    at: float
    mean: float
    variance: float
    shown: float


@lru_cache
def _capped(number: int) -> _Capped:
    """Cut off where of so many normal values a few lie beyond. A few pixels far out, such as those that a
    cosmic ray hit, are no tails of the noise of all."""
    at = float(stats.norm.isf(min(_BEYOND / (2 * number), 0.05)))
    z = np.linspace(-9, 9, 18001)
    p = stats.norm.pdf(z) * (z[1] - z[0])
    he4 = z**4 - 6 * z**2 + 3
    cut = np.clip(z, -at, at)
    capped = cut**4 - 6 * cut**2 + 3
    mean = float(np.sum(p * capped))
    return _Capped(
        at, mean, float(np.sum(p * (capped - mean) ** 2)), float(np.sum(p * (capped - mean) * he4) / 24)
    )


def kurtosis_score(fields: tuple[Fields, ...], *, tails: int = 1) -> Score | None:
    """Fourth moment beyond Poisson and rounding (tails=-1: short of them), weighted by the share of read
    noise; gain of Tukey's lambda law, which the simulator draws from."""
    doubt = u = squares = cubes = scatter = whole = 0.0
    pooled = []
    used = _told(fields)
    cap = _capped(max(sum(f.frames * f.mean.size for f, _ in used), 1))
    for f, static in used:
        base, share = known_kurtosis(f)
        w = (share * f.usable * (np.abs(static) < 7)).astype(np.float64)
        squares += float(np.sum(w**2)) * f.frames
        cubes += float(np.sum(w * w**2)) * f.frames
        doubt += (float(np.sum(w)) * f.frames * kurtosis_doubt(f)) ** 2 if f.kind in DARK else 0.0
        for values in _of_one_noise(f, w, cap.at):
            z2 = values**2
            whole += float(np.sum(w * (z2 * z2 - 6 * z2 + 3 - base)))
            z2 = np.minimum(z2, cap.at**2)
            terms = w * (z2 * z2 - 6 * z2 + 3 - cap.mean - cap.shown * base)
            u += float(np.sum(terms))
            scatter += float(np.sum(terms**2))
            if f.kind in DARK:
                width = f.step / float(median(f.sigma))
                counted = np.clip(values[w > 0], -cap.at, cap.at)
                pooled.append((float(np.mean(w[w > 0])), (np.histogram(counted, _EDGES)[0], width)))
    if squares < 1:
        return None
    spread = np.sqrt(cap.variance * squares + cap.shown**2 * doubt)
    z, kappa = tails * u / spread, tails * u / (cap.shown * squares)
    # The moment is the definition, unless a few pixels far out make it.
    if kappa < tails * whole / squares < 2 * kappa:
        kappa = tails * whole / squares
    heavy = pooled and z > 0 and tails > 0
    amplitude, error = max(kappa, 0.0), float(np.sqrt(max(spread**2, scatter)) / (cap.shown * squares))
    gain = 0.5 * max(z, 0) ** 2
    if heavy:
        # Shot noise of dark charge, which has no tails, fills those of the read noise in: one law fits darks
        # that are as full of it.
        most = max(part for part, _ in pooled)
        gain, shape, doubt = _tukey_gain([own for part, own in pooled if part > _ALIKE * most], cap.at)
        # Of very heavy tails the moment scatters too much to be used.
        if kappa > 1 and gain > 0:
            shape = max(shape, _LONGEST)
            excess = _excess_kurtosis(shape)
            amplitude = excess / most
            error = float(doubt * abs(_excess_kurtosis(shape + 0.01) - excess) / 0.01) / most
    if tails > 0:
        log_p = skewed_log_p(z, _HE4_SKEWNESS * cubes / squares**1.5, 1)
    else:
        log_p = normal_log_p(z, 1) if kappa < _LIGHTEST else 0.0
    return Score(
        log_p=log_p,
        gain=gain,
        penalty=0.5 * float(np.log(squares)),
        amplitude=float(amplitude),
        error=error,
        shift=float(spread / (cap.shown * squares)),
        power=1,
        parameters={"excess_kurtosis": (float(tails * amplitude), "1", error)},
        where={"axis": "signal", "range": [0.0, 0.0]},
    )


def _told(fields: tuple[Fields, ...]) -> list[tuple[Fields, Float[np.ndarray, "h w"]]]:
    """The recordings whose noise is not lost in rounding, with what stays in them."""
    used = []
    for f in fields:
        narrow = f.step * (1.0 if f.kind == "flat" else 0.65)
        # A flat sits at one place between two codes, which one its smooth mean does not tell well enough.
        if f.static is not None and median(f.sigma**2 * (1 - f.shot)) >= narrow**2:
            used.append((f, f.static))
    return used


def one_noise(
    fields: tuple[Fields, ...],
) -> Iterator[tuple[Fields, Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]]:
    """Every frame in the dark that tells the shape of noise, with the fields that it is of: all of a
    recording of one noise, those far out cut off, and the pixels to use."""
    used = [(f, static) for f, static in _told(fields) if f.kind in DARK]
    cap = _capped(max(sum(f.frames * f.mean.size for f, _ in used), 1)).at
    for f, static in used:
        keep = f.usable & (np.abs(static) < 7)
        for values in _of_one_noise(f, keep.astype(np.float64), cap):
            yield f, np.clip(values, -cap, cap), keep


def _of_one_noise(
    field: Fields, weight: Float[np.ndarray, "h w"], cap: float
) -> Iterator[Float[np.ndarray, "h w"]]:
    """Every frame's standardised residual, all of one noise: frames noisier than others make a mixture, which
    has tails that no frame has. cap: value that those far out count for."""
    total = max(float(np.sum(weight)), 1e-30)
    limited = (np.minimum(values**2, cap**2) for values in each_frame(field))
    squares = [max(float(np.sum(weight * square)) / total, 1e-6) for square in limited]
    middle = float(np.mean(squares))
    for values, square in zip(each_frame(field), squares, strict=True):
        yield values * np.float32(np.sqrt(middle / square))


@lru_cache
def _tabulated(shape: float) -> tuple[np.ndarray, np.ndarray]:
    """Quantiles of the Tukey lambda law of unit variance, the lower half and a little more, and the logs
    of their probabilities."""
    quantiles = (_PLACES**shape - (1 - _PLACES) ** shape) / shape if shape else special.logit(_PLACES)
    return quantiles / float(np.sqrt(stats.tukeylambda.stats(shape, moments="v"))), np.log(_PLACES)


def _tukey_gain(pooled: list[tuple[np.ndarray, float]], cap: float) -> tuple[float, float, float]:
    """Log-likelihood gain of the best scaled Tukey lambda law over the best normal one, its shape, and the
    standard error of that. pooled: counts of standardised values in `_EDGES` with the code step in the same
    units: each value stands for the interval that was rounded to it, those at the cap for all beyond."""
    middle = (_EDGES[1:] + _EDGES[:-1]) / 2
    merged: dict[float, np.ndarray] = {}
    for n, width in pooled:
        merged[round(width, 3)] = merged.get(round(width, 3), 0) + n
    counts = np.concatenate([n[n > 0] for n in merged.values()]).astype(float)
    centre = np.concatenate([-np.abs(middle[n > 0]) for n in merged.values()])
    half = np.concatenate([np.full(int((n > 0).sum()), width / 2) for width, n in merged.items()])
    beyond = centre < -cap + (_EDGES[1] - _EDGES[0])

    def fit(cdf: Callable[[np.ndarray], np.ndarray]) -> float:
        def loss(scale: float) -> float:
            inside = cdf((centre + half) / scale) - np.where(beyond, 0.0, cdf((centre - half) / scale))
            return -float(np.sum(counts * np.log(np.maximum(inside, 1e-300))))

        return -float(
            optimize.minimize_scalar(loss, bounds=(0.5, 1.3), method="bounded", options={"xatol": 1e-3}).fun
        )

    def tukey(shape: float) -> Callable[[np.ndarray], np.ndarray]:
        places, logs = _tabulated(shape)

        def cdf(x: np.ndarray) -> np.ndarray:
            lower = np.exp(np.interp(-np.abs(x), places, logs, left=-np.inf))
            return np.where(x > 0, 1 - lower, lower)

        return cdf

    normal = fit(special.ndtr)
    gains = np.array([fit(tukey(shape)) - normal for shape in _SHAPES])
    k = int(np.argmax(gains))
    if gains[k] <= 0:
        return 0.0, 0.13, 0.0
    at = slice(max(k - 1, 0), k + 2)
    x, y = np.array(_SHAPES)[at], gains[at]
    if len(x) < 3:
        return float(gains[k]), float(_SHAPES[k]), float(np.ptp(_SHAPES[:2]))
    bent, slope, _ = np.polyfit(x - _SHAPES[k], y, 2)
    return float(gains[k]), float(_SHAPES[k] - slope / (2 * bent)), float(np.sqrt(-0.5 / bent))


def _excess_kurtosis(shape: float) -> float:
    """Of the Tukey lambda law."""
    return float(stats.tukeylambda.stats(shape, moments="k"))


def parabola_peak(grid: np.ndarray, values: np.ndarray, k: int) -> float:
    """Place of the largest of values on a grid, a parabola laid through it and its neighbours in log x."""
    if k in (0, len(grid) - 1):
        return float(grid[k])
    x, y = np.log(grid[k - 1 : k + 2]), values[k - 1 : k + 2]
    a, b, _ = np.polyfit(x - x[1], y, 2)
    return float(np.exp(x[1] - b / (2 * a))) if a < 0 else float(grid[k])


_DOUBT = 0.005
"""Uncertainty of the expected skewness by that of the fitted gain, whose square it goes with: of a gain that
is known to 0.25 %. Sets of 32 frames of 96 x 128 pixels know it to 0.33 %."""


def skew_score(fields: tuple[Fields, ...]) -> Score | None:
    """Third moment beyond Poisson, weighted by the share of shot noise. Of 300 draws of a flat of 40
    electrons, six frames, without it p is below 0.1 in 9 %, 0.05 in 4 %, 0.01 in 1 %."""
    u = i = squares = 0.0
    for f in fields:
        if f.static is None or not f.lit or not rounded_enough(f):
            continue
        base = known_skewness(f)
        w = f.usable * base * (np.abs(f.static) < 7)
        for values in each_frame(f):
            term = w * (values * values**2 - 3 * values - base)
            u += float(np.sum(term, dtype=np.float64))
            squares += float(np.sum(term**2, dtype=np.float64))
        i += float(np.sum(w * base)) * f.frames
    if i == 0:
        return None
    error = float(np.sqrt(squares + (_DOUBT * i) ** 2) / i)
    relative = u / i
    z = relative / error
    return Score(
        log_p=normal_log_p(z),
        gain=0.5 * z**2,
        penalty=ONE_PARAMETER,
        amplitude=abs(relative),
        error=error,
        shift=error,
        power=1,
        parameters={"relative_skewness": (relative, "1", error)},
        where={"axis": "signal", "range": [0.0, 1.0]},
    )


def lambda_of(kurtosis: float) -> float:
    """Shape of the Tukey lambda law of this excess kurtosis; 1, the uniform law, of less than any has."""
    low, high = -0.245, 1.0
    if kurtosis <= _excess_kurtosis(high):
        return high
    if kurtosis >= _excess_kurtosis(low):
        return low
    return float(optimize.brentq(lambda shape: _excess_kurtosis(shape) - kurtosis, low, high))


_READ_SHARE = 0.9
"""Share of the read noise that a field of other tails carries; its Gaussian part is lowered to make room."""


def _place_tails(found: Found) -> Addition:
    point = Point("readout", "signal", "pixel", "redrawn", distribution="tukey_lambda")
    kurtosis = float(found.score.parameters["excess_kurtosis"][0])
    values = {
        amplitude_name(point): _READ_SHARE * found.read_dn,
        "tukey_lambda": lambda_of(kurtosis / _READ_SHARE**4),
    }
    return Addition(values, point=point)


_PEAKED = 1.0
"""Excess kurtosis from which on a law has a peak so narrow that smooth counts of codes are none."""


def tails(*, name: str, heavy: bool, covers: tuple[str, ...], smooth: tuple[str, ...] = ()) -> Signature:
    """A fourth moment beyond Poisson and rounding, or short of them. smooth: signatures that take the counts
    of codes to be as smooth as those of normal noise, and its outliers to be as rare."""
    return Signature(
        name=name,
        axes=Axes("readout", "pixel", "redrawn", "additive", HEAVY if heavy else "light tails"),
        reads=CONTRASTS | STATIC | {"mean", "signal", "shot"},
        score=partial(kurtosis_score, tails=1 if heavy else -1),
        absorb=unchanged,
        covers=covers,
        hides=lambda score: smooth if score.amplitude > _PEAKED else (),
        predict=NO_LAW,
        pattern=NO_PATTERN,
        simulate=(lambda found: Addition({"tukey_lambda": lambda_of(found.score.amplitude)}))
        if heavy
        else NOT_SIMULATED,
        place=_place_tails,
        detectable=BY_SHIFT,
        least=(lambda sets: pooled(s.frames * np.sum(s.tails**2) / 24 for s in sets))
        if heavy
        else NO_CLOSED_FORM,
        form_free=heavy,  # Tukey's law stands for every law of tails
    )


def skewed(*, name: str) -> Signature:
    """A third moment beyond that of Poisson noise."""
    return Signature(
        name=name,
        axes=Axes("photons", "pixel", "redrawn", "signal", "skewed"),
        reads=CONTRASTS | STATIC | {"signal"},
        score=skew_score,
        absorb=unchanged,
        covers=COVERS_NOTHING,
        predict=NO_LAW,
        pattern=NO_PATTERN,
        simulate=NOT_SIMULATED,
        place=NO_PLACE,
        detectable=BY_SHIFT,
        least=NO_CLOSED_FORM,
    )
