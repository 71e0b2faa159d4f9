"""The frozen patterns of this camera unit, as the frames that looked for effects show them.

A pattern seen through noise is known only in part. The map that is stored is one draw from what is known:
the estimate, shrunk, and the doubt that is left drawn anew, so that the map has the strength of the true one
and agrees with it wherever the frames say so.
"""

from __future__ import annotations

import numpy as np

from cannoise_jax.discovery.battery import Prepared
from cannoise_jax.discovery.fields import Fields
from cannoise_jax.discovery.statistics.hot import known_heat
from cannoise_jax.discovery.statistics.lines import static_sums
from cannoise_jax.discovery.statistics.patterns import ALL_KINDS, pixel_sums
from cannoise_jax.discovery.statistics.score import Score


def line_pattern(
    fields: tuple[Fields, ...], axis: str, scaling: str, variance: float, rng: np.random.Generator
) -> np.ndarray | None:
    """A draw of the pattern of rows `[H]` or columns `[W]`: DN, or fraction of the signal."""
    sums = static_sums(fields, axis, scaling)
    return None if sums is None else _draw(sums.score, sums.information, variance, rng)


def pixel_pattern(
    fields: tuple[Fields, ...], scaling: str, variance: float, rng: np.random.Generator
) -> np.ndarray | None:
    """A draw of the pattern of pixels `[H, W]`: DN, fraction of the signal, or ('thermal') DN per second."""
    sums = pixel_sums(fields, scaling, ALL_KINDS)
    return None if sums is None else _draw(sums.score, sums.information, variance, rng)


def _draw(score, information, variance: float, rng: np.random.Generator) -> np.ndarray:
    doubt = variance / (1 + variance * information)
    return doubt * score + np.sqrt(doubt) * rng.standard_normal(np.shape(score))


def hot_map(fields: tuple[Fields, ...], score: Score, rng: np.random.Generator) -> np.ndarray | None:
    """A draw of the heat of every pixel `[H, W]`, DN (at the longest exposure where 'thermal')."""
    known = known_heat(fields, score.payload)
    if known is None:
        return None
    thermal = score.payload.scaling == "thermal"
    seconds = max(f.exposure_s or 1.0 for f in fields if not f.lit) if thermal else 1.0
    return known.draw(rng) * seconds


def dark_squares(fields: tuple[Fields, ...]) -> tuple[np.ndarray, int]:
    """Temporal sum of squares of every pixel of the darks in units of the noise, and its degrees of
    freedom."""
    chosen = [f for f in fields if not f.lit and len(f.contrasts)]
    total = np.sum([np.einsum("nij,nij->ij", f.contrasts, f.contrasts) for f in chosen], axis=0)
    return np.asarray(total, np.float64), sum(len(f.contrasts) for f in chosen)


def noisy_map(fields: tuple[Fields, ...], share: float) -> np.ndarray:
    """Temporal standard deviation beyond that of the others, DN, at the noisiest `share` of the pixels
    `[H, W]`; 0 elsewhere."""
    squares, freedom = dark_squares(fields)
    sigma = float(np.mean([np.median(f.sigma) for f in fields if not f.lit]))
    limit = np.quantile(squares, 1 - np.clip(share, 0, 1))
    excess = np.maximum(squares / max(freedom, 1) - 1, 0)
    return sigma * np.sqrt(np.where(squares >= limit, excess, 0.0))


def noise_factors(fields: tuple[Fields, ...], spread: float, rng: np.random.Generator) -> np.ndarray:
    """A draw of every pixel's read noise over the mean one `[H, W]`, log-normal of relative spread
    `spread`, given its sum of squares."""
    squares, freedom = dark_squares(fields)
    nodes, weights = np.polynomial.hermite_e.hermegauss(31)
    width = np.sqrt(np.log1p(spread**2))
    logs = width * nodes - width**2  # log of the factor; mean square 1
    chance = np.log(weights)[:, None, None] - freedom * logs[:, None, None]
    chance = chance - 0.5 * squares * np.exp(-2 * logs)[:, None, None]
    chosen = np.argmax(chance + rng.gumbel(size=chance.shape), axis=0)
    return np.exp(logs)[chosen]


def wave_map(fields: tuple[Fields, ...], fy: float, fx: float) -> np.ndarray | None:
    """The frozen plane wave of cycles per pixel (fy, fx) in the darks, of peak 1, with its phase `[H, W]`."""
    dark = [f for f in fields if f.static is not None and not f.lit]
    if not dark:
        return None
    y, x = np.indices(dark[0].mean.shape)
    phase = 2 * np.pi * (fy * y + fx * x)
    total = sum(
        complex(np.sum(f.static * f.weight * np.exp(-1j * phase))) * np.sqrt(f.frames)
        for f in dark
        if f.static is not None
    )
    return np.cos(phase + np.angle(total))


def frozen_map(probe: str, score: Score, prepared: Prepared, fields, rng) -> np.ndarray | None:
    """The measured map of a probe of a frozen pattern, in DN, fractions, or units of its own amplitude."""
    size = fields[0].mean.shape
    variance = score.amplitude**2
    parts = probe.split("_")
    if parts[0] in ("row", "column") and parts[-1] == "static":
        pattern = line_pattern(fields, parts[0], parts[1], variance, rng)
        if pattern is None:
            return None
        return pattern[:, None] if parts[0] == "row" else pattern[None, :]
    if probe == "pixel_thermal_static":
        seconds = max(f.exposure_s or 0.0 for f in fields)
        pattern = pixel_pattern(fields, "thermal", variance / seconds**2, rng)
        return None if pattern is None else pattern * seconds
    if parts[0] == "pixel" and parts[-1] == "static":
        return pixel_pattern(fields, parts[1], variance, rng)
    if probe.startswith("hot_"):
        return hot_map(fields, score, rng)
    if probe == "telegraph":
        return noisy_map(fields, score.parameters["fraction"][0])
    if probe == "pixel_spread":
        factors = noise_factors(fields, score.amplitude, rng)
        sigma = float(np.mean([np.median(f.sigma) for f in fields if not f.lit]))
        return sigma * np.sqrt(np.maximum(factors**2 - np.quantile(factors, 0.05) ** 2, 0))
    if probe == "wave_frozen":
        return wave_map(fields, score.parameters["frequency_y"][0], score.parameters["frequency_x"][0])
    if probe == "glow":
        return np.asarray(score.payload.template, np.float64)
    if probe == "taps":
        return score.payload.image(size) / max(score.amplitude, 1e-12)
    if probe == "step":
        axis, at, step = score.payload
        half = np.where(np.arange(size[0 if axis == "row" else 1]) >= at, 0.5, -0.5) * np.sign(step)
        return half[:, None] if axis == "row" else half[None, :]
    if probe in ("black_channels", "greens"):
        return _channel_map(probe, score, prepared, size)
    return None


def _channel_map(probe: str, score: Score, prepared: Prepared, size: tuple[int, int]) -> np.ndarray | None:
    from cannoise_jax.mechanisms.photons import green_sites
    from cannoise_jax.recordings.recording import mosaic_map

    cell = np.zeros(4)
    if probe == "greens":
        sites = green_sites(prepared.stacks[0].recording.cfa)
        if sites is None:
            return None
        low, high = sorted(sites)
        cell[low], cell[high] = np.sign(score.payload), -np.sign(score.payload)
    else:
        cell = np.asarray(score.payload, np.float64)
    return mosaic_map(cell, size)
