"""Injected effects of readout, conversion and in-camera processing, each the catalogue's equation."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from cannoise_jax.blind.chain import Context, Effect, digitise, tile


def _add(mechanism: str, amplitude: float, field) -> Effect:
    """DN + amplitude * field(context); `field` has unit rms (a sinusoid: unit peak)."""
    return Effect(mechanism, amplitude, "analog", lambda y, c: y + amplitude * field(c))


def _coloured(rng: np.random.Generator, rows: int, length: int, exponent: float = 1.0) -> np.ndarray:
    """`rows` independent series with power 1/f^exponent, zero mean, unit expected variance."""
    frequency = np.fft.rfftfreq(length)
    shape = np.zeros_like(frequency)
    shape[1:] = frequency[1:] ** (-exponent / 2)
    spectrum = np.fft.rfft(rng.standard_normal((rows, length)), axis=-1) * shape
    weight = np.ones_like(shape)
    weight[1 : (length + 1) // 2] = 2
    return np.fft.irfft(spectrum, length, axis=-1) / np.sqrt(np.sum(weight * shape**2) / length)


def row_noise(amplitude: float) -> Effect:
    """One offset a row, white from row to row, new in each frame."""
    return _add("row_noise", amplitude, lambda c: c.rng.standard_normal((c.shot.frames, c.size[0], 1)))


def column_noise(amplitude: float) -> Effect:
    """One offset a column, new in each frame."""
    return _add("column_noise", amplitude, lambda c: c.rng.standard_normal((c.shot.frames, 1, c.size[1])))


def row_fpn(amplitude: float) -> Effect:
    """One frozen offset a row."""
    return _add("row_fpn", amplitude, lambda c: c.frozen("row_fpn").standard_normal((c.size[0], 1)))


def column_fpn(amplitude: float) -> Effect:
    """One frozen offset a column."""
    return _add("column_fpn", amplitude, lambda c: c.frozen("column_fpn").standard_normal(c.size[1]))


def pink_noise(amplitude: float) -> Effect:
    """1/f along the raster scan, line after line, new in each frame."""

    def field(c: Context) -> np.ndarray:
        height, width = c.size
        return _coloured(c.rng, c.shot.frames, height * width).reshape(-1, height, width)

    return _add("pink_noise", amplitude, field)


def row_pink_noise(amplitude: float) -> Effect:
    """Constant along a row, 1/f from row to row, new in each frame."""
    return _add("row_pink_noise", amplitude, lambda c: _coloured(c.rng, c.shot.frames, c.size[0])[:, :, None])


def banding(amplitude: float) -> Effect:
    """Pickup: one frequency in raster time, phase new in each frame; amplitude is the peak."""

    def field(c: Context) -> np.ndarray:
        height, width = c.size
        cycles_per_pixel = c.frozen("banding").uniform(0.002, 0.45)
        raster = np.arange(height * width).reshape(height, width)
        phase = c.rng.uniform(0, 2 * np.pi, (c.shot.frames, 1, 1))
        return np.sin(2 * np.pi * cycles_per_pixel * raster + phase)

    return _add("banding", amplitude, field)


def offset_drift(amplitude: float) -> Effect:
    """The pedestal of each frame, drawn anew."""
    return _add("offset_drift", amplitude, lambda c: c.rng.standard_normal((c.shot.frames, 1, 1)))


def channel_offset(amplitude: float) -> Effect:
    """A frozen black-level error of each colour site, zero on average, rms `amplitude`."""

    def field(c: Context) -> np.ndarray:
        values = c.frozen("channel_offset").standard_normal(4)
        values -= values.mean()
        return tile(values / np.sqrt(np.mean(values**2)), c.size)

    return _add("channel_offset", amplitude, field)


def amplifier_mismatch(amplitude: float) -> Effect:
    """The right half is read by another amplifier: a step of `amplitude` DN at the middle column."""
    return _add("amplifier_mismatch", amplitude, lambda c: (np.arange(c.size[1]) >= c.size[1] // 2) - 0.5)


def heavy_tails(amplitude: float) -> Effect:
    """Read noise of Student's t with excess kurtosis `amplitude`, variance unchanged."""
    freedom = 4 + 6 / amplitude

    def apply(read: np.ndarray, c: Context) -> np.ndarray:
        return c.rng.standard_t(freedom, read.shape) * np.sqrt((freedom - 2) / freedom) * np.std(read)

    return Effect("heavy_tails", amplitude, "read", apply)


