"""The remainder: what a simulator leaves out, measured and drawn as it was measured (`mechanisms.residual`).

Fixed maps are the recorded means less the simulator's, drawn towards zero by as much as noise of the mean
makes of them (Wiener, frequency by frequency), with as much at random as the recorded power still lacks.
Spectra are those of the recorded contrasts less the simulator's, so that what the simulator already has is
not added twice.
Noise that has too little power at some frequencies cannot be had by adding to it: most of the white read
noise is handed over to the spectrum first.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from cannoise_jax.discovery.compare.parts import Part, parts_of
from cannoise_jax.discovery.compare.patterns import missing, weighted
from cannoise_jax.discovery.compare.pixel_noise import Spread, Variances, variances
from cannoise_jax.discovery.compare.shapes import LIKELY, SURE, smooth
from cannoise_jax.discovery.compare.sources import modelled
from cannoise_jax.mechanisms.residual import KNOTS, LIT, MAPS, RESIDUAL
from cannoise_jax.physics.core.chain import altered_noise
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.core.settings import context_of, resolve
from cannoise_jax.physics.robust import median
from cannoise_jax.recordings.recording import CaptureSet

SHARES = ("keep", *(f"left{k}" for k in range(KNOTS)))
_LOWEST = 0.02
"""Quantile of the spectrum of what is missing that stands for its least: the least of thousands of
frequencies would be the one that scatters most."""
_SPARE = 0.02
"""Of the variance of the noise, that is handed over besides, so that no frequency is left without any."""
_LEAST_LEFT = 0.02
"""Share of the baseline's noise that always stays: a sensor model has no read noise of zero."""


def with_remainder(
    capture: CaptureSet,
    model: SensorModel,
    key: Key[Array, ""],
    tell: Callable[[str], None] = lambda text: None,
) -> SensorModel:
    """The model with the remainder that the frames that look show; unchanged where none shows new noise.

    Maps are those of this camera unit and of frames of this size: other units draw none.
    """
    whole = parts_of(capture, modelled(model, key), tell)
    if not any(p.contrasts for part in whole for p in part):
        return model
    fixed = _fixed(whole[0]) if whole[0] else None
    less = _shares(capture, *whole, fixed, quiet(model, capture.recordings[0].size))
    # What is missing is measured beside what the baseline has left. What stays is measured beside the whole
    # of it: the noise in the mean of a single frame is what the simulator says. So is what single pixels have
    # beyond the others: what is taken from all alike is given back to all alike.
    rest = parts_of(capture, modelled(_added(model, less), key), tell)
    darks, lit = (
        [
            r._replace(pattern=w.pattern, uneven=w.uneven, ratio=w.ratio, loud=w.loud)
            for r, w in zip(own, plain, strict=True)
        ]
        for own, plain in zip(rest, whole, strict=True)
    )
    maps = _measured(capture, darks, lit, fixed)
    return _added(model, {**maps, **{name: less[name] for name in SHARES}})


def _added(model: SensorModel, maps: dict[str, np.ndarray]) -> SensorModel:
    full = {name: jnp.asarray(values, jnp.float32) for name, values in maps.items()}
    return model.with_mechanism(RESIDUAL, maps=full, again=True)


def quiet(model: SensorModel, size: tuple[int, int]) -> float:
    """Variance of the read noise of the quietest pixels over the baseline's, where lines or pixels have a
    noise of their own."""
    context = context_of(model, jnp.zeros((1, *size)), Settings(iso=float(np.asarray(model.iso)[0])))
    noise = altered_noise(model, context, resolve(model, context))
    own = noise.gain_dn_per_e * noise.read_noise_e / (context.gain_dn_per_e * context.read_noise_e)
    return float(np.quantile(np.asarray(own) ** 2, _LOWEST))


def _shares(
    capture: CaptureSet, darks: list[Part], lit: list[Part], fixed: _Fixed | None, least: float
) -> dict[str, np.ndarray]:
    """Maps of `mechanisms.residual` that take away as much of the baseline's noise as the frames that look
    have too little of at any spatial frequency, and nothing else. fixed: of the darks; least: `quiet`.
    """
    maps = _empty(capture)
    if fixed is not None:
        zero = np.zeros(darks[0].signal.shape)
        maps.update(dict.fromkeys(("offset", "rate", "spread", "growth", "spectrum"), zero))
        maps["keep"] = np.full((1, 1), _left(_still(darks, fixed.rate)[1], True, least))
    for k, p in enumerate(lit):
        zero = np.zeros(p.signal.shape)
        left = np.full((1, 1), _left([p], False))
        maps.update(
            {f"{n}{k}": v for n, v in zip(LIT, (p.signal, zero, zero, zero, p.unit, left), strict=True)}
        )
    return maps


