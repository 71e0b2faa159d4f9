"""What neighbouring pixels share: covariances at small lags of frames whose fixed pattern is taken out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float
from scipy import optimize

from cannoise_jax.physics.transfer.estimate import Estimate, Estimates, NotMeasurable, normal_estimate
from cannoise_jax.physics.transfer.estimators.pick import (
    brightest_flat,
    darkest,
    no_flat,
    repeated_darks,
)
from cannoise_jax.physics.transfer.frames import FrameStatistics, steady_frames
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import mosaic_map, per_channel

_LEAST_BESIDE, _LEAST_BLENDED = 8, 16
"""Rows and columns that covariances of neighbours need, and those of pixels four away inside the edges: row
means alone take half of the variance of rows of four."""


def _larger(least: int) -> NotMeasurable:
    return NotMeasurable(f"record frames of at least {least} rows and {least} columns")


def kept(share: float, statistics: Sequence[FrameStatistics] = ()) -> float:
    """Of the variance of white noise, what is left where this share goes to the four about a pixel."""
    return (1 - share) ** 2 + share**2 / 4


def crosstalk(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """fraction of the charge given away, from the covariance of neighbours in flats less that in darks.

    With a share a/4 to each neighbour their covariance is (1-a) a/4 (V_i S_j/S_i + V_j S_i/S_j) / q,
    q = (1-a)^2 + a^2/4, in the shot variances V and signals S as they are measured.
    """
    flat, dark = brightest_flat(statistics), darkest(statistics)
    if flat is None:
        return no_flat(statistics)
    if min(flat.recording.size) < _LEAST_BESIDE:
        return _larger(_LEAST_BESIDE)
    shot = lag_covariances(flat)
    if filtered(flat):
        return _FILTERED
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

    def shared(a: float) -> float:
        return (1 - a) * a / 4 / kept(a)

    def given(r: float) -> float:
        return solved(shared, r, _MOST_GIVEN)

    if abs(rho) > shared(_MOST_GIVEN):
        return _NO_CROSSTALK
    return {"fraction": through(given, float(rho), float(stderr))}


def filtered(s: FrameStatistics, step: int = 1) -> bool:
    """Whether the noise of neighbours, `step` pixels apart, is as much alike along the diagonals as along
    rows and columns: charge goes to the nearest first, but a median, or a clamp to the largest, takes values
    from all about. What pixels further apart share, as under a light that moves, does not count."""
    groups = (
        ((0, step), (step, 0)),
        ((step, step), (step, -step)),
        ((0, _APART * step), (_APART * step, 0)),
    )
    found = lag_covariances(s, tuple(lag for group in groups for lag in group))
    values, errors = np.array([np.transpose([found[lag] for lag in group]) for group in groups]).swapaxes(
        0, 1
    )
    beside, across = (values[n].mean() - values[2].mean() for n in (0, 1))
    rest = np.linalg.norm(errors[[1, 2]] / 2)  # near ones enter by a part of it, and are as sure
    sure = across - _SURE * float(rest) > _AS_DIAGONAL * beside
    return sure and bool(np.all(values[0] - values[2].mean() > _SURE * errors[0]))


_APART = 4
"""Pixels that neither charge nor a filter reaches across."""
_AS_DIAGONAL, _SURE = 0.6, 3.0
"""Of what neighbours beside each other share, what those along the diagonals do from which on no charge went
there: where a pixel keeps 60 % of it and the rest spreads as a Gaussian, it is 0.55. Standard errors by which
it has to be more."""
_FILTERED = NotMeasurable(
    "neighbours in the flats are as much alike along the diagonals as beside each other: frames were "
    "filtered (a median, or loud pixels clamped to those about them), which no charge does: record raw frames"
)
_MOST_GIVEN = 0.6
"""Share of the charge given away, the largest: of a larger one neighbours are no more alike."""
_NO_CROSSTALK = NotMeasurable(
    "neighbours in the flats are more alike than crosstalk makes them: the light moves, or frames are "
    "smoothed: record raw frames of an even, steady light"
)
_BLEND_LAGS = (((0, 2), (2, 0)), ((2, 2), (2, -2)), ((0, 4), (4, 0)))
"""Lags at which a blend with the nearest of the same colour shows: beside, diagonally, and two away."""

_ROUNDED, _ROUNDED_ITSELF = (0.18, 0.11, 0.06), 0.4
"""Codes were rounded before the blend as well, so its own rounding is not quite white. Measured over weights
from 0.1 to 1 and noise of 3 and 6 steps: root mean square error, in twelfths of a squared step, of its
covariances at the lags above and of its variance."""


def in_camera_denoising(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """weight w of the mean of the four nearest pixels of the same colour, from correlations in darks (or in
    flats), less what row means take with them: generalised least squares over three kinds of lags.

    The correlation of neighbours alone, 2 (1-w) w/4 / ((1-w)^2 + w^2/4), is the same for a weight on either
    side of 2/3; those further away grow on.
    """
    s = darkest(statistics) or brightest_flat(statistics)
    if s is None:
        return repeated_darks(statistics)
    if min(s.recording.size) < _LEAST_BLENDED:
        return _larger(_LEAST_BLENDED)
    # At the edge a pixel stands in for its missing neighbours.
    found = lag_covariances(s, ((0, 0), *(lag for group in _BLEND_LAGS for lag in group)), margin=2)
    power = found[0, 0][0] - s.code_step**2 / 12
    seen = np.array([np.mean([found[lag][0] for lag in group]) for group in _BLEND_LAGS]) / power
    height, width = (n // 2 for n in s.recording.size)
    pixels = 4 * (height - 2) * (width - 2) * (s.recording.count - 1)
    rounded = s.code_step**2 / 12 / power

    def precision(w: float) -> Float[np.ndarray, "3 3"]:
        rho = _correlations(w, width)
        doubt = rounded**2 * (_ROUNDED_ITSELF**2 * np.outer(rho, rho) + np.diag(_ROUNDED) ** 2)
        return np.linalg.inv(_correlation_errors(w, pixels) + doubt)

    at, grid = 0.0, np.linspace(-0.5, 1.0, 61)
    for _ in range(4):  # the errors of the correlations depend on the weight
        inverse = precision(at)

        def gap(w: float, inverse=inverse) -> float:
            rest = seen - _correlations(w, width)
            return float(rest @ inverse @ rest)

        best = grid[int(np.argmin([gap(w) for w in grid]))]
        found_at = optimize.minimize_scalar(
            gap, bounds=(best - 0.03, best + 0.03), method="bounded", options={"xatol": 1e-6}
        )
        at = float(found_at.x)
    slope = (_correlations(at + 1e-4, width) - _correlations(at - 1e-4, width)) / 2e-4
    return {"weight": normal_estimate(at, float(1 / np.sqrt(slope @ precision(at) @ slope)))}


def _blend(weight: float) -> Float[np.ndarray, "16 16"]:
    """Covariances of white noise of unit variance that was blended, on a circle of same-colour pixels."""
    kernel = np.zeros((16, 16))
    kernel[0, 0] = 1 - weight
    for at in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        kernel[at] = weight / 4
    return np.fft.ifft2(np.abs(np.fft.fft2(kernel)) ** 2).real


def _correlations(weight: float, width: int) -> Float[np.ndarray, "3"]:
    """Of blended noise at `_BLEND_LAGS`, with the means of rows of `width` pixels taken out."""
    own = _blend(weight)
    own = own - own.sum(axis=1, keepdims=True) / width
    return np.array([np.mean([own[y // 2, x // 2] for y, x in group]) for group in _BLEND_LAGS]) / own[0, 0]


def _correlation_errors(weight: float, pixels: int) -> Float[np.ndarray, "3 3"]:
    """Covariance of the mean correlations at `_BLEND_LAGS` of a field that was blended with this weight: the
    formula of Bartlett, in units of same-colour pixels."""
    own = _blend(weight)
    lags = [(0, 0), *((y // 2, x // 2) for group in _BLEND_LAGS for y, x in group)]
    slopes = np.zeros((3, len(lags)))
    for k, group in enumerate(_BLEND_LAGS):
        members = [n for n, (y, x) in enumerate(lags) if (2 * y, 2 * x) in group]
        slopes[k, members] = 1 / len(members) / own[0, 0]
        slopes[k, 0] = -np.mean([own[lags[n]] for n in members]) / own[0, 0] ** 2
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
    return slopes @ spread @ slopes.T / pixels


_NEAR = ((0, 0), (0, 1), (1, 0), (1, 1), (0, 2), (2, 0))
"""Rows down and columns across: a pixel, its neighbours, and the next of its colour."""


def lag_covariances(
    s: FrameStatistics, lags: Sequence[tuple[int, int]] = _NEAR, margin: int = 0
) -> dict[tuple[int, int], tuple[float, float]]:
    """Temporal covariance of pixels at lags (dy, dx), dy from 0, DN^2, and its error (Bartlett, with the
    variance of products measured on the data). margin: pixels left out along the edges."""
    totals = dict.fromkeys(lags, 0.0)
    squares = dict.fromkeys(lags, 0.0)
    height, width = (n - 2 * margin for n in s.recording.size)
    for rest in residuals(s):
        rest = rest[margin : margin + height, margin : margin + width]
        for dy, dx in lags:
            first, second = max(-dx, 0), max(dx, 0)
            wide = width - abs(dx)
            product = rest[: height - dy, first : first + wide] * rest[dy:, second : second + wide]
            totals[dy, dx] += float(product.sum())
            squares[dy, dx] += float((product**2).sum())
    out = {}
    frames = s.recording.count
    for dy, dx in lags:
        pairs = (height - dy) * (width - abs(dx))
        mean = totals[dy, dx] / pairs / (frames - 1)
        # A residual holds (T - 1)/T of the variance, its square as much of that again.
        spread = max(squares[dy, dx] / pairs * frames / (frames - 1) ** 2 - mean**2, 0.0)
        out[dy, dx] = mean, float(np.sqrt(spread / pairs / (frames - 1)))
    return out


def residuals(s: FrameStatistics) -> Iterator[Float[np.ndarray, "H W"]]:
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
    means = [float(np.mean(s.variance[SITES[c]])) for c in range(4)]
    return mosaic_map(per_channel(np.array(means)), s.recording.size).astype(np.float64)


def solved(function, target: float, top: float) -> float:
    """The parameter at which a rising function of it reaches `target`; odd below zero."""
    if target < 0:
        return -solved(function, -target, top)
    return float(optimize.brentq(lambda a: function(a) - target, 0.0, top)) if target < function(top) else top


def through(inverse, value: float, stderr: float) -> Estimate:
    """The estimate of a parameter that a measured value tells by `inverse`, and its standard error."""
    slope = (inverse(value + stderr) - inverse(value - stderr)) / (2 * max(stderr, 1e-15))
    return normal_estimate(inverse(value), stderr * slope)
