"""Injected effects that act on light and charge, each the catalogue's equation."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from cannoise_jax.blind.chain import Context, Effect, tile
from cannoise_jax.recordings.recording import DARK


def _multiply(mechanism: str, amplitude: float, field) -> Effect:
    """values * (1 + amplitude * field(context)); `field` has unit rms: the amplitude is an rms fraction."""
    return Effect(mechanism, amplitude, "photons", lambda x, c: x * (1 + amplitude * field(c)))


def _unit(values: np.ndarray) -> np.ndarray:
    """Zero mean, unit rms."""
    return (values - values.mean()) / values.std()


def prnu(amplitude: float) -> Effect:
    """Photo-response non-uniformity: mu (1 + p_ij), p frozen, amplitude sd p."""
    return _multiply("prnu", amplitude, lambda c: c.frozen("prnu").standard_normal(c.size))


def column_gain(amplitude: float) -> Effect:
    """Gain of each column's converter: mu (1 + g_j), g frozen, amplitude sd g."""
    return _multiply("column_gain", amplitude, lambda c: c.frozen("column_gain").standard_normal(c.size[1]))


def green_imbalance(amplitude: float) -> Effect:
    """Gr brighter, Gb darker by `amplitude`; in an RGGB-like mosaic the greens lie on one diagonal."""

    def field(c: Context) -> np.ndarray:
        greens = ((0, 1), (1, 0)) if c.camera.cfa in ("RGGB", "BGGR") else ((0, 0), (1, 1))
        cell = np.zeros((2, 2))
        cell[greens[0]], cell[greens[1]] = 1, -1
        return tile(cell, c.size)

    return _multiply("green_imbalance", amplitude, field)


def lens_shading(amplitude: float) -> Effect:
    """Falloff with the squared distance from the centre: mu (1 - v r^2), r = 1 in the corners."""

    def field(c: Context) -> np.ndarray:
        height, width = c.size
        y, x = np.mgrid[:height, :width]
        y, x = 2 * y / (height - 1) - 1, 2 * x / (width - 1) - 1
        return -(y**2 + x**2) / 2

    return _multiply("lens_shading", amplitude, field)


def nonlinearity(amplitude: float) -> Effect:
    """Compressive response mu (1 - a mu / full), full at the white level."""

    def apply(x: np.ndarray, c: Context) -> np.ndarray:
        full = c.camera.electrons(np.ones(1))
        return x * (1 - amplitude * x / full)

    return Effect("nonlinearity", amplitude, "photons", apply)


def flicker(amplitude: float) -> Effect:
    """Mains flicker through a rolling shutter: mu (1 + m cos(2 pi i/period + phase)), phase redrawn."""

    def field(c: Context) -> np.ndarray:
        if c.shot.kind in DARK:
            return np.zeros((1, 1, 1))
        period = c.frozen("flicker").uniform(0.15, 0.45) * c.size[0]
        phase = c.rng.uniform(0, 2 * np.pi, (c.shot.frames, 1, 1))
        return np.cos(2 * np.pi * np.arange(c.size[0])[:, None] / period + phase)

    return _multiply("flicker", amplitude, field)


def illumination_drift(amplitude: float) -> Effect:
    """The lamp warms up: a linear ramp over the frames of a recording, amplitude rms fraction."""

    def field(c: Context) -> np.ndarray:
        if c.shot.frames < 2:
            return np.zeros((1, 1, 1))
        return _unit(np.arange(c.shot.frames, dtype=float))[:, None, None]

    return _multiply("illumination_drift", amplitude, field)


def dark_current(amplitude: float) -> Effect:
    """Thermal electrons at `amplitude` e-/s, the same in every pixel, with their shot noise."""
    return Effect("dark_current", amplitude, "pixel", lambda x, c: x + amplitude * c.shot.exposure_s)


def amp_glow(amplitude: float) -> Effect:
    """Glow from one frozen corner that grows with exposure; amplitude rms DN at the longest exposure."""

    def apply(x: np.ndarray, c: Context) -> np.ndarray:
        height, width = c.size
        rng = c.frozen("amp_glow")
        y0, x0 = rng.integers(0, 2) * height, rng.integers(0, 2) * width
        reach = rng.uniform(0.12, 0.3) * max(height, width)
        y, z = np.mgrid[:height, :width]
        glow = np.exp(-np.hypot(y - y0, z - x0) / reach)
        glow *= amplitude / c.camera.gain / np.sqrt(np.mean(glow**2))
        return x + glow * c.exposure

    return Effect("amp_glow", amplitude, "pixel", apply)


