"""Noise with a spectrum: 1/f along the scan or from row to row, and interference at one frequency.

Both 1/f estimators fit strength and exponent by the likelihood of a Gaussian sequence and give profile-
likelihood intervals (the parameter values at which the profile has dropped by half the 90 % quantile of
chi-square), which hold near zero strength, where the standard error means little.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy import stats
from scipy.interpolate import PchipInterpolator

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.likelihood.whittle import white_level, whittle
from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.estimate import Z90, Estimate, Estimates, normal_estimate
from cannoise_jax.physics.transfer.estimator import BY_CHANCE
from cannoise_jax.physics.transfer.estimators.circle import circle, of_largest
from cannoise_jax.physics.transfer.estimators.pick import (
    darkest,
    mean_variance,
    pooled_variance,
    repeated_darks,
    row_offsets,
)
from cannoise_jax.physics.transfer.fit import median_quotient
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.views import left_in_lines
from cannoise_jax.recordings.metadata import chunks

_MOST_ROWS = 512  # rows that the covariance of row_pink_noise is built for
_EXPONENTS = np.linspace(0.0, 2.0, 41)
"""Exponents of 1/f noise that are tried, white to Brownian, between which the likelihood is interpolated."""
_STRENGTHS = np.concatenate([[0.0], np.geomspace(1e-3, 10.0, 200)])  # in units of the total rms
_DROP = float(stats.chi2.ppf(0.9, 1)) / 2
"""Nats by which a log-likelihood falls at the ends of an interval of 90 % (Wilks, Ann. Math. Stat. 9,
60, 1938)."""
_BY_CHANCE = 0.05
"""Chance of the largest line by noise alone above which its frequency is any: then the interval is all of
them."""


def row_pink_noise(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """sigma_dn and exponent of row offsets with a 1/f^exponent spectrum, from row means of repeated darks.

    What is constant over frames and what a frame does as a whole is projected out. Of tall frames the middle
    512 rows are used.
    """
    dark = darkest(statistics)
    if dark is None:
        return repeated_darks(statistics)
    means = dark.row_means.mean(-1)
    height = means.shape[1]
    first = max(0, (height - _MOST_ROWS) // 2)
    rest = means[:, first : first + _MOST_ROWS]
    rest = rest - rest.mean(0)
    rest = rest - rest.mean(1, keepdims=True)
    scatter, dof = rest.T @ rest, len(rest) - 1
    variance, _ = mean_variance(dark)
    white = variance * left_in_lines(dark, 0)
    sigmas = _STRENGTHS * np.sqrt(np.trace(scatter) / (dof * len(scatter)))
    loglik = [_line_loglik(scatter, dof, white, sigmas, height, a) for a in _EXPONENTS]
    return _profiles(np.array(loglik), sigmas, _EXPONENTS)


def pink_noise(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """sigma_dn and exponent (0.5 to 2) of 1/f noise along the raster scan, from repeated darks.

    Only what happens within rows is used, periodograms of single rows without their means, so that row noise
    of any kind, which a scan repeats at every row, cannot pass for pink noise; the strength is that of the
    whole scan, extrapolated by the exponent. Periodograms are averaged over rows and frames and compared with
    their expectation for a short stretch of a long 1/f scan (debiased Whittle likelihood, Sykulski et al.,
    Biometrika 106, 251, 2019). The strength of the white noise is fitted along.
    """
    dark = darkest(statistics)
    if dark is None:
        return repeated_darks(statistics)
    height, width = dark.recording.size
    seen = row_power(dark)
    # Both the real and the imaginary part of every row and frame, less one frame for the averages.
    dof = np.full(len(seen), 2.0 * height * (dark.recording.count - 1))
    dof[-1] /= 2 if width % 2 == 0 else 1
    exponents = _EXPONENTS[_EXPONENTS >= 0.5]
    sigmas = _STRENGTHS * np.sqrt(float(seen.mean()))
    shapes, losses = zip(*(_expected_rows(height, width, float(a)) for a in exponents), strict=True)
    dof = dof / np.max(losses, axis=0)
    loglik = [_beside_white(seen, dof, shape, sigmas) for shape in shapes]
    return _profiles(np.array(loglik), sigmas, exponents)


def banding(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """amplitude_dn (peak) and frequency (cycles per pixel of the scan) of the strongest line in the raster
    periodogram, summed over frames because the phase is new in each.

    Row means are taken out, so row noise cannot pass for a line; waves slower than two rows are left to the
    estimators of row noise. The frequency is refined until the power at it is largest; its error is the
    Cramer-Rao bound of a sinusoid of unknown phase (Rife and Boorstyn, IEEE Trans. Inf. Theory 20, 1974). The
    largest of many powers is biased upwards, so its interval may leave out zero in white noise; the chance of
    that is the amplitude's. Where chance alone shows such a line in one of twenty recordings the interval of
    the frequency is all that was looked at.
    """
    dark = darkest(statistics)
    if dark is None:
        return repeated_darks(statistics)
    power = scan_power(dark)
    frames, (height, width) = dark.recording.count, dark.recording.size
    count = height * width
    slowest = height // 2
    frequency = _refined(dark, (slowest + int(np.argmax(power[slowest - 1 :]))) / count)
    # Of a wave the row means hold the share `lost`; of white noise at its frequency they hold as much.
    lost = (np.sin(np.pi * frequency * width) / (width * np.sin(np.pi * frequency))) ** 2
    floor = float(median(power)) / median_quotient(2.0 * (frames - 1))  # noise power per frequency
    points = _coefficients(dark, np.array([frequency]), residual=False)[:, 0] * 2 / count / (1 - lost)
    amplitude, stderr = circle(points, np.sqrt(2 * floor / count / (1 - lost)))
    strength = max(amplitude, stderr) ** 2
    # Powers of frames are summed without their phases: noise beats with itself where a frame shows little.
    beats = 1 + 4 * floor / (strength * count)
    by_bound = np.sqrt(24 * floor * beats / (strength * count**3 * max(frames - 1, 1))) / (2 * np.pi)
    top = float(np.sum(np.abs(_coefficients(dark, np.array([frequency]))) ** 2)) / count
    found = normal_estimate(amplitude, stderr)
    chance = of_largest(top / max(floor, pooled_variance(dark)[0]), frames - 1, count)
    return {
        "amplitude_dn": Estimate(found.value, found.stderr, found.ci90, chance),
        "frequency": _frequency(frequency, float(by_bound), chance, slowest / count),
    }


def _frequency(value: float, stderr: float, chance: float, slowest: float) -> Estimate:
    if chance <= _BY_CHANCE:
        return normal_estimate(value, stderr)
    return Estimate(value, (0.5 - slowest) / np.sqrt(12), (slowest, 0.5))


def beside_rows(wave: Mapping[str, Estimate], place: Point, dark: FrameStatistics) -> bool:
    """Whether rows whose even and odd columns differ make the line themselves."""
    if place.over != "row" or place.interleave != 2:
        return False
    return chance_beside_half(dark, wave["frequency"].value, place.group) > BY_CHANCE


def reaches_no_further(rows: Mapping[str, Estimate], statistics: Sequence[FrameStatistics]) -> str:
    """What speaks against 1/f noise from row to row: an exponent that chance makes of white rows, or rows two
    to six apart that are not half as alike as it would make them. (A correlation with the next row only, as
    some readouts have, also draws the exponent away from zero.)"""
    dark, exponent = darkest(statistics), rows["exponent"]
    against = "(rows are not alike over distance, as 1/f would be)"
    if dark is None or exponent.ci90[0] <= 0 or exponent.by_chance > BY_CHANCE:
        return against
    rest = row_offsets(dark)
    rest = rest - rest.mean(0)
    height, power = rest.shape[1], np.mean(rest**2)
    lags = range(2, min(7, height // 2))
    seen = np.mean([np.mean(rest[:, k:] * rest[:, :-k]) / power for k in lags])
    model = power_law_correlation(2 * height, exponent.value)
    # Taking out frame means lowers all correlations alike.
    level = (2 * np.sum((height - np.arange(height)) * model[:height]) / height - 1) / height
    expected = np.mean([(model[k] - level) / (1 - level) for k in lags])
    return "" if seen > 0.5 * expected else against


def chance_beside_half(dark: FrameStatistics, frequency: float, group: int = 1) -> float:
    """The chance of the strongest line where row noise that even and odd columns do not share shows, next to
    half a cycle per pixel; 0 for a frequency elsewhere. group: rows that share an offset."""
    height, width = dark.recording.size
    frames = dark.recording.count - 1
    if abs(frequency - 0.5) > 0.5 / width:
        return 0.0
    near = scan_power(dark)[-(height // 2) :]
    # Offsets that rows share have their power at few frequencies.
    floor = group * float(median(near)) / median_quotient(2.0 * frames)
    return of_largest(float(near.max()) * frames / floor, frames, height)


def scan_power(s: FrameStatistics) -> Float[np.ndarray, "n/2"]:
    """Periodogram |FFT|^2 / n of the raster scan without its average over frames and its row means, DN^2,
    mean over frames by T - 1; frequencies 1/n to 1/2. White noise of variance v gives v."""
    total: np.ndarray | float = 0.0
    for frame in residual_frames(s):
        total = total + np.abs(np.fft.rfft(frame.ravel())[1:]) ** 2
    return np.asarray(total) / s.mean.size / (s.recording.count - 1)


def residual_frames(s: FrameStatistics) -> Iterator[Float[np.ndarray, "H W"]]:
    """Frames less the average of all frames and less their row means, one at a time."""
    for part in chunks(s.recording.frames):
        for frame in part:
            rest = frame - s.mean
            yield rest - rest.mean(1, keepdims=True)


def row_power(s: FrameStatistics) -> Float[np.ndarray, "w/2"]:
    """Periodogram of single rows without the average frame, DN^2, mean over rows and (T - 1) frames;
    frequencies 1/W to 1/2."""
    total: np.ndarray | float = 0.0
    for frame in residual_frames(s):
        total = total + np.sum(np.abs(np.fft.rfft(frame, axis=1)[:, 1:]) ** 2, 0)
    return np.asarray(total) / s.mean.size / (s.recording.count - 1)


@functools.lru_cache(maxsize=64)
def _expected_rows(height: int, width: int, exponent: float) -> tuple[np.ndarray, np.ndarray]:
    """Expected periodogram of a row of a 1/f^exponent scan of unit rms (half of a circle of twice the length,
    see `fields.colour`), frequencies 1/W to 1/2, and by how much likeness of rows thins out their number."""
    correlation = power_law_correlation(2 * height * width, exponent)
    window = 1 - np.abs(np.arange(-width, width)) / width

    def between(rows: int) -> np.ndarray:
        lags = rows * width + np.arange(-width, width)
        spectrum = np.fft.fft(np.fft.ifftshift(window * correlation[np.abs(lags)]))
        return spectrum[2 : width + 1 : 2]

    own = between(0).real
    loss = 1 + 2 * sum(np.abs(between(m) / own) ** 2 for m in range(1, min(height, 9)))
    return own, np.asarray(loss)


def power_law_correlation(length: int, exponent: float) -> Float[np.ndarray, "n"]:
    """Correlation of a unit-rms 1/f^exponent sequence on a circle; the zero frequency has the lowest one's
    power. The float64 twin of the shaping in `fields`."""
    index = np.maximum(np.arange(length // 2 + 1), 1.0)
    acf = np.fft.irfft(index**-exponent, length)
    return acf / acf[0]


def _line_loglik(
    scatter: np.ndarray, dof: int, white: float, sigmas: np.ndarray, height: int, exponent: float
) -> np.ndarray:
    power, vectors = _line_modes(len(scatter), height, float(exponent))
    seen = np.einsum("ik,ik->k", vectors, scatter @ vectors)
    spectrum = sigmas[:, None] ** 2 * power + white
    return -0.5 * (dof * np.log(spectrum) + seen / spectrum).sum(1)


@functools.lru_cache(maxsize=128)
def _line_modes(rows: int, height: int, exponent: float) -> tuple[np.ndarray, np.ndarray]:
    """Variances [n-1] and modes [n, n-1] of a 1/f^exponent sequence whose mean is taken out."""
    acf = power_law_correlation(2 * height, exponent)[:rows]
    matrix = acf[np.abs(np.subtract.outer(np.arange(rows), np.arange(rows)))]
    matrix = matrix - matrix.mean(0) - matrix.mean(1, keepdims=True) + matrix.mean()
    power, vectors = np.linalg.eigh(matrix)
    constant = np.argmax(np.abs(vectors.sum(0)))
    return np.maximum(np.delete(power, constant), 0.0), np.delete(vectors, constant, axis=1)


def _beside_white(seen: np.ndarray, dof: np.ndarray, pink: np.ndarray, sigmas: np.ndarray) -> np.ndarray:
    """Log-likelihood per strength with the white level fitted."""
    colour = sigmas[:, None] ** 2 * pink
    return whittle(seen, dof, colour + white_level(seen, dof, colour))


def _profiles(
    loglik: Float[np.ndarray, "a s"], sigmas: Float[np.ndarray, "s"], exponents: Float[np.ndarray, "a"]
) -> dict[str, Estimate]:
    strength = _profile_estimate(sigmas, loglik.max(0))
    # Against no such noise at all: twice the gain in likelihood, with the exponent free to choose.
    chance = float(stats.chi2.sf(2 * (loglik.max() - loglik[:, 0].max()), 2))
    return {
        "sigma_dn": Estimate(strength.value, strength.stderr, strength.ci90, chance),
        "exponent": _profile_estimate(exponents, loglik.max(1)),
    }


def _profile_estimate(grid: Float[np.ndarray, "n"], loglik: Float[np.ndarray, "n"]) -> Estimate:
    """Peak of a profile and where it has dropped by the 90 % quantile; the grid's ends where it has not."""
    fine = np.interp(np.linspace(0, len(grid) - 1, 20 * len(grid)), np.arange(len(grid)), grid)
    values = PchipInterpolator(grid, loglik)(fine)
    top = int(np.argmax(values))
    inside = np.flatnonzero(values >= values[top] - _DROP)
    low, high = float(fine[inside[0]]), float(fine[inside[-1]])
    return Estimate(float(fine[top]), (high - low) / (2 * Z90), (low, high))


