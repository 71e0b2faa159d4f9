"""What neighbouring pixels share: covariances at small lags of frames whose fixed pattern is taken out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float
from scipy import optimize

from cannoise_jax.physics.estimate import Estimates, normal_estimate
from cannoise_jax.physics.estimators.pick import (
    REPEATED_DARKS,
    REPEATED_FLATS,
    brightest_flat,
    darkest,
)
from cannoise_jax.physics.transfer_frames import FrameStatistics, steady_frames
from cannoise_jax.recordings.recording import mosaic_map, per_channel


def crosstalk(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """fraction of the charge given away, from the covariance of neighbours in flats less that in darks.

    With a share a/4 to each neighbour their covariance is (1-a) a/4 (V_i S_j/S_i + V_j S_i/S_j) / q,
    q = (1-a)^2 + a^2/4, in the shot variances V and signals S as they are measured.
    """
    flat, dark = brightest_flat(statistics), darkest(statistics)
    if flat is None:
        return REPEATED_FLATS
    shot = lag_covariances(flat)
    read = lag_covariances(dark) if dark is not None else None
    signal = mosaic_map(per_channel(np.maximum(flat.level, 1.0)), flat.recording.size).astype(np.float64)
    variance = _channel_map(flat) - (_channel_map(dark) if dark is not None else 0.0)
    ratio = variance / signal
    reach, seen, errors = [], [], []
    row = flat.recording.size[1] // 2
    # The means taken out of both colours of a row hold two of these covariances per pixel; those of two rows
    # that lie below each other one.
    for lag, axis, lost in (((0, 1), 1, 2 / row), ((1, 0), 0, 1 / row)):
        value, error = shot[lag]
        if read is not None:
            value, error = value - read[lag][0], float(np.hypot(error, read[lag][1]))
        value, error = value / (1 - lost), error / (1 - lost)
        expected = ratio * np.roll(signal, -1, axis) + np.roll(ratio, -1, axis) * signal
        seen.append(value)
        errors.append(error)
        reach.append(float(expected.mean()))
    rho, stderr = np.sum(seen) / np.sum(reach), float(np.linalg.norm(errors)) / np.sum(reach)

    def given(r: float) -> float:
        return _solved(lambda a: (1 - a) * a / 4 / ((1 - a) ** 2 + a**2 / 4), r, 0.6)

    return {"fraction": _through(given, float(rho), float(stderr))}


def in_camera_denoising(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """weight of the mean of the four nearest pixels of the same colour, from their correlation in darks (or
    in flats): 2 (1-w) w/4 / ((1-w)^2 + w^2/4), less what row means take with them."""
    s = darkest(statistics) or brightest_flat(statistics)
    if s is None:
        return REPEATED_DARKS
    found = lag_covariances(s)
    power = found[0, 0][0] - s.code_step**2 / 12
    seen = (found[0, 2][0] + found[2, 0][0]) / 2 / power
    height, width = (n // 2 for n in s.recording.size)

    def correlation(w: float) -> float:
        row = ((1 - w / 2) ** 2 + w**2 / 8) / width  # variance of a row mean
        rows = (1 - w / 2) * w / 2 / width  # covariance of the means of two rows
        return ((1 - w) * w / 2 - (row + rows) / 2) / ((1 - w) ** 2 + w**2 / 4 - row)

    def blended(r: float) -> float:
        low, high = -0.5, 0.8
        if r >= correlation(high):
            return high
        return (
            float(optimize.brentq(lambda w: correlation(w) - r, low, high)) if r > correlation(low) else low
        )

    pixels = 4 * height * width * (s.recording.count - 1)
    return {"weight": _through(blended, seen, _correlation_error(blended(seen), pixels))}


def _correlation_error(weight: float, pixels: int) -> float:
    """Standard error of the mean correlation at lags (0, 2) and (2, 0) of a field that was blended with this
    weight: the formula of Bartlett for the ratio of covariances, in units of same-colour pixels."""
    kernel = np.zeros((16, 16))
    kernel[0, 0] = 1 - weight
    for at in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        kernel[at] = weight / 4
    own = np.fft.ifft2(np.abs(np.fft.fft2(kernel)) ** 2).real
    lags = ((0, 1), (1, 0), (0, 0))
    rho = (own[0, 1] + own[1, 0]) / 2 / own[0, 0]
    slopes = np.array([0.5, 0.5, -rho]) / own[0, 0]
    spread = np.array(
        [
            [
                np.sum(own * np.roll(own, (a[0] - b[0], a[1] - b[1]), (0, 1)))
                + np.sum(np.roll(own, a, (0, 1)) * np.roll(own, (-b[0], -b[1]), (0, 1)))
                for b in lags
            ]
            for a in lags
        ]
    )
    return float(np.sqrt(slopes @ spread @ slopes / pixels))


def lag_covariances(s: FrameStatistics) -> dict[tuple[int, int], tuple[float, float]]:
    """Temporal covariance of pixels at lags (dy, dx) up to two, DN^2, and its error (Bartlett, with the
    variance of products measured on the data)."""
    lags = [(0, 0), (0, 1), (1, 0), (1, 1), (0, 2), (2, 0)]
    totals = dict.fromkeys(lags, 0.0)
    squares = dict.fromkeys(lags, 0.0)
    height, width = s.recording.size
    for rest in _residuals(s):
        for dy, dx in lags:
            product = rest[: height - dy, : width - dx] * rest[dy:, dx:]
            totals[dy, dx] += float(product.sum())
            squares[dy, dx] += float((product**2).sum())
    out = {}
    frames = s.recording.count
    for dy, dx in lags:
        pairs = (height - dy) * (width - dx)
        mean = totals[dy, dx] / pairs / (frames - 1)
        # A residual holds (T - 1)/T of the variance, its square as much of that again.
        spread = max(squares[dy, dx] / pairs * frames / (frames - 1) ** 2 - mean**2, 0.0)
        out[dy, dx] = mean, float(np.sqrt(spread / pairs / (frames - 1)))
    return out


def _residuals(s: FrameStatistics) -> Iterator[Float[np.ndarray, "H W"]]:
    """Frames with rows brought to a common level, less their average; outliers cut at eight sigma."""
    total, count = np.zeros(s.mean.shape), s.recording.count
    for frame in steady_frames(s):
        total += frame
    assert s.variance is not None
    limit = 8 * np.sqrt(_channel_map(s))
    for frame in steady_frames(s):
        yield np.clip(frame - total / count, -limit, limit)


def _channel_map(s: FrameStatistics) -> Float[np.ndarray, "H W"]:
    """The median-free mean temporal variance of every channel, spread over the mosaic."""
    assert s.variance is not None
    means = [float(np.mean(s.variance[c // 2 :: 2, c % 2 :: 2])) for c in range(4)]
    return mosaic_map(per_channel(np.array(means)), s.recording.size).astype(np.float64)


def _solved(function, target: float, top: float) -> float:
    """The parameter at which a rising function of it reaches `target`; odd below zero."""
    if target < 0:
        return -_solved(function, -target, top)
    return float(optimize.brentq(lambda a: function(a) - target, 0.0, top)) if target < function(top) else top


def _through(inverse, value: float, stderr: float):
    slope = (inverse(value + stderr) - inverse(value - stderr)) / (2 * max(stderr, 1e-15))
    return normal_estimate(inverse(value), stderr * slope)
