"""Slopes of the spectrum on the unpacked mosaic: 1/f noise along the scan and from row to row.

Whittle likelihood: under the baseline the power of every Fourier mode is exponential with mean 1.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal

import numpy as np
from scipy import fft, optimize

from cannoise_jax.physics.core.fields import within_frame
from cannoise_jax.physics.core.grammar import Point, amplitude_name
from cannoise_jax.physics.likelihood.whittle import white_level, whittle
from cannoise_jax.signatures.added import placed, strength
from cannoise_jax.signatures.answers import less_shared
from cannoise_jax.signatures.fields import Fields, map_contrasts
from cannoise_jax.signatures.group_sums import held_variance
from cannoise_jax.signatures.handed import Addition, Found, Many, Predicted, Series
from cannoise_jax.signatures.least import (
    Law,
    Seen,
    pink,
)
from cannoise_jax.signatures.line_sums import alone, line_pixels, line_sums
from cannoise_jax.signatures.modes import (
    banded,
    even_rows,
    mode_weights,
    raster_modes,
    row_modes,
    slope_shape,
)
from cannoise_jax.signatures.score import Score, quadratic_log_p, sidak
from cannoise_jax.signatures.signature import BY_SHIFT, CONTRASTS, NO_LAW, NO_PATTERN, Axes, Signature

EXPONENTS = (0.5, 0.75, 1.0, 1.25, 1.5, 2.0)
"""Those that are tried."""
_EXPONENT_SPREAD = 0.15
"""Standard deviation of the exponents of 1/f noise about 1: those of transistors lie between 0.7 and 1.3.
Weak noise leaves the exponent open, and with it how much of the variance lies where nothing is seen."""


def slope_score(fields: tuple[Fields, ...], *, scan: str) -> Score[tuple[float, float]] | None:
    """1/f^a noise along the raster scan, or from row to row."""
    seen = [f for f in fields if len(f.contrasts) and f.usable.any()]
    if not seen:
        return None
    spectra = [raster_modes(f) if scan == "raster" else row_modes(f, "additive") for f in seen]
    size = fields[0].mean.size if scan == "raster" else fields[0].mean.shape[0]
    weights = mode_weights(size)
    power = np.array([p for p, _ in spectra]) * weights
    dof = np.array([len(f.contrasts) for f in seen], float)[:, None] * weights
    information = np.array([i for _, i in spectra])[:, None]
    modes = banded(dof)
    mean_power, level = banded(power) / modes, _level(scan)
    fits: list[tuple[float, float, float, float]] = []
    log_p = 0.0
    shift = np.inf
    for exponent in EXPONENTS:
        tau1 = information * slope_shape(size, exponent)
        tau = banded(tau1 * weights) / banded(weights)
        log_p = min(
            log_p,
            quadratic_log_p(float(2 * (tau1 * power).sum()), np.ravel(tau1), np.ravel(2 * dof)),
        )
        sd = np.sqrt(np.sum(dof * tau1**2))
        excess = np.sum(tau1 * (power - dof))
        shift = min(shift, 1 / sd) if exponent == 1.0 or not np.isfinite(shift) else shift
        if excess <= 0:
            continue
        start = np.log(excess / sd**2)
        fit = optimize.minimize_scalar(
            lambda v, t=tau: -_gain(np.exp(v) * t, mean_power, modes, level),
            bounds=(start - 4, start + 4),
            method="bounded",
            options={"xatol": 1e-3},
        )
        v = float(np.exp(fit.x))
        error = _error(level(mean_power, modes, v * tau), v, tau, modes, fitted=scan == "raster")
        fits.append((-float(fit.fun), v, exponent, error))
    log_p = sidak(log_p, 3)
    gain, v, exponent, error = max(fits, key=_with_prior, default=(0.0, 0.0, 1.0, 0.0))
    sigma = np.sqrt(v)
    err = np.hypot(error / (2 * sigma), _left_open(fits, sigma)) if sigma > 0 else np.sqrt(shift)
    penalty = 0.5 * np.log(1e3) + np.log(3)
    return Score(
        log_p=log_p,
        gain=max(gain, 0),
        penalty=float(penalty),
        amplitude=float(sigma),
        error=float(err),
        shift=float(np.sqrt(shift)),
        power=2,
        parameters={"sigma": (float(sigma), "DN", float(err)), "exponent": (exponent, "1", 0.25)},
        where={"axis": "frequency", "direction": scan},
        payload=(v, exponent),
    )


def below_frame(score: Score[tuple[float, float]], size: tuple[int, int]) -> float:
    """Standard deviation, DN, that 1/f noise as found gives the means of frames of this size at most, if it
    goes on through a few tens of them: in n frames its power rises to 2 ln(n / 2) times that of the first
    mode, here n of about 25."""
    v, exponent = score.payload
    number = size[0] * size[1] if score.where["direction"] == "raster" else size[0]
    return float(np.sqrt(5 * v * slope_shape(number, exponent)[0] / number))


def _with_prior(fit: tuple[float, float, float, float]) -> float:
    gain, _, exponent, _ = fit
    return gain - 0.5 * ((exponent - 1) / _EXPONENT_SPREAD) ** 2


def _left_open(fits: list[tuple[float, float, float, float]], sigma: float) -> float:
    """Standard deviation of the strength about `sigma` over the exponents that the data leave open."""
    weight = np.exp([_with_prior(f) - max(map(_with_prior, fits)) for f in fits])
    strengths = np.sqrt([v for _, v, _, _ in fits])
    return float(np.sqrt(np.average((strengths - sigma) ** 2, weights=weight)))


def _error(own: np.ndarray, v: float, tau: np.ndarray, modes: np.ndarray, *, fitted: bool) -> float:
    """Standard error of the variance v of a slope tau beside white levels `own`, which the same modes tell
    where they are `fitted` (the inverse of the Fisher information)."""
    weight = modes / (own + v * tau) ** 2
    information = np.sum(weight * tau**2, axis=-1)
    if fitted:
        information = information - np.sum(weight * tau, axis=-1) ** 2 / np.sum(weight, axis=-1)
    return float(1 / np.sqrt(np.sum(information)))


def _level(scan: str):
    """White level beside a slope: of rows the scores know it, of scans it is fitted."""
    return white_level if scan == "raster" else lambda power, dof, tau: 1.0


def _gain(tau: np.ndarray, power: np.ndarray, modes: np.ndarray, level) -> float:
    """Log-likelihood of mean powers with a slope against that of a white level alone, nats."""
    none, beside = (level(power, modes, t) + t for t in (0 * tau, tau))
    return float(np.sum(whittle(power, 2 * modes, beside) - whittle(power, 2 * modes, none)))


def slope_absorb(
    fields: tuple[Fields, ...], score: Score[tuple[float, float]], *, scan: str
) -> tuple[Fields, ...]:
    """Whitens the low frequencies of every contrast."""
    v, exponent = score.payload
    return tuple(_whiten_slope(f, v, exponent, scan) for f in fields)


def _whiten_slope(field: Fields, v: float, exponent: float, scan: str) -> Fields:
    if len(field.contrasts):
        held = _held_by_scan(field, v, exponent) if scan == "raster" else _held_by_rows(field)
        field = alone(field, held, v, "additive")
    w = field.weight.astype(np.float32)
    even = even_rows(w)
    safe = np.where(w > 0, even, 1)
    information_rows = np.sum(w.astype(np.float64) ** 2, axis=1)
    root = np.sqrt(np.maximum(information_rows, 1e-30))

    def function(x: np.ndarray) -> np.ndarray:
        n = len(x)
        if scan == "raster":
            series, information = (x * even).reshape(n, -1), float(np.mean(w.astype(np.float64) ** 2))
        else:
            series, information = np.einsum("nij,ij->ni", x, w) / root, float(information_rows.mean())
        size = series.shape[1]
        keep = np.concatenate([[1.0], 1 / np.sqrt(1 + v * information * slope_shape(size, exponent))])
        spectrum = fft.rfft(series, axis=1)
        removed = fft.irfft(spectrum * (1 - keep), size, axis=1)
        if scan == "raster":
            return (x - (removed.reshape(x.shape) / safe) * (w > 0)).astype(np.float32)
        return x - (removed / root)[:, :, None].astype(np.float32) * w

    out = map_contrasts(field, function)
    if scan == "raster":
        return out
    mean = 1 / (1 + v * float(information_rows.mean()) * slope_shape(len(root), exponent))
    left = np.float32(np.sqrt(np.average(mean, weights=mode_weights(len(root)))))
    return less_shared(out, "row", np.full(len(root), left))


def _held_by_rows(field: Fields) -> np.ndarray:
    return held_variance(line_pixels(field.contrasts, field.weight.astype(np.float32), "row"))[:, None]


def _held_by_scan(field: Fields, v: float, exponent: float) -> np.ndarray:
    """Variance, DN^2, that the modelled noise holds beyond the white level of the scan."""
    power, information = raster_modes(field)
    weights, number = mode_weights(field.weight.size), len(field.contrasts)
    modes = banded(weights)
    tau = v * information * banded(slope_shape(field.weight.size, exponent) * weights) / modes
    mean_power = banded(power * weights) / modes / number
    level = float(white_level(mean_power[None], number * modes[None], tau[None])[0, 0])
    even, w = even_rows(field.weight), field.weight.astype(np.float64)
    seen = float(np.sum((field.contrasts * even) ** 2, dtype=np.float64)) / number
    full = even.astype(np.float64) ** 2
    return np.array((full.sum() - level * seen) / max(float(np.sum(full * w**2)), 1e-30))


def slope(
    scan: Literal["raster", "row"],
    *,
    name: str,
    parameter: str,
    covers: tuple[str, ...],
) -> Signature:
    """1/f noise along the raster scan, or from row to row."""
    rows, point = scan == "row", Point("readout", "signal", scan, "redrawn", spectrum="power_law")

    def predict(fields: Many, score: Score) -> Predicted:
        return Predicted("additive", row=score.amplitude, exponent=float(score.parameters["exponent"][0]))

    def beside(found: Found) -> dict[str, float]:
        return {"exponent": found.score.parameters["exponent"][0]}

    def whole(add: Callable[[Found], Addition], name_of_all: str) -> Callable[[Found], Addition]:
        """The strength within a frame, as it is found, of which a draw has a share in the means of frames."""

        def simulate(found: Found) -> Addition:
            more = add(found)
            kept = within_frame(found.score.parameters["exponent"][0], scan, found.size)
            return more._replace(values={**more.values, name_of_all: more.values[name_of_all] / kept})

        return simulate

    def series(field: Fields, score: Score[tuple[float, float]]) -> Series | None:
        if not len(field.contrasts):
            return None
        exponent = score.payload[1]
        if rows:
            return Series(*line_sums(field, field.contrasts, "row", "additive"), exponent, level=True)
        weight = field.weight.astype(np.float32).ravel()
        values = field.contrasts.reshape(len(field.contrasts), -1) * weight
        return Series(values, weight.astype(np.float64) ** 2, exponent, level=False)

    def least(sets: tuple[Seen, ...]) -> Law:
        return pink(sets, (lambda s: s.weight.sum(1)) if rows else (lambda s: s.weight.ravel()))

    return Signature(
        name=name,
        axes=Axes("readout", "row" if rows else "raster", "redrawn", "additive", "1/f"),
        reads=CONTRASTS,
        score=partial(slope_score, scan=scan),
        absorb=partial(slope_absorb, scan=scan),
        covers=covers,
        predict=predict if rows else NO_LAW,
        pattern=NO_PATTERN,
        simulate=whole(strength(parameter, beside=beside), parameter),
        place=whole(placed(point, beside=beside), amplitude_name(point)),
        detectable=BY_SHIFT,
        least=least,
        moves_frames=below_frame,
        series=series,
    )
