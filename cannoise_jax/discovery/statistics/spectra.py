"""Slopes of the spectrum on the unpacked mosaic: 1/f noise along the scan and from row to row.

Whittle likelihood: under the baseline the power of every Fourier mode is exponential with mean 1.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy import fft, optimize

from cannoise_jax.discovery.fields import Fields
from cannoise_jax.discovery.statistics.lines import line_sums, own_share
from cannoise_jax.discovery.statistics.score import Probe, Score, quadratic_log_p, sidak

EXPONENTS = (0.5, 0.75, 1.0, 1.25, 1.5, 2.0)


def row_spectrum(field: Fields, scaling: str) -> tuple[np.ndarray, float]:
    """Summed power of the row offsets per row frequency [H/2], mean 1 each, and the information per mode."""
    sums = line_sums(field, field.contrasts, "row", scaling)
    scaled = sums.score / np.sqrt(np.maximum(sums.information, 1e-30))
    h = scaled.shape[1]
    power = np.abs(fft.rfft(scaled, axis=1))[:, 1 : (h - 1) // 2 + 1] ** 2 / h
    return power.sum(0), float(np.mean(sums.information))


def raster_spectrum(field: Fields) -> tuple[np.ndarray, float]:
    """Summed power of the raster scans of all contrasts [N/2], mean 1 each, and the information per mode."""
    w = field.weight.astype(np.float32)
    total = float(np.sum(w.astype(np.float64) ** 2))
    power = np.zeros((w.size - 1) // 2)
    for contrast in field.contrasts:
        x = (contrast * w).ravel()
        # By the scan's own power: heavy tails add to all frequencies alike.
        own = max(float(np.sum(x.astype(np.float64) ** 2)), 1e-30)
        power += np.abs(fft.rfft(x - x.mean())[1 : power.size + 1]) ** 2 / own
    return power, total / w.size


def slope_score(fields: tuple[Fields, ...], *, probe: str, scan: str) -> Score | None:
    """1/f^a noise along the raster scan, or from row to row."""
    spectra = [
        (raster_spectrum(f) if scan == "raster" else row_spectrum(f, "additive"))
        for f in fields
        if len(f.contrasts)
    ]
    if not spectra:
        return None
    power = np.array([p for p, _ in spectra])
    dof = np.array([len(f.contrasts) for f in fields if len(f.contrasts)], float)[:, None]
    information = np.array([i for _, i in spectra])[:, None]
    size = fields[0].mean.size if scan == "raster" else fields[0].mean.shape[0]
    frequency = np.arange(1, power.shape[1] + 1) / size
    best: tuple[float, float, float, float, float] | None = None
    log_p = 0.0
    shift = np.inf
    for exponent in EXPONENTS:
        shape = frequency**-exponent
        shape = shape / (2 * shape.sum()) * (power.shape[1] * 2)
        tau1 = information * shape
        log_p = min(
            log_p,
            quadratic_log_p(
                float(2 * (tau1 * power).sum()), np.ravel(tau1), np.repeat(2 * dof, power.shape[1], 1).ravel()
            ),
        )
        sd = np.sqrt(np.sum(dof * tau1**2))
        excess = np.sum(tau1 * (power - dof))
        shift = min(shift, 1 / sd) if exponent == 1.0 or not np.isfinite(shift) else shift
        if excess <= 0:
            continue
        start = np.log(excess / sd**2)
        fit = optimize.minimize_scalar(
            lambda v, t=tau1: -_whittle(np.exp(v) * t, power, dof),
            bounds=(start - 4, start + 4),
            method="bounded",
            options={"xatol": 1e-3},
        )
        v = float(np.exp(fit.x))
        error = 1 / np.sqrt(np.sum(dof * (tau1 / (1 + v * tau1)) ** 2))
        if best is None or -fit.fun > best[0]:
            best = (-float(fit.fun), v, exponent, float(error), 0.0)
    log_p = sidak(log_p, 3)
    gain, v, exponent, error, _ = best if best is not None else (0.0, 0.0, 1.0, 0.0, 0.0)
    sigma = np.sqrt(v)
    err = error / (2 * sigma) if sigma > 0 else np.sqrt(shift)
    penalty = 0.5 * np.log(1e3) + np.log(3)
    return Score(
        probe,
        log_p,
        max(gain, 0),
        float(penalty),
        float(sigma),
        float(err),
        float(np.sqrt(shift)),
        2,
        {"sigma": (float(sigma), "DN", float(err)), "exponent": (exponent, "1", 0.25)},
        {"axis": "frequency", "direction": scan},
        (v, exponent),
    )


def _whittle(tau: np.ndarray, power: np.ndarray, dof: np.ndarray) -> float:
    return float(np.sum(power * tau / (1 + tau) - dof * np.log1p(tau)))


def slope_absorb(fields: tuple[Fields, ...], score: Score, *, scan: str) -> tuple[Fields, ...]:
    """Whitens the low frequencies of every contrast."""
    v, exponent = score.payload
    return tuple(_whiten_slope(f, v, exponent, scan) for f in fields)


def _whiten_slope(field: Fields, v: float, exponent: float, scan: str) -> Fields:
    w = field.weight.astype(np.float32)
    share = own_share(w, v)
    safe = np.where(w > 0, w, 1.0).astype(np.float32)

    def function(x: np.ndarray) -> np.ndarray:
        n = len(x)
        if scan == "raster":
            series, information = (x * w).reshape(n, -1), float(np.mean(w.astype(np.float64) ** 2))
        else:
            information_rows = np.sum(w.astype(np.float64) ** 2, axis=1)
            series = np.einsum("nij,ij->ni", x, w) / np.sqrt(np.maximum(information_rows, 1e-30))
            information = float(information_rows.mean())
        size = series.shape[1]
        frequency = np.maximum(np.arange(size // 2 + 1), 1) / size
        shape = frequency**-exponent
        shape = shape / (2 * shape[1:].sum()) * (2 * (len(shape) - 1))
        keep = np.sqrt(share / (share + v * information * shape))
        keep[0] = 1.0
        spectrum = fft.rfft(series, axis=1)
        removed = fft.irfft(spectrum * (1 - keep), size, axis=1)
        if scan == "raster":
            return x - (removed.reshape(x.shape) / safe) * (w > 0)
        row = removed / np.sqrt(np.maximum(information_rows, 1e-30))
        return x - row[:, :, None].astype(np.float32) * w

    contrasts = function(field.contrasts).astype(np.float32)
    static = None if field.static is None else function(field.static[None])[0].astype(np.float32)
    return field._replace(contrasts=contrasts, static=static)


def probes() -> tuple[Probe, ...]:
    """The probes of this signature."""
    pink = {"enters": "readout", "time": "redrawn", "scales": "additive", "law": "1/f"}
    return (
        Probe(
            "raster_slope",
            "pink_noise",
            {**pink, "varies_over": "raster time"},
            partial(slope_score, probe="raster_slope", scan="raster"),
            partial(slope_absorb, scan="raster"),
            ("stated_read",),
        ),
        Probe(
            "row_slope",
            "row_pink_noise",
            {**pink, "varies_over": "row"},
            partial(slope_score, probe="row_slope", scan="row"),
            partial(slope_absorb, scan="row"),
            ("stated_read",),
        ),
    )
