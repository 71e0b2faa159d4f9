"""The remainder: what a simulator leaves out, measured and drawn as it was measured (`mechanisms.residual`).

Fixed maps are the recorded means less the simulator's, drawn towards zero by as much as noise of the mean
makes of them (Wiener); the spectrum is that of the recorded contrasts less the simulator's where it stands
out of its own scatter, so that what the simulator already has is not added twice.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key
from scipy import fft, ndimage, stats

from cannoise_jax.discovery.battery import split_recordings
from cannoise_jax.discovery.calibrate import gain_groups
from cannoise_jax.discovery.compare.light import light_for
from cannoise_jax.discovery.compare.run import asked_signal
from cannoise_jax.discovery.compare.sources import modelled
from cannoise_jax.discovery.compare.view import FAR, Raw, noise_of, reduce, trimmed
from cannoise_jax.discovery.stacks import code_step, iso_numbers
from cannoise_jax.mechanisms.residual import RESIDUAL
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.recordings.recording import CaptureSet, Recording

_SURE = 3.0


class _Part(NamedTuple):
    """One recording beside the simulator's draws: fixed residual (DN), its variance by noise, exposure,
    signal (DN), power beyond the simulator's and variance of every pixel (DN^2), that of the bulk, and the
    number of contrasts."""

    dark: bool
    residual: Float[np.ndarray, "h w"]
    noise: float
    exposure_s: float
    signal: Float[np.ndarray, "h w"]
    excess: Float[np.ndarray, "h w"]
    variance: Float[np.ndarray, "h w"]
    level: float
    contrasts: int


def with_remainder(
    capture: CaptureSet,
    model: SensorModel,
    key: Key[Array, ""],
    tell: Callable[[str], None] = lambda text: None,
) -> SensorModel:
    """The model with the remainder that the frames that look show; unchanged without darks.

    Maps are those of this camera unit and of frames of this size: other units and crops draw none.
    """
    step, isos = code_step(capture), iso_numbers(gain_groups(capture))
    parts = []
    for n, (r, (look, _)) in enumerate(zip(capture.recordings, split_recordings(capture), strict=True)):
        if not look or r.kind == "scene":
            continue
        tell(f"remainder: recording {n + 1} of {len(capture.recordings)}")
        parts.append(_part(r, n, look, model, key, step, isos[r.iso]))
    darks = [p for p in parts if p.dark]
    if not darks:
        return model
    maps = _fixed(parts)
    maps["spread"] = _spread(darks)
    maps["spectrum"] = _spectrum(darks)
    return model.with_mechanism(RESIDUAL, maps={k: jnp.asarray(v, jnp.float32) for k, v in maps.items()})


def _part(
    r: Recording,
    number: int,
    look: list[int],
    model: SensorModel,
    key: Key[Array, ""],
    step: float,
    iso: float,
) -> _Part:
    """One recording reduced beside twice as many drawn frames."""
    dark = r.kind in ("dark", "bias")
    high = min(float(r.white_level), 65535.0)
    raw = reduce(np.stack([np.asarray(r.frames[t : t + 1])[0] for t in look]), high, dark, step)
    light = light_for(r, raw.mean, raw.usable, dark)
    assert light is not None
    fitted = light.fit(raw.mean, raw.usable)
    source = modelled(model, key)
    clean = asked_signal(r, fitted, source, dark)
    exposure = r.exposure_s if r.exposure_s is not None else 0.01
    settings = Settings(iso, exposure, r.temperature_c, max(2 * raw.frames, 4))
    frames = source.frames(0, number, clean, settings)
    assert frames is not None
    drawn = reduce(frames, high, dark, step)
    expected = light.fit(drawn.mean, drawn.usable)
    noise = noise_of([drawn], expected, step)
    typical = float(np.mean([np.mean(v) for v in noise.variance]))
    n = len(raw.contrasts)
    own = np.mean(raw.contrasts**2, 0) if n else np.full(raw.mean.shape, typical)
    bulk = trimmed(own.ravel(), n) if n else typical
    # Of darks the level is the simulator's to tell; of flats the light took it.
    residual = raw.mean - (expected if dark else fitted)
    excess = _power(raw, bulk) - _power(drawn, typical) if n else np.zeros(raw.mean.shape)
    return _Part(
        dark, residual, bulk / raw.frames, exposure, np.maximum(fitted - np.mean(r.black_level), 0), excess,
        own, bulk, n,
    )  # fmt: skip


def _power(raw: Raw, bulk: float) -> Float[np.ndarray, "h w"]:
    """Mean periodogram of the contrasts, DN^2, outlying pixels at zero."""
    own = np.mean(raw.contrasts**2, 0)
    n = len(raw.contrasts)
    kept = own <= bulk * stats.chi2.isf(FAR, n) / n
    total = np.zeros(raw.mean.shape)
    for c in raw.contrasts:
        total += np.abs(fft.fft2(c * kept)) ** 2
    return total / (n * raw.mean.size * max(float(kept.mean()), 1e-6))


def _fixed(parts: list[_Part]) -> dict[str, np.ndarray]:
    """Offset, rate and response by least squares over the recordings, pixel by pixel, each shrunk."""
    darks = [p for p in parts if p.dark]
    weight = np.array([1 / p.noise for p in darks])
    times = np.array([p.exposure_s for p in darks])
    values = np.stack([p.residual for p in darks])
    zero = np.zeros(values.shape[1:])
    centre = float(np.average(times, weights=weight))
    spread = float(np.sum(weight * (times - centre) ** 2))
    rate = zero
    if len(set(times)) > 1 and spread > 0:
        rate = np.tensordot(weight * (times - centre), values, 1) / spread
        rate = _wiener(rate, 1 / spread, 1)
    offset = np.tensordot(weight, values - times[:, None, None] * rate, 1) / weight.sum()
    offset = _wiener(offset, 1 / float(weight.sum()), 2)
    lit = [p for p in parts if not p.dark and p.signal.mean() > 0]
    response = zero
    if lit:
        information = np.sum([p.signal**2 / p.noise for p in lit], 0)
        response = np.sum([p.signal / p.noise * (p.residual - offset) for p in lit], 0) / information
        response = _wiener(response, float(np.mean(1 / information)), 3)
    return {"offset": offset, "rate": rate, "response": response}


def _wiener(values: np.ndarray, noise: float, seed: int) -> np.ndarray:
    """A map drawn towards its median by the share of its spread that is noise, and what the frames leave open
    drawn at random, so that it has the pattern's own spread; what stands out is kept."""
    centre = float(np.median(values))
    away = values - centre
    scale = 1.4826 * float(np.median(np.abs(away)))
    share = max(1 - noise / max(scale**2, 1e-30), 0.0)
    out = np.abs(away) > 5 * max(scale, np.sqrt(noise))
    open_part = np.sqrt(share * (1 - share)) * scale * np.random.default_rng(seed).standard_normal(away.shape)
    return centre + np.where(out, away, share * away + open_part)


