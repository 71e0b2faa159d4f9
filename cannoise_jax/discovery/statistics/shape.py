"""Shape of the noise, pixel by pixel: heavy tails, noisy pixels, telegraph pixels, hot pixels, skewness."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from scipy import optimize, special, stats

from cannoise_jax.discovery.fields import Fields, channel_index, each_frame
from cannoise_jax.discovery.statistics.lines import pixel_sums
from cannoise_jax.discovery.statistics.score import Probe, Score, normal_log_p, skewed_log_p, unchanged

_DARK = ("dark", "bias")
_FREEDOMS = (3.0, 3.5, 4.0, 4.5, 5.0, 6.0, 7.0, 8.0, 10.0, 14.0, 20.0, 30.0, 60.0, 120.0)
_SPREADS = (0.015, 0.02, 0.03, 0.04, 0.05, 0.065, 0.08, 0.12, 0.17, 0.25, 0.35, 0.5, 0.7, 1.0)
_EDGES = np.linspace(-40, 40, 4001)
_JUMPS = np.exp(np.linspace(np.log(0.5), np.log(60.0), 24))
_SHARES = (2e-5, 1e-4, 5e-4, 2e-3)


def _rounded_enough(field: Fields) -> bool:
    """Whether rounding to the code step leaves the shape of the noise alone."""
    return bool(np.median(field.sigma) > 0.65 * field.step)


def _dark(fields: tuple[Fields, ...]) -> list[Fields]:
    return [f for f in fields if f.kind in _DARK and len(f.contrasts) and _rounded_enough(f)]


def rounding_kurtosis(mean: np.ndarray, sigma: np.ndarray, step: float) -> np.ndarray:
    """Excess kurtosis of normal noise after rounding: of given mean and standard deviation of the rounded
    values, DN. Below one step it depends on where between two codes the mean lies (Sheppard's correction is
    its mean over that place)."""
    place, wide = np.broadcast_arrays(np.asarray(mean, float) / step, np.asarray(sigma, float) / step)
    out = np.array(-1.0 / (120 * wide**4), float)
    for at in np.ndindex(wide.shape):
        width, goal = float(wide[at]), float(place[at]) % 1.0
        if width > 1.5:
            continue
        latent, middle = math.sqrt(max(width**2 - 1 / 12, 0.02)), goal
        reach = math.ceil(9 * latent) + 2
        codes = np.arange(-reach, reach + 2.0)
        for _ in range(4):  # the latent mean and width whose rounded values have the given ones
            p = np.diff(special.ndtr((np.append(codes, codes[-1] + 1) - 0.5 - middle) / latent))
            centre = float(np.sum(p * codes))
            variance = float(np.sum(p * (codes - centre) ** 2))
            middle += goal - centre
            latent = math.sqrt(max(latent**2 + width**2 - variance, 1e-3))
        out[at] = float(np.sum(p * (codes - centre) ** 4)) / variance**2 - 3
    return out


def _known_kurtosis(field: Fields) -> np.ndarray:
    """Excess kurtosis of each pixel by Poisson noise and by rounding."""
    poisson = float(np.mean(field.gain)) ** 3 * field.signal / field.sigma**4
    if field.kind not in _DARK:
        return poisson - field.step**4 / 120 / field.sigma**4
    channel = channel_index(field.mean.shape)
    chosen = [channel == c for c in range(4)]
    mean = np.array([np.median(field.mean[m]) for m in chosen])
    sigma = np.array([np.median(field.sigma[m]) for m in chosen])
    return poisson + rounding_kurtosis(mean, sigma, field.step)[channel]


def kurtosis_score(fields: tuple[Fields, ...], *, probe: str) -> Score | None:
    """Fourth moment beyond Poisson and rounding, weighted by the share of read noise; gain of Student's t."""
    u = squares = cubes = scatter = 0.0
    pooled = []
    for f in fields:
        narrow = f.step * (1.0 if f.kind == "flat" else 0.65)
        # A flat sits at one place between two codes, which one its smooth mean does not tell well enough.
        if f.static is None or np.sqrt(np.median(f.sigma**2 * (1 - f.shot))) < narrow:
            continue
        read = np.clip(1 - f.shot - f.step**2 / 12 / f.sigma**2, 0, 1)
        w = (read**2 * f.usable * (np.abs(f.static) < 7)).astype(np.float64)
        base = _known_kurtosis(f)
        squares += float(np.sum(w**2)) * f.frames
        cubes += float(np.sum(w**3)) * f.frames
        for values in each_frame(f):
            z2 = values**2
            terms = w * (z2 * z2 - 6 * z2 + 3 - base)
            u += float(np.sum(terms))
            scatter += float(np.sum(terms**2))
            if f.kind in _DARK:
                width = f.step / float(np.median(f.sigma))
                pooled.append((np.histogram(np.clip(values[w > 0], -39.9, 39.9), _EDGES)[0], width))
    if squares < 1:
        return None
    z, kappa = u / np.sqrt(24 * squares), u / squares
    gain, nu = _student_gain(pooled) if pooled and z > 0 else (0.5 * max(z, 0) ** 2, np.inf)
    # The moment is the definition; of very heavy tails it scatters too much to be used.
    amplitude = 6 / (nu - 4) if kappa > 1 and 4 < nu < np.inf else max(kappa, 0.0)
    error = float(max(np.sqrt(24 * squares), np.sqrt(scatter)) / squares)
    return Score(
        probe,
        skewed_log_p(z, 14.7 * cubes / squares**1.5, 2),
        gain,
        0.5 * float(np.log(squares)),
        float(amplitude),
        error,
        float(np.sqrt(24 / squares)),
        1,
        {"excess_kurtosis": (float(amplitude), "1", error)},
        {"axis": "signal", "range": [0.0, 0.0]},
        kappa,
    )


