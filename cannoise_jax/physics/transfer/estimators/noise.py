"""Size and shape of the noise of single pixels: errors of a baseline, heavy tails."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import special

from cannoise_jax.physics.core import tukey_lambda
from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.estimate import (
    Estimate,
    Estimates,
    NotMeasurable,
    normal_estimate,
    root,
)
from cannoise_jax.physics.transfer.estimators.codes import joined_codes
from cannoise_jax.physics.transfer.estimators.pick import (
    darkest,
    odd_by_charge,
    repeated_darks,
)
from cannoise_jax.physics.transfer.fit import robust_mean_square
from cannoise_jax.physics.transfer.frames import FrameStatistics, steady_frames
from cannoise_jax.physics.transfer.photon_transfer import channel_lines
from cannoise_jax.physics.transfer.quiet import TOO_FEW_CODES, coarse
from cannoise_jax.physics.transfer.regions import uneven_noise
from cannoise_jax.physics.transfer.views import pixel_variance
from cannoise_jax.recordings.codes import code_histogram, code_histograms
from cannoise_jax.recordings.metadata import chunks
from cannoise_jax.recordings.packing import site

_ASSUMED = NotMeasurable("give the baseline that is assumed: shot and read coefficients of the recording")
_FEWEST = 100.0  # counts of a class of codes in the tails
_FEWEST_FRAMES = 4
"""Of one pixel, that tell a kurtosis."""
_SHOWN = 0.5
"""Of the tails of all values, the least that single pixels have to show: whether none or all is nearer."""
_DRAWN = 100_000
"""Pixels drawn for the kurtosis that few frames show: to 0.01."""


def gain_error(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """error: system gain by photon transfer over the assumed one, minus one; channels weighted."""
    if baseline is None:
        return _ASSUMED
    lines = channel_lines(statistics)
    found = [
        line.slope.scaled(1 / g)
        for line, g in zip(lines, baseline.gain, strict=True)
        if hasattr(line, "slope")
    ]
    if not found:
        return next(line for line in lines if isinstance(line, NotMeasurable))
    return {"error": _weighted(found).shifted(-1.0)}


def read_noise_error(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """error: temporal dark noise of the pixels over the assumed one, minus one."""
    dark = darkest(statistics)
    if baseline is None or dark is None:
        return _ASSUMED if baseline is None else repeated_darks(statistics)
    found = []
    for c in range(4):
        variance = pixel_variance(dark, c)
        square, keep = robust_mean_square(variance, dark.dof)
        stderr = float(variance[keep].std() / np.sqrt(keep.sum()))
        sigma = root(normal_estimate(square - dark.code_step**2 / 12, stderr))
        found.append(sigma.scaled(1 / baseline.read_noise[c]))
    return {"error": _weighted(found).shifted(-1.0)}


def heavy_tails(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """tukey_lambda: maximum likelihood of the histograms of codes in the dark, discretised to the code step;
    centre and width of every channel are fitted along.

    Telegraph pixels and a spread of read noise over the pixels make the same histogram: a lambda below 0.135
    only means heavy tails where those are absent. Warm pixels, which have levels of their own, do not count.
    Of codes that a digital gain, or a table, left unevenly spaced, that of the codes one by one counts where
    it is nearer to a Gaussian: what lies further apart there has no rarer values.
    """
    dark = darkest(statistics)
    if dark is None:
        return repeated_darks(statistics)
    if why := uneven_noise(dark) or coarse(dark):
        return NotMeasurable(why)
    odd = odd_by_charge(dark, None if baseline is None else baseline.gain)
    found = _tails_of(dark, odd)
    step = int(dark.code_step) or 1
    joined = joined_codes(code_histogram(dark.recording.frames), step)
    if joined is not None and isinstance(found, Estimate):
        other = _tails_of(dark, odd, joined)
        both = (found, other) if isinstance(other, Estimate) else (found,)
        found = min(both, key=lambda e: abs(e.value - tukey_lambda.GAUSSIAN))
    return found if isinstance(found, NotMeasurable) else {"tukey_lambda": found}


def _tails_of(
    dark: FrameStatistics, odd: Bool[np.ndarray, "H W"], joined: Int[np.ndarray, "65536"] | None = None
) -> Estimate | NotMeasurable:
    """Tukey's lambda of the values of a dark, without odd pixels. joined: what stands for every code."""
    step = dark.code_step if dark.code_step > 0 else 1.0
    histograms = np.zeros((4, 1 << 16), np.int64)
    means = dark.frame_means
    if joined is not None:
        means = np.interp(means, np.arange(len(joined)), joined)
    moves, at = _level_moves(means, int(step)), 0
    for stored in chunks(dark.recording.frames):
        values = stored if joined is None else joined[stored].astype(np.uint16)
        part = _moved(values, moves[at : at + len(stored)])
        at += len(stored)
        histograms += code_histograms(part)
        for c in range(4):
            left_out = site(part, c)[:, site(odd, c)].ravel()
            histograms[c] -= np.bincount(left_out, minlength=1 << 16)
    found = []
    for histogram in histograms:
        if not histogram.any():
            return NotMeasurable("every pixel is hit or warm: record shorter darks, or a larger frame")
        edges, counts = _classes(histogram, step)
        if len(counts) < 5:
            return NotMeasurable(TOO_FEW_CODES)
        found.append(_tail_shape(edges, counts))
    return _weighted(found)