def hot_pixels(amplitude: float, fraction: float = 5e-4) -> Effect:
    """Few frozen leaky pixels, exponential in strength; amplitude rms DN at the longest exposure."""

    def apply(x: np.ndarray, c: Context) -> np.ndarray:
        rng = c.frozen("hot_pixels")
        hot = (rng.random(c.size) < fraction) * rng.exponential(size=c.size)
        hot *= amplitude / c.camera.gain / max(np.sqrt(np.mean(hot**2)), 1e-12)
        return x + hot * c.exposure

    return Effect("hot_pixels", amplitude, "pixel", apply)


def dsnu(amplitude: float) -> Effect:
    """Frozen offset of each pixel, Gaussian, independent of exposure; amplitude rms DN."""
    return Effect(
        "dsnu", amplitude, "analog", lambda y, c: y + amplitude * c.frozen("dsnu").standard_normal(c.size)
    )


def crosstalk(amplitude: float) -> Effect:
    """Coupling after collection: each pixel gives `amplitude` of its charge to its four neighbours."""
    kernel = np.array(
        [[0, amplitude / 4, 0], [amplitude / 4, 1 - amplitude, amplitude / 4], [0, amplitude / 4, 0]]
    )
    return Effect(
        "crosstalk", amplitude, "charge", lambda n, c: ndimage.convolve(n, kernel[None], mode="nearest")
    )


def saturation(amplitude: float) -> Effect:
    """Full well at `amplitude` of the white level: charge beyond it is lost."""
    return Effect(
        "saturation",
        amplitude,
        "charge",
        lambda n, c: np.minimum(n, amplitude * c.camera.electrons(np.ones(1))),
    )


def excess_noise(amplitude: float) -> Effect:
    """Stochastic multiplication: gamma gain with excess variance, F^2 = 1 + amplitude."""

    def apply(n: np.ndarray, c: Context) -> np.ndarray:
        return np.where(n > 0, c.rng.gamma(np.maximum(n, 1e-9) / amplitude, amplitude), 0.0)

    return Effect("excess_noise", amplitude, "charge", apply)


def image_lag(amplitude: float) -> Effect:
    """A fraction `amplitude` of the previous frame's charge is read out with the next one."""

    def apply(n: np.ndarray, c: Context) -> np.ndarray:
        out = n.copy()
        out[1:] += amplitude * (n[:-1] - n[1:])
        return out

    return Effect("image_lag", amplitude, "charge", apply)


def _behind(n: np.ndarray, share: float, axis: int) -> np.ndarray:
    """Each pixel keeps a `share` of its charge back, of which the next three get a half, a third and the
    rest."""
    out = (1 - share) * n
    for step, part in enumerate((1 / 2, 1 / 3, 1 / 6), 1):
        late = np.roll(n, step, axis)
        np.moveaxis(late, axis, 0)[:step] = 0
        out += share * part * late
    return out


def parallel_cti(amplitude: float) -> Effect:
    """A fraction `amplitude` of the charge comes out with the rows below."""
    return Effect("parallel_cti", amplitude, "charge", lambda n, c: _behind(n, amplitude, 1))


def serial_cti(amplitude: float) -> Effect:
    """A fraction `amplitude` of the charge comes out with the pixels on the right."""
    return Effect("serial_cti", amplitude, "charge", lambda n, c: _behind(n, amplitude, 2))


def cosmic_rays(amplitude: float) -> Effect:
    """`amplitude` hits per megapixel and second, each a few pixels long and hundreds of electrons strong."""

    def apply(n: np.ndarray, c: Context) -> np.ndarray:
        out = n.copy()
        height, width = c.size
        rate = amplitude * height * width / 1e6 * c.shot.exposure_s
        for frame in out:
            for _ in range(c.rng.poisson(rate)):
                y, x = c.rng.integers(0, height), c.rng.integers(0, width)
                angle, length = c.rng.uniform(0, np.pi), c.rng.integers(1, 9)
                for step in range(length):
                    i, j = int(y + step * np.sin(angle)), int(x + step * np.cos(angle))
                    if 0 <= i < height and 0 <= j < width:
                        frame[i, j] += c.rng.exponential(400 + 20 * c.camera.read_e)
        return out

    return Effect("cosmic_rays", amplitude, "charge", apply)