def _student_gain(pooled: list[tuple[np.ndarray, float]]) -> tuple[float, float]:
    """Log-likelihood gain of the best scaled Student t over the best normal, and its freedoms. pooled: counts
    of standardised values in `_EDGES` with the code step in the same units: each value stands for the
    interval that was rounded to it."""
    middle = (_EDGES[1:] + _EDGES[:-1]) / 2
    merged: dict[float, np.ndarray] = {}
    for n, width in pooled:
        merged[round(width, 3)] = merged.get(round(width, 3), 0) + n
    counts = np.concatenate([n[n > 0] for n in merged.values()]).astype(float)
    centre = np.concatenate([-np.abs(middle[n > 0]) for n in merged.values()])
    half = np.concatenate([np.full(int((n > 0).sum()), width / 2) for width, n in merged.items()])

    def fit(cdf: Callable[[np.ndarray], np.ndarray]) -> float:
        def loss(scale: float) -> float:
            inside = cdf((centre + half) / scale) - cdf((centre - half) / scale)
            return -float(np.sum(counts * np.log(np.maximum(inside, 1e-300))))

        return -float(
            optimize.minimize_scalar(loss, bounds=(0.5, 1.1), method="bounded", options={"xatol": 1e-3}).fun
        )

    normal = fit(special.ndtr)
    gains = np.array([fit(partial(special.stdtr, nu)) - normal for nu in _FREEDOMS])
    k = int(np.argmax(gains))
    return (float(gains[k]), _parabola_peak(np.array(_FREEDOMS), gains, k)) if gains[k] > 0 else (0.0, np.inf)


def skew_score(fields: tuple[Fields, ...], *, probe: str) -> Score | None:
    """Third moment beyond Poisson, weighted by the share of shot noise."""
    u = i = squares = 0.0
    for f in fields:
        if f.static is None or not f.lit or not _rounded_enough(f):
            continue
        system = float(np.mean(f.gain))
        base = system**2 * f.signal / f.sigma**3
        w = f.usable * base * (np.abs(f.static) < 7)
        for values in each_frame(f):
            term = w * (values**3 - 3 * values - base)
            u += float(np.sum(term, dtype=np.float64))
            squares += float(np.sum(term**2, dtype=np.float64))
        i += float(np.sum(w * base)) * f.frames
    if i == 0:
        return None
    # Half a per cent of the expected skewness is the uncertainty of the fitted gain.
    error = float(np.sqrt(squares + (0.005 * i) ** 2) / i)
    relative = u / i
    z = relative / error
    return Score(
        probe,
        normal_log_p(z),
        0.5 * z**2,
        5.0,
        abs(relative),
        error,
        error,
        1,
        {"relative_skewness": (relative, "1", error)},
        {"axis": "signal", "range": [0.0, 1.0]},
    )