def _left(parts: list[Part], dark: bool, least: float = 1.0) -> float:
    """Share of the variance of the baseline's noise (of darks its read noise) that may stay: quiet pixels
    have less than the others. least: what the quietest have of it, and may lose."""
    weight = [p.contrasts for p in parts]
    own = float(np.average([p.read if dark else p.own for p in parts], weights=weight))
    missing = (_SPARE + 1 - _pixels(parts).lowest) * _level(parts)
    missing -= float(np.quantile(_spectrum(parts, False), _LOWEST))
    most = (1 - _LEAST_LEFT) * min(least, 1.0)
    return float(np.clip(1 - missing / max(own, 1e-12), 1 - most, 1.0))


def _level(parts: list[Part]) -> float:
    """Variance of the bulk, DN^2, of all recordings together."""
    return float(np.average([p.level for p in parts], weights=[p.contrasts for p in parts]))


def _measured(
    capture: CaptureSet, darks: list[Part], lit: list[Part], fixed: _Fixed | None
) -> dict[str, np.ndarray]:
    """All other maps of `mechanisms.residual`, of the frames that look beside draws of what the baseline has
    left."""
    maps = _empty(capture)
    if fixed is not None:
        maps.update(_of_darks(darks, fixed))
    for k, p in enumerate(lit):
        maps.update(zip([f"{n}{k}" for n in LIT], _of_lit(p), strict=False))
    return maps


def _empty(capture: CaptureSet) -> dict[str, np.ndarray]:
    maps = {name: np.full((1, 1), float(name.startswith(("keep", "left")))) for name in MAPS}
    maps["pixels"] = np.full((1, 1), float(np.prod(capture.recordings[0].size)))
    return maps


def _of_darks(darks: list[Part], fixed: _Fixed) -> dict[str, np.ndarray]:
    """What stays, noise of single pixels and the shared spectrum."""
    offset, rate = fixed
    growing, still = _still(darks, rate)
    own, growth, shared = _alone(still)
    spectrum = np.maximum(_spectrum(still, True) - shared, 0)
    return {"offset": offset, "rate": rate, "spread": own, "growth": growth + growing, "spectrum": spectrum}


class _Fixed(NamedTuple):
    """What stays, DN, and what grows with the exposure, DN/s."""

    offset: np.ndarray
    rate: np.ndarray


def _fixed(darks: list[Part]) -> _Fixed:
    """Both by least squares over the exposures."""
    known = [p for p in darks if p.pattern is not None]
    patterns = [p.pattern for p in known if p.pattern is not None]
    weight = np.array([1 / p.noise for p in patterns])
    times = np.array([p.exposure_s for p in known])
    centre = float(np.average(times, weights=weight))
    spread = float(np.sum(weight * (times - centre) ** 2))
    mean, rate = weight / weight.sum(), np.zeros(patterns[0].recorded.values.shape)
    if len(set(times)) > 1 and spread > 0:
        slope = weight * (times - centre) / spread
        mean = mean - centre * slope
        rate = missing(weighted(patterns, slope), 1)
    offset = missing(weighted(patterns, mean), 2)
    return _Fixed(offset, rate)


def _still(darks: list[Part], rate: np.ndarray) -> tuple[np.ndarray, list[Part]]:
    """Variance of every pixel that grows by the second (DN^2/s), and the darks without it.

    The charge brings shot noise of its own, and the bulk may become noisier beyond that.
    A clamp may let the level fall while charge is collected.
    """
    moving = [p for p in darks if p.contrasts]
    shot = darks[0].gain * np.maximum(rate - min(float(median(rate)), 0.0), 0.0)
    # Where the simulator has a pattern of its own, half of what it is off by is too much: the bulk as a whole
    # gains no more than its noise shows.
    slope, bulk = _slope(moving), _bulk(shot)
    common = np.minimum(shot, np.quantile(shot, 0.975))
    growing = max(slope - bulk, 0.0) + shot - (1 - min(max(slope, 0.0) / max(bulk, 1e-30), 1.0)) * common
    return growing, [_less(p, growing) for p in moving]


