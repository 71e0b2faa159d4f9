"""The curve that tells a mechanism apart: one small statistic of frames with it and without it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from cannoise_jax.physics.robust import median


class Curve(NamedTuple):
    """Two curves over the same axis. points: draw dots, for sparse axes; log: logarithmic ordinate."""

    x: np.ndarray
    without: np.ndarray
    with_it: np.ndarray
    x_label: str
    y_label: str
    log: bool = False
    points: bool = False


Statistic = Callable[[np.ndarray, np.ndarray, float], tuple[np.ndarray, np.ndarray]]


def _residual(frames: np.ndarray, signal: np.ndarray, black: float) -> np.ndarray:
    return frames - signal - black


def variance_over_signal(frames, signal, black):
    """Temporal variance in bins of the expected signal."""
    return _binned(signal, frames.var(axis=0, ddof=1))


def spatial_variance_over_signal(frames, signal, black):
    """Variance over the pixels of the mean residual times the number of frames: frozen patterns add to it."""
    mean = _residual(frames, signal, black).mean(axis=0)
    return _binned(signal, mean**2 * len(frames))


def mean_over_signal(frames, signal, black):
    """Mean residual in bins of the expected signal."""
    return _binned(signal, _residual(frames, signal, black).mean(axis=0))


def _binned(signal, values):
    edges = np.quantile(signal, np.linspace(0, 1, 21))
    edges = np.unique(edges)
    index = np.clip(np.searchsorted(edges, signal, side="right") - 1, 0, len(edges) - 2)
    count = np.bincount(index.ravel(), minlength=len(edges) - 1)
    level = np.bincount(index.ravel(), signal.ravel(), minlength=len(edges) - 1)
    total = np.bincount(index.ravel(), values.ravel(), minlength=len(edges) - 1)
    return level / np.maximum(count, 1), total / np.maximum(count, 1)


def _spectrum(series: np.ndarray):
    """Mean power over frequency of [N, n] series."""
    series = series - series.mean(axis=1, keepdims=True)
    power = (np.abs(np.fft.rfft(series)) ** 2).mean(axis=0) / series.shape[1]
    return np.fft.rfftfreq(series.shape[1])[1:], power[1:]


def row_spectrum(frames, signal, black):
    """Power spectrum of the row means of the residual."""
    return _spectrum(_residual(frames, signal, black).mean(axis=2))


def raster_spectrum(frames, signal, black):
    """Power spectrum along the raster scan, averaged in equal steps of the logarithm of frequency."""
    frequency, power = _spectrum(_residual(frames, signal, black).reshape(len(frames), -1))
    edges = np.geomspace(frequency[0], 0.5, 40)
    index = np.clip(np.searchsorted(edges, frequency, side="right") - 1, 0, 38)
    count = np.bincount(index, minlength=39)
    keep = count > 0
    total = np.bincount(index, power, minlength=39)[keep] / count[keep]
    return np.log10(np.sqrt(edges[:-1] * edges[1:]))[keep], total


def row_means(frames, signal, black):
    """Mean residual of each row over all frames."""
    return np.arange(signal.shape[0]), _residual(frames, signal, black).mean(axis=(0, 2))


def column_means(frames, signal, black):
    """Mean residual of each column over all frames."""
    return np.arange(signal.shape[1]), _residual(frames, signal, black).mean(axis=(0, 1))


def column_jitter(frames, signal, black):
    """Temporal standard deviation of each column's mean."""
    return np.arange(signal.shape[1]), _residual(frames, signal, black).mean(axis=1).std(axis=0, ddof=1)


def frame_means(frames, signal, black):
    """Mean residual of each frame."""
    return np.arange(len(frames)), _residual(frames, signal, black).mean(axis=(1, 2))


def edge_residual(frames, signal, black):
    """Mean residual in bins of the slope of the signal along the rows, frame by frame later ones weighing
    more."""
    slope = np.zeros_like(signal)
    slope[:, 2:-2] = (signal[:, 4:] - signal[:, :-4]) / 4
    weight = np.arange(1, len(frames) + 1) / len(frames)
    mean = np.average(_residual(frames, signal, black), axis=0, weights=weight)
    bins = np.linspace(-40, 40, 17)
    index = np.digitize(np.clip(slope, -39, 39), bins) - 1
    count = np.bincount(index.ravel(), minlength=16)
    total = np.bincount(index.ravel(), mean.ravel(), minlength=16)
    return (bins[:-1] + bins[1:]) / 2, np.where(count > 0, total / np.maximum(count, 1), np.nan)


def lag_correlation(frames, signal, black):
    """Correlation of the temporal noise along a row."""
    z = frames - frames.mean(axis=0)
    z = z / np.maximum(z.std(axis=0), 1e-6)
    lags = np.arange(1, 9)
    return lags, np.array([(z[:, :, :-k] * z[:, :, k:]).mean() for k in lags])


def temporal_correlation(frames, signal, black):
    """Correlation of a pixel's noise with itself frames later, averaged over the ten noisiest percent."""
    z = _residual(frames, signal, black)
    power = z.var(axis=0)
    z = (z - z.mean(axis=0))[:, power >= np.quantile(power, 0.9)]
    lags = np.arange(1, 9)
    return lags, np.array([(z[:-k] * z[k:]).mean() / (z**2).mean() for k in lags])