def _coefficients(
    s: FrameStatistics, frequencies: Float[np.ndarray, "f"], residual: bool = True
) -> np.ndarray:
    """Fourier sums of every frame's scan at given frequencies, [T, f]; residual: less the average frame, else
    less the average level. Separable over rows and columns."""
    height, width = s.recording.size
    across = np.exp(-2j * np.pi * np.outer(np.arange(width), frequencies))
    down = np.exp(-2j * np.pi * np.outer(np.arange(height) * width % 2**40, frequencies))
    back = 0.0 if residual else s.mean - s.mean.mean(1, keepdims=True)
    return np.array([np.einsum("hf,hf->f", (f + back) @ across, down) for f in residual_frames(s)])


def _refined(s: FrameStatistics, frequency: float) -> float:
    """The frequency of most power within one step of the periodogram: three ever finer grids."""
    step = 1.0 / s.mean.size
    for _ in range(4):
        grid = frequency + step * np.linspace(-1, 1, 9)
        power = np.sum(np.abs(_coefficients(s, grid)) ** 2, 0)
        top = int(np.argmax(power))
        frequency, step = float(grid[top]), step / 4
    a, b, c = power[max(top - 1, 0)], power[top], power[min(top + 1, 8)]
    curvature = a - 2 * b + c
    shift = 0.5 * (a - c) / curvature if curvature < 0 and 0 < top < 8 else 0.0
    return float(np.clip(frequency + shift * step, 0.0, 0.5))