def _spread(darks: list[_Part]) -> np.ndarray:
    """Noise (DN rms) that single pixels have beyond the bulk, from all darks; 0 for those like the others."""
    dof = sum(p.contrasts for p in darks)
    if not dof:
        return np.zeros(darks[0].variance.shape)
    ratio = np.sum([p.contrasts * p.variance / p.level for p in darks], 0) / dof
    level = float(np.average([p.level for p in darks], weights=[p.contrasts for p in darks]))
    odd = ratio > stats.chi2.isf(1e-4, dof) / dof
    return np.where(odd, np.sqrt(np.maximum(ratio - 1, 0) * level), 0.0)


def _spectrum(darks: list[_Part]) -> np.ndarray:
    """Power that the recorded noise has beyond the simulated, DN^2: broad shapes smoothed, and single
    frequencies where they stand out."""
    n = sum(p.contrasts for p in darks)
    if not n:
        return np.zeros(darks[0].excess.shape)
    excess = np.sum([p.contrasts * p.excess for p in darks], 0) / n
    level = float(np.average([p.level for p in darks], weights=[p.contrasts for p in darks]))
    error = level * np.sqrt(1.5 / n)
    limit = stats.norm.isf(0.05 / excess.size) * error
    plane = excess.copy()
    plane[0], plane[:, 0] = 0, 0
    out = _smoothed(plane, 9, error / 9)
    out[0] = _smoothed(_steady(excess[0]), 5, error / np.sqrt(5))
    for column in (0, excess.shape[1] // 2):
        # Rows, and rows of odd against even columns, lie on lines of their own.
        smooth = _smoothed(_steady(excess[:, column]), 5, error / np.sqrt(5))
        out[:, column] = smooth if column == 0 else np.maximum(out[:, column], smooth)
    single = excess > np.maximum(limit, out + limit)
    return np.where(single, excess, out)


def _steady(line: np.ndarray) -> np.ndarray:
    """A line of the spectrum without single frequencies, which a mean would smear."""
    local = ndimage.median_filter(line, 9, mode="wrap")
    spread = 1.4826 * np.median(np.abs(line - local))
    return np.where(np.abs(line - local) > 5 * spread, local, line)


def _smoothed(values: np.ndarray, width: int, error: float) -> np.ndarray:
    smooth = ndimage.uniform_filter(values, width, mode="wrap")
    return np.where(smooth > _SURE * error, smooth, 0.0)