def _square_map(fields: tuple[Fields, ...]) -> tuple[np.ndarray, np.ndarray, int] | None:
    """Temporal sum of squares of every pixel over all darks, which pixels to use, the degrees of freedom."""
    chosen = _dark(fields)
    freedom = sum(len(f.contrasts) for f in chosen)
    if freedom < 2:
        return None
    squares = np.sum([np.einsum("nij,nij->ij", f.contrasts, f.contrasts) for f in chosen], axis=0)
    return squares.astype(np.float64), np.all([f.usable for f in chosen], axis=0), freedom


def _sums_of_squares(fields: tuple[Fields, ...]) -> tuple[np.ndarray, int] | None:
    """The sums of squares of the usable pixels and their degrees of freedom."""
    found = _square_map(fields)
    return None if found is None else (found[0][found[1]], found[2])


def _rounded_dispersion(fields: tuple[Fields, ...]) -> float:
    """What the kurtosis of rounding adds to the variance of a pixel's sum of squares over all darks."""
    return float(sum(np.mean(_known_kurtosis(f)) * (f.frames - 1.0) ** 2 / f.frames for f in _dark(fields)))


def _dispersion_log_p(squares: np.ndarray, n: int, known: float) -> tuple[float, float]:
    """Over-dispersion of the sums of squares against chi-square, far pixels capped; log p and z. known: what
    rounding adds to the variance of a sum of squares."""
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
    z = total / np.sqrt(variance * squares.size)
    skewness = third / variance**1.5 / np.sqrt(squares.size)
    return skewed_log_p(z, skewness, 1), z


def spread_score(fields: tuple[Fields, ...], *, probe: str) -> Score | None:
    """A read noise of its own for every pixel (log-normal): marginal likelihood of the sums of squares."""
    found = _sums_of_squares(fields)
    if found is None:
        return None
    squares, n = found
    log_p, z = _dispersion_log_p(squares, n, _rounded_dispersion(fields))
    nodes, weights = np.polynomial.hermite_e.hermegauss(15)
    counts, centre = _histogram(squares)
    best, at = 0.0, 0.0
    gains = []
    for spread in _SPREADS:
        width = np.sqrt(np.log1p(spread**2))
        variance = np.exp(2 * (width * nodes - width**2))
        log_terms = -n / 2 * np.log(variance) + 0.5 * centre[:, None] * (1 - 1 / variance)
        top = log_terms.max(1, keepdims=True)
        gains.append(
            float(np.sum(counts * (top[:, 0] + np.log(np.exp(log_terms - top) @ (weights / weights.sum())))))
        )
    k = int(np.argmax(gains))
    if gains[k] > 0:
        best, at = gains[k], _parabola_peak(np.array(_SPREADS), np.array(gains), k)
    # chi-square dispersion grows by 4 spread^2 n^2.
    unit = 4 * n**2 / np.sqrt(_dispersion_variance(n) * squares.size) * squares.size
    error = 1 / (unit * max(2 * at, 1 / np.sqrt(unit)))
    return Score(
        probe,
        log_p,
        best,
        0.5 * float(np.log(squares.size)),
        at,
        float(error),
        float(1 / np.sqrt(unit)),
        2,
        {"spread": (at, "1", float(error))},
        {"axis": "pixel", "z": z},
        at,
    )


def _dispersion_variance(n: int) -> float:
    """Variance of (chi2_n - n)^2 with its linear part projected out."""
    return 8.0 * n**2 + 48 * n - 8 * n * 0 - 32.0 * n


def _parabola_peak(grid: np.ndarray, values: np.ndarray, k: int) -> float:
    if k in (0, len(grid) - 1):
        return float(grid[k])
    x, y = np.log(grid[k - 1 : k + 2]), values[k - 1 : k + 2]
    a, b, _ = np.polyfit(x - x[1], y, 2)
    return float(np.exp(x[1] - b / (2 * a))) if a < 0 else float(grid[k])