def no_heavier(tails: Mapping[str, Estimate], statistics: Sequence[FrameStatistics]) -> str:
    """What speaks against heavy tails: a shape on the light side of a Gaussian, or single pixels whose frames
    show hardly half of them. Levels and dark charge of their own, and codes that lie unevenly, make tails of
    the values of all that those of one pixel have not."""
    shape, dark = next(iter(tails.values())).value, darkest(statistics)
    if shape > tukey_lambda.GAUSSIAN:
        return "(no heavier than a Gaussian)"
    if dark is None or dark.recording.count < _FEWEST_FRAMES:
        return ""
    least = _SHOWN * _own_kurtosis_of(shape, dark.recording.count)
    said = "(not within single pixels: levels and charge of their own, or their codes, make such tails)"
    return said if own_kurtosis(dark) < least else ""


def own_kurtosis(dark: FrameStatistics) -> float:
    """Excess kurtosis of the frames of one pixel, the mean over all: G2, which for Gaussian noise is 0 on
    average whatever level and noise a pixel has (Joanes and Gill, The Statistician 47, 183, 1998)."""
    second, fourth = np.zeros(dark.mean.shape), np.zeros(dark.mean.shape)
    for frame in steady_frames(dark):
        square = (frame - dark.mean) ** 2
        second += square
        fourth += square**2
    keep = ~dark.clipped & (second > 0)
    return _mean_g2(second[keep], fourth[keep], dark.recording.count) if keep.any() else 0.0


def _mean_g2(second: Float[np.ndarray, "n"], fourth: Float[np.ndarray, "n"], count: int) -> float:
    """The mean of G2 over pixels. second, fourth: sums over their frames of powers of what those differ by
    from the mean."""
    plain = float(np.mean(count * fourth / second**2)) - 3
    return (count - 1) / ((count - 2) * (count - 3)) * ((count + 1) * plain + 6)


def _own_kurtosis_of(shape: float, count: int) -> float:
    """The same of so many frames of noise of Tukey's lambda, which of few frames is far less than of many."""
    chances = np.random.default_rng(0).random((count, _DRAWN))
    values = (chances**shape - (1 - chances) ** shape) / shape if shape else special.logit(chances)
    square = (values - values.mean(0)) ** 2
    return _mean_g2(square.sum(0), np.square(square).sum(0), count)


def _weighted(found: list[Estimate]) -> Estimate:
    weight = np.array([1 / max(f.stderr, 1e-12) ** 2 for f in found])
    value = float(np.sum(weight * [f.value for f in found]) / weight.sum())
    return normal_estimate(value, float(weight.sum() ** -0.5))


def _level_moves(means: Float[np.ndarray, "T 4"], step: int) -> Int[np.ndarray, "T 4"]:
    """How far each frame lies above the middle one, whole codes: what a frame does as a whole is no noise of
    its pixels, and makes two humps of one histogram. means: of the frames."""
    apart = means - median(means, axis=0)
    return step * np.rint(apart / step).astype(np.int64)


def _moved(stored: np.ndarray, moves: Int[np.ndarray, "n 4"]) -> np.ndarray:
    """The frames with their codes moved down by so much."""
    if not moves.any():
        return stored
    out = stored.astype(np.int64)
    for c in range(4):
        site(out, c)[...] -= moves[:, c, None, None]
    return np.clip(out, 0, np.iinfo(np.uint16).max).astype(np.uint16)


def _classes(histogram: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Inner edges between classes of codes, DN, and counts; codes in the tails are joined to 100 counts."""
    codes = np.flatnonzero(histogram)
    lattice = np.arange(codes[0], codes[-1] + 1, int(step))
    counts = histogram[lattice].astype(np.float64)
    low = int(np.searchsorted(np.cumsum(counts), _FEWEST))
    high = len(counts) - 1 - int(np.searchsorted(np.cumsum(counts[::-1]), _FEWEST))
    joined = np.concatenate([[counts[: low + 1].sum()], counts[low + 1 : high], [counts[high:].sum()]])
    return lattice[low:high] + step / 2, joined


def _tail_shape(edges: Float[np.ndarray, "n-1"], counts: Float[np.ndarray, "n"]) -> Estimate:
    """Tukey's lambda of a histogram with two open ends, by scoring steps on (centre, log width, lambda)."""
    total = counts.sum()
    share = np.cumsum(counts)[:-1] / total
    centre = float(np.interp(0.5, share, edges))
    width = float(np.interp(0.84, share, edges) - np.interp(0.16, share, edges)) / 2
    at = np.array([centre, np.log(max(width, 1e-3)), 0.05])
    steps = np.array([1e-3 * width, 1e-3, 1e-3])

    def chances(p: np.ndarray) -> np.ndarray:
        shape = float(np.clip(p[2], -0.45, 0.9))
        scale = np.exp(p[1]) / float(np.sqrt(tukey_lambda.variance(shape)))
        cumulative = special.tklmbda((edges - p[0]) / scale, shape)
        return np.maximum(np.diff(np.concatenate([[0.0], cumulative, [1.0]])), 1e-12)

    information = np.eye(3)
    for _ in range(25):
        model = chances(at)
        slope = np.stack([(chances(at + d) - chances(at - d)) / (2 * d.sum()) for d in np.diag(steps)], -1)
        information = total * (slope / model[:, None]).T @ slope
        move = np.linalg.solve(information, slope.T @ (counts / model))
        move *= min(1.0, 0.3 / max(abs(move[1]), abs(move[2]), 1e-12))
        at = at + move
        at[2] = np.clip(at[2], -0.45, 0.9)
        if np.all(np.abs(move) < 1e-2 * steps):
            break
    return normal_estimate(float(at[2]), float(np.sqrt(np.linalg.inv(information)[2, 2])))