def _bulk(values: np.ndarray) -> float:
    """Mean without the pixels that stand out."""
    return float(values[values <= np.quantile(values, 0.975)].mean())


def _slope(darks: list[Part]) -> float:
    """By how much the variance of the bulk grows in a second beyond the simulator's, DN^2."""
    times = np.array([p.exposure_s for p in darks])
    levels = np.array([p.level for p in darks])
    weight = np.array([p.contrasts for p in darks]) / levels**2
    centre = float(np.average(times, weights=weight))
    spread = float(np.sum(weight * (times - centre) ** 2))
    if not spread > 0:
        return 0.0
    beyond = levels - np.array([p.own for p in darks])
    slope = float(np.sum(weight * (times - centre) * beyond)) / spread
    error = float(np.sqrt(2 / (darks[0].excess.size * spread)))
    return slope if slope > SURE * error else 0.0


def _less(p: Part, growing: np.ndarray) -> Part:
    """A dark without the noise that grows with the exposure; its pixels beside what each is expected to
    have."""
    grown = growing * p.exposure_s
    level = max(p.level - _bulk(grown), 0.1 * p.level)
    unit = p.loud + grown / level
    ratio = p.ratio * p.level * p.loud / (level * unit)
    return p._replace(excess=p.excess - _bulk(grown), ratio=ratio, level=level, unit=unit)


def _pixels(parts: list[Part]) -> Variances:
    """Variance of every pixel over the bulk's, of all recordings together."""
    number = [p.contrasts for p in parts]
    ratio = np.average(np.stack([p.ratio for p in parts]), axis=0, weights=number)
    value, drawn = np.average(np.array([p.uneven for p in parts]), axis=0, weights=number)
    return variances(ratio, sum(number), Spread(float(value), float(drawn)), 4)


def _alone(darks: list[Part]) -> tuple[np.ndarray, np.ndarray, float]:
    """Variance (DN^2) that single pixels have beyond the quietest, by how much it grows in a second (of
    pixels that stand out in all darks together), and its mean over the others, which all noise has already.
    """
    pixels, level = _pixels(darks), _level(darks)
    times = np.array([p.exposure_s for p in darks])[:, None, None]
    beyond = np.stack([p.level * p.unit * (p.ratio - 1) for p in darks])
    weight = np.stack([p.contrasts / (p.level * p.unit) ** 2 for p in darks])
    centre = np.sum(weight * times, 0) / weight.sum(0)
    spread = np.sum(weight * (times - centre) ** 2, 0)
    growth = np.sum(weight * (times - centre) * beyond, 0) / np.maximum(spread, 1e-30)
    growth = np.maximum(growth, 0.0) * (spread > 0)
    own = np.sum(weight * (beyond - times * growth), 0) / weight.sum(0)
    own = np.where(pixels.odd, np.maximum(own, 0) + level * (1 - pixels.lowest), level * pixels.beyond)
    return own, np.where(pixels.odd, growth, 0.0), level * pixels.shared


def _of_lit(p: Part) -> tuple[np.ndarray, ...]:
    """The maps of `LIT` of one lit recording."""
    fixed = np.zeros(p.signal.shape) if p.pattern is None else missing(p.pattern, 3)
    pixels = _pixels([p])
    loud = p.loud * np.maximum(p.ratio - 1, 0) + 1 - pixels.lowest
    power = np.maximum(_spectrum([p], False) - p.level * pixels.shared, 0)
    return p.signal, fixed, p.level * np.where(pixels.odd, loud, pixels.beyond), power, p.unit


def _spectrum(parts: list[Part], frames_too: bool) -> np.ndarray:
    """Power that the recorded noise has beyond the simulated, DN^2 (below zero: less).

    Broad shapes are smoothed, and single frequencies are kept where they stand out.
    frames_too: with what whole frames share; of lit ones it is the lamp's.
    """
    n = sum(p.contrasts for p in parts)
    weight = np.array([p.contrasts / p.level**2 for p in parts])
    excess = np.tensordot(weight / weight.sum(), np.stack([p.excess for p in parts]), 1)
    level = float(np.average([p.level for p in parts], weights=weight))
    out = smooth(excess, n, level, LIKELY)
    if not frames_too:
        out[0, 0] = out[0, 1]
    return out