def _histogram(squares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Counts and centres on a fine logarithmic grid: likelihoods are then sums over a few hundred bins."""
    logs = np.log(np.maximum(squares, 1e-3))
    counts, edges = np.histogram(logs, 600)
    used = counts > 0
    return counts[used], np.exp((edges[1:] + edges[:-1]) / 2)[used]


def sparse_log_p(counts: np.ndarray, log_ratios: list[np.ndarray]) -> float:
    """log p that a few values follow another law: log_ratios holds, for several sizes of the effect, the log
    of its density over the null's at the values. The likelihood ratio averaged over sizes and shares has mean
    one under the null, so its inverse is a p-value (Markov)."""
    logs = [
        float(np.sum(counts * np.log1p(share * np.expm1(np.minimum(ratio, 600.0)))))
        for ratio in log_ratios
        for share in _SHARES
    ]
    return min(0.0, float(np.log(len(logs)) - special.logsumexp(logs)))


def telegraph_score(fields: tuple[Fields, ...], *, probe: str) -> Score | None:
    """A small share of pixels with extra fluctuation of exponentially spread size."""
    found = _sums_of_squares(fields)
    if found is None:
        return None
    squares, n = found
    counts, centre = _histogram(squares)
    extra = 1 + _JUMPS**2 / 4
    single = -n / 2 * np.log(extra) + 0.5 * centre[:, None] * (1 - 1 / extra)
    best, at, share = 0.0, 1.0, 0.0
    ratios = []
    widths = np.gradient(_JUMPS)
    for mean in np.exp(np.linspace(np.log(0.7), np.log(30), 12)):
        weight = np.exp(-_JUMPS / mean) * widths
        top = single.max(1, keepdims=True)
        mixed = (top[:, 0] + np.log(np.exp(single - top) @ (weight / weight.sum()))).clip(-50, 600)
        if mean > 2:  # smaller ones change the bulk, which rounding changes too
            ratios.append(mixed)
        f = 0.005
        for _ in range(40):
            responsibility = f * np.exp(mixed) / (1 - f + f * np.exp(mixed))
            f = float(np.clip(np.sum(counts * responsibility) / counts.sum(), 1e-6, 0.3))
        gain = float(np.sum(counts * np.log1p(f * np.expm1(mixed))))
        if gain > best:
            best, at, share = gain, float(mean), f
    number = int(np.sum(squares > stats.chi2.isf(1e-5, n)))
    log_p = sparse_log_p(counts, ratios)
    sigma = float(np.mean([np.median(f.sigma) for f in _dark(fields)]))
    amplitude = sigma * np.sqrt(share * 2 * at**2 / 4)
    error = amplitude / np.sqrt(max(share * squares.size, 1.0))
    shift = sigma * np.sqrt(np.sqrt(2 / n / squares.size))
    return Score(
        probe,
        max(log_p, -700.0),
        best,
        float(np.log(squares.size)),
        float(amplitude),
        float(error),
        float(shift),
        2,
        {
            "fraction": (share, "1", float(np.sqrt(share / squares.size))),
            "jump": (at * sigma, "DN", at * sigma / np.sqrt(max(share * squares.size, 1.0))),
        },
        {"axis": "pixel", "pixels": number},
        (share, at),
    )


def hot_score(fields: tuple[Fields, ...], *, probe: str, scaling: str) -> Score | None:
    """A few pixels far above the others in the darks, at the same places in every frame."""
    sums = pixel_sums(fields, scaling, _DARK)
    if sums is None:
        return None
    seen = sums.information > 0
    u = np.where(seen, sums.score / np.sqrt(np.where(seen, sums.information, 1.0)), 0.0).ravel()
    spread = max(1.4826 * float(np.median(np.abs(u - np.median(u)))), 1.0)
    number = int(np.sum(u > 4.6 * spread))
    ratios = []
    root = float(np.sqrt(np.median(sums.information[seen])))
    best, at, share = 0.0, 1.0, 0.0
    counts, edges = np.histogram(np.clip(u / spread, -20, 400), np.linspace(-20, 400, 8401))
    used = counts > 0
    counts, centre = counts[used], ((edges[1:] + edges[:-1]) / 2)[used]
    root /= spread
    for mean in np.exp(np.linspace(np.log(1.5), np.log(200), 14)):
        # Density of normal + exponential over the normal density.
        log_ratio = (
            0.5 / mean**2
            - centre / mean
            - np.log(mean)
            + stats.norm.logcdf(centre - 1 / mean)
            - stats.norm.logpdf(centre)
        )
        log_ratio = np.clip(log_ratio, -50, 600)
        ratios.append(log_ratio)
        f = 1e-3
        for _ in range(40):
            responsibility = f * np.exp(log_ratio) / (1 - f + f * np.exp(log_ratio))
            f = float(np.clip(np.sum(counts * responsibility) / counts.sum(), 1e-7, 0.2))
        gain = float(np.sum(counts * np.log1p(f * np.expm1(log_ratio))))
        if gain > best:
            best, at, share = gain, float(mean), f
    seconds = (
        float(np.max([f.exposure_s or 1.0 for f in fields if f.kind in _DARK]))
        if scaling == "thermal"
        else 1.0
    )
    amplitude = at / root * np.sqrt(2 * share) * seconds
    events = max(share * u.size, 1.0)
    high = [int(k) for k in np.argsort(-u)[:8]]
    width = fields[0].mean.shape[1]
    return Score(
        probe,
        max(sparse_log_p(counts, ratios), -700.0),
        best,
        float(np.log(u.size)) + 2,
        float(amplitude),
        float(amplitude / np.sqrt(events)),
        float(seconds / root / np.sqrt(np.sqrt(u.size / 2))),
        2,
        {"fraction": (share, "1", float(np.sqrt(share / u.size)))},
        {"axis": "pixel", "index": [[k // width, k % width] for k in high], "pixels": number},
        scaling,
    )


def mask_hot(fields: tuple[Fields, ...], score: Score) -> tuple[Fields, ...]:
    """Takes the pixels whose level stands out in the darks out of every field."""
    out = np.zeros(fields[0].mean.shape, bool)
    for scaling in ("additive", "thermal"):
        sums = pixel_sums(fields, scaling, _DARK)
        if sums is not None:
            out |= np.abs(sums.score / np.sqrt(np.maximum(sums.information, 1e-30))) > 4.0
    return _without(fields, out)


def mask_noisy(fields: tuple[Fields, ...], score: Score) -> tuple[Fields, ...]:
    """Takes the pixels whose variance stands out in the darks out of every field."""
    found = _square_map(fields)
    if found is None:
        return fields
    return _without(fields, found[0] > stats.chi2.isf(1e-3, found[2]))


def _without(fields: tuple[Fields, ...], out: np.ndarray) -> tuple[Fields, ...]:
    keep = ~out
    return tuple(
        f._replace(
            usable=f.usable & keep,
            contrasts=f.contrasts * keep,
            static=None if f.static is None else f.static * keep,
        )
        for f in fields
    )


def probes() -> tuple[Probe, ...]:
    """The probes of this signature."""
    pixel = {"enters": "readout", "varies_over": "pixel", "scales": "additive"}
    noisy = ("kurtosis", "pixel_spread", "telegraph", "skewness", "hot_additive", "hot_thermal")
    return (
        Probe(
            "kurtosis",
            "heavy_tails",
            {**pixel, "time": "redrawn", "law": "heavy tails"},
            partial(kurtosis_score, probe="kurtosis"),
            unchanged,
            noisy,
        ),
        Probe(
            "pixel_spread",
            "pixel_read_noise_map",
            {**pixel, "time": "frozen", "law": "log-normal variance"},
            partial(spread_score, probe="pixel_spread"),
            unchanged,
            noisy,
        ),
        Probe(
            "telegraph",
            "rts",
            {**pixel, "time": "telegraph", "law": "two levels"},
            partial(telegraph_score, probe="telegraph"),
            mask_noisy,
            noisy,
        ),
        Probe(
            "hot_additive",
            "hot_pixels",
            {**pixel, "time": "frozen", "law": "sparse"},
            partial(hot_score, probe="hot_additive", scaling="additive"),
            mask_hot,
            ("hot_thermal",),
        ),
        Probe(
            "hot_thermal",
            "hot_pixels",
            {**pixel, "time": "frozen", "scales": "exposure", "law": "sparse"},
            partial(hot_score, probe="hot_thermal", scaling="thermal"),
            mask_hot,
            ("hot_additive",),
        ),
        Probe(
            "skewness",
            None,
            {
                "enters": "photons",
                "varies_over": "pixel",
                "time": "redrawn",
                "scales": "signal",
                "law": "skewed",
            },
            partial(skew_score, probe="skewness"),
            unchanged,
        ),
    )