def tail(frames, signal, black):
    """Share of the values further than so many standard deviations of the centre above their pixel's mean."""
    z = (_residual(frames, signal, black)).ravel()
    sigma = np.percentile(np.abs(z), 68.27)
    x = np.linspace(1, 8, 29)
    return x, np.array([max((z > k * sigma).mean(), 0.5 / z.size) for k in x])


def noise_spread(frames, signal, black):
    """Share of the pixels whose temporal standard deviation is above so many times the median."""
    sigma = frames.std(axis=0, ddof=1)
    ratio = sigma / median(sigma)
    x = np.linspace(0.5, 4, 36)
    return x, np.array([max((ratio > k).mean(), 0.5 / ratio.size) for k in x])


def row_loudness(frames, signal, black):
    """Temporal standard deviation of the pixels of each row."""
    return np.arange(signal.shape[0]), np.sqrt(frames.var(axis=0, ddof=1).mean(axis=1))


def column_loudness(frames, signal, black):
    """Temporal standard deviation of the pixels of each column."""
    return np.arange(signal.shape[1]), np.sqrt(frames.var(axis=0, ddof=1).mean(axis=0))


def gap_to_neighbours(frames, signal, black):
    """Share of the values nearer than so many DN to the mean of their four neighbours of the same colour."""
    near = (frames[:, 4:, 2:-2] + frames[:, :-4, 2:-2] + frames[:, 2:-2, 4:] + frames[:, 2:-2, :-4]) / 4
    gap = np.abs(frames[:, 2:-2, 2:-2] - near)
    x = np.linspace(0.5, 10, 20)
    return x, np.array([(gap <= k).mean() for k in x])


def code_histogram(frames, signal, black):
    """How often each stored code occurs, near the black level."""
    codes = np.arange(int(black) - 12, int(black) + 52)
    counts = np.bincount(frames.astype(int).ravel(), minlength=2048)
    return codes, np.maximum(counts[codes], 0.5)


def high_codes(frames, signal, black):
    """How often each stored code occurs, in the brightest fifth."""
    codes = np.arange(350, 760)
    counts = np.bincount(frames.astype(int).ravel(), minlength=2048)
    return codes, np.maximum(counts[codes], 0.5)


def centre_profile(frames, signal, black):
    """Mean residual over the distance from the centre."""
    y, x = np.indices(signal.shape) - np.array(signal.shape).reshape(2, 1, 1) / 2
    r = np.hypot(y, x)
    mean = _residual(frames, signal, black).mean(axis=0)
    ring = (r / 6).astype(int)
    count = np.bincount(ring.ravel())
    whole = count >= 40  # rings that lie almost outside the frame are noise
    return (np.arange(count.size) * 6 + 3)[whole], (np.bincount(ring.ravel(), mean.ravel()) / count)[whole]


def site_means(frames, signal, black):
    """Mean residual of each of the four mosaic sites."""
    mean = _residual(frames, signal, black).mean(axis=0)
    return np.arange(4), np.array([mean[i::2, j::2].mean() for i in (0, 1) for j in (0, 1)])


KINDS: dict[str, tuple[Statistic, str, str, bool, bool]] = {
    "variance": (variance_over_signal, "signal, DN", "variance, DN²", False, False),
    "spatial": (
        spatial_variance_over_signal,
        "signal, DN",
        "T × variance of the mean, DN²",
        True,
        False,
    ),
    "mean": (mean_over_signal, "signal, DN", "mean residual, DN", False, False),
    "row spectrum": (row_spectrum, "cycles per row", "power of row means, DN²", True, False),
    "raster spectrum": (raster_spectrum, "log₁₀ cycles per pixel of the scan", "power, DN²", True, False),
    "rows": (row_means, "row", "mean residual, DN", False, False),
    "columns": (column_means, "column", "mean residual, DN", False, False),
    "column jitter": (column_jitter, "column", "rms of column mean, DN", False, False),
    "frames": (frame_means, "frame", "mean residual, DN", False, True),
    "edges": (edge_residual, "slope of the signal, DN/px", "mean residual, DN", False, True),
    "lags": (lag_correlation, "pixels along a row", "correlation", False, True),
    "temporal": (temporal_correlation, "frames later", "correlation", False, True),
    "tail": (tail, "standard deviations", "share above", True, False),
    "spread": (noise_spread, "pixel's noise over median", "share above", True, False),
    "row loudness": (row_loudness, "row", "rms of its pixels over time, DN", False, False),
    "column loudness": (column_loudness, "column", "rms of its pixels over time, DN", False, False),
    "gaps": (gap_to_neighbours, "distance from the neighbours' mean, DN", "share nearer", False, False),
    "codes": (code_histogram, "code, DN", "count", True, False),
    "high codes": (high_codes, "code, DN", "count", True, False),
    "radius": (centre_profile, "pixels from the centre", "mean residual, DN", False, False),
    "sites": (site_means, "mosaic site", "mean residual, DN", False, True),
}


def curve_of(kind: str, without: np.ndarray, with_it: np.ndarray, signal: np.ndarray, black: float) -> Curve:
    """The curve of a kind; frames [T, H, W] in DN, signal [H, W] above black."""
    statistic, x_label, y_label, log, points = KINDS[kind]
    x, quiet = statistic(without, signal, black)
    _, loud = statistic(with_it, signal, black)
    return Curve(x, quiet, loud, x_label, y_label, log, points)