def pixel_read_noise_map(amplitude: float) -> Effect:
    """Each pixel has its own read noise: log-normal with relative rms width `amplitude`, mean square one."""

    def apply(read: np.ndarray, c: Context) -> np.ndarray:
        width = np.sqrt(np.log1p(amplitude**2))
        scale = np.exp(width * c.frozen("pixel_read_noise_map").standard_normal(c.size))
        return read * scale / np.exp(width**2)

    return Effect("pixel_read_noise_map", amplitude, "read", apply)


def rts(amplitude: float, fraction: float = 0.01) -> Effect:
    """Random telegraph signal: a frozen few pixels take -A, 0 or +A; amplitude rms DN over all pixels."""

    def apply(y: np.ndarray, c: Context) -> np.ndarray:
        rng = c.frozen("rts")
        height = (rng.random(c.size) < fraction) * rng.exponential(size=c.size)
        height *= amplitude / max(np.sqrt(np.mean(height**2) / 2), 1e-12)
        return y + height * c.rng.choice((-1, 0, 0, 1), size=y.shape)

    return Effect("rts", amplitude, "analog", apply)


def dead_pixels(amplitude: float) -> Effect:
    """A frozen fraction `amplitude` of the pixels answers with the black level."""

    def apply(y: np.ndarray, c: Context) -> np.ndarray:
        dead = c.frozen("dead_pixels").random(c.size) < amplitude
        return np.where(dead, c.camera.black_map(c.size), y)

    return Effect("dead_pixels", amplitude, "analog", apply)


def missing_codes(amplitude: float) -> Effect:
    """Every `amplitude`-th code is never produced: the converter answers with the code below."""

    def apply(code: np.ndarray, c: Context) -> np.ndarray:
        index = np.rint(code / c.camera.step)
        return np.where(index % amplitude == 0, np.maximum(index - 1, 0), index) * c.camera.step

    return Effect("missing_codes", amplitude, "code", apply)


def quantization(amplitude: float) -> Effect:
    """Codes spaced `amplitude` DN apart where the description says less."""

    def apply(code: np.ndarray, c: Context) -> np.ndarray:
        return np.rint(code / amplitude) * amplitude

    return Effect("quantization", amplitude, "code", apply)


def black_clipping(amplitude: float) -> Effect:
    """Codes below black + `amplitude` DN are stored as that value."""

    def apply(code: np.ndarray, c: Context) -> np.ndarray:
        floor = np.rint((c.camera.black_map(c.size) + amplitude) / c.camera.step) * c.camera.step
        return np.maximum(code, floor)

    return Effect("black_clipping", amplitude, "code", apply)


def in_camera_denoising(amplitude: float) -> Effect:
    """Each pixel is blended with the mean of its four same-colour neighbours; amplitude is the weight.

    The camera averages with more bits than it stores: rounding first would undo a small blend.
    """

    def apply(y: np.ndarray, c: Context) -> np.ndarray:
        kernel = np.zeros((1, 5, 5))
        kernel[0, 0, 2] = kernel[0, 4, 2] = kernel[0, 2, 0] = kernel[0, 2, 4] = amplitude / 4
        kernel[0, 2, 2] = 1 - amplitude
        return ndimage.convolve(y, kernel, mode="mirror")

    return Effect("in_camera_denoising", amplitude, "analog", apply)


def hot_pixel_suppression(amplitude: float) -> Effect:
    """What rises above the eight same-colour neighbours is lowered to them by the weight `amplitude`."""

    def apply(code: np.ndarray, c: Context) -> np.ndarray:
        footprint = np.zeros((1, 5, 5), bool)
        footprint[0, ::2, ::2] = True
        footprint[0, 2, 2] = False
        cap = ndimage.maximum_filter(code, footprint=footprint, mode="mirror")
        return digitise(code - amplitude * np.maximum(code - cap, 0), c.camera)

    return Effect("hot_pixel_suppression", amplitude, "code", apply)


def defect_correction(amplitude: float) -> Effect:
    """A frozen fraction `amplitude` of the pixels holds the mean of its same-colour row neighbours."""

    def apply(code: np.ndarray, c: Context) -> np.ndarray:
        filled = digitise(
            ndimage.convolve(code, np.array([0.5, 0, 0, 0, 0.5])[None, None], mode="mirror"), c.camera
        )
        return np.where(c.frozen("defect_correction").random(c.size) < amplitude, filled, code)

    return Effect("defect_correction", amplitude, "code", apply)
