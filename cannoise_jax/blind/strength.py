"""The injector's own minimum detectable effect (MDE), computed apart from the tool under test.

The likelihood-ratio test that knows an effect's form, with black level, gain and read noise unknown, is
shifted by d null standard deviations over all frames of a set. Two shapes of that shift cover almost all:

    a known mean template m:  d^2 = a^2 (sum m^2/v - its projection on the black level)
    a random term, one draw per group g (row, pixel, frame ...) with loads m:
                              d^2 = a^4/2 (sum_g (sum_i m_i^2/v_i)^2 - sum_i (m_i^2/v_i)^2)

v is the variance of a pixel in a frame. The second sum takes the diagonal away, for a change of variance
alone is what gain and read noise absorb. Multiples multiply d: `amplitude_at(k)` solves d = 5 k.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from cannoise_jax.blind.chain import Camera, tile


@dataclass(frozen=True)
class Exposed:
    """What strength needs of one recording: electrons expected, exposure as a share."""

    electrons: np.ndarray
    frames: int
    kind: str
    exposure: float
    exposure_s: float
    static: bool  # False: the reference is a mean of the same camera's frames, static effects cancel

    def variance(self, camera: Camera) -> np.ndarray:
        """Variance of a pixel in one frame, DN^2."""
        return camera.gain**2 * (self.electrons + camera.read_e**2) + camera.step**2 / 12


@dataclass(frozen=True)
class Strength:
    """d(a) = slope * a^power, the shift in null standard deviations."""

    slope: float
    power: int

    def amplitude_at(self, multiple: float) -> float:
        """Amplitude whose shift is `multiple` times that of the MDE."""
        return float((5 * multiple / max(self.slope, 1e-30)) ** (1 / self.power))

    def shift(self, amplitude: float) -> float:
        """Shift at an amplitude."""
        return float(self.slope * amplitude**self.power)


Load = Callable[[Camera, Exposed], np.ndarray]


def _signal(camera: Camera, r: Exposed) -> np.ndarray:
    return camera.gain * r.electrons


def _one(camera: Camera, r: Exposed) -> np.ndarray:
    return np.ones_like(r.electrons)


def _template(
    camera: Camera, sets: Sequence[Exposed], mean: Load, *, static: bool = True, channels=True
) -> Strength:
    """Shift of a known mean template, the black level (per channel, or one) projected off."""
    mm, m1, one = 0.0, np.zeros(4), np.zeros(4)
    for r in sets:
        if static and not r.static:
            continue
        m, w = mean(camera, r), r.frames / r.variance(camera)
        site = tile(np.arange(4), r.electrons.shape).ravel() if channels else np.zeros(m.size, int)
        mm += float(np.sum(w * m * m))
        m1 += np.bincount(site, (w * m).ravel(), 4)
        one += np.bincount(site, w.ravel(), 4)
    lost = np.sum(np.divide(m1**2, one, out=np.zeros(4), where=one > 0))
    return Strength(float(np.sqrt(max(mm - lost, 0))), 1)


def _random(camera: Camera, sets: Sequence[Exposed], load: Load, groups: str) -> Strength:
    """Shift of a random term: one draw per row, column or frame, or per pixel, row or column of the unit."""
    total = 0.0
    frozen: dict[str, np.ndarray] = {}
    axis = {"row": 1, "column": 0, "unit_row": 1, "unit_column": 0}.get(groups)
    for r in sets:
        w = load(camera, r) ** 2 / r.variance(camera)
        own = float(np.sum(w * w))
        if groups.startswith("unit"):
            if r.static:
                summed = w * r.frames if groups == "unit_pixel" else r.frames * w.sum(axis)
                frozen["sum"] = frozen.get("sum", 0) + summed
                total -= r.frames * own
        else:
            summed = w.sum() if groups == "frame" else w.sum(axis)
            total += r.frames * (float(np.sum(summed**2)) - own)
    total += sum(float(np.sum(s**2)) for s in frozen.values())
    return Strength(float(np.sqrt(max(total, 0) / 2)), 2)


def _pooled(camera: Camera, sets: Sequence[Exposed], information: Load, power: int) -> Strength:
    """Shift of an effect with `information` per pixel and frame at unit amplitude."""
    total = sum(r.frames * float(np.sum(information(camera, r))) for r in sets)
    return Strength(float(np.sqrt(total)), power)


def _read_share(camera: Camera, r: Exposed) -> np.ndarray:
    return (camera.gain * camera.read_e) ** 2 / r.variance(camera)


def _shot_share(camera: Camera, r: Exposed) -> np.ndarray:
    return camera.gain**2 * r.electrons / r.variance(camera)


def _read_map(camera: Camera, sets: Sequence[Exposed]) -> Strength:
    """Spread of read noise over pixels, relative variance 2 a: frames show the same pixels noisier again."""
    information = sum(r.frames * _read_share(camera, r) ** 2 / 2 for r in sets)
    single = sum(r.frames * _read_share(camera, r) ** 4 / 4 for r in sets)
    return Strength(float(np.sqrt(np.sum(np.square(information) - single) / 2)) * 4, 2)


def _telegraph(camera: Camera, sets: Sequence[Exposed], fraction: float = 0.01) -> Strength:
    """Few jumping pixels, exponential in height: mean square of the added variance is 6/fraction a^4."""
    information = sum(r.frames / (2 * r.variance(camera) ** 2) for r in sets)
    return Strength(6 / fraction * float(np.sqrt(np.sum(np.square(information)) / 2)), 4)


def _row_pink(camera: Camera, sets: Sequence[Exposed]) -> Strength:
    """Correlated rows: d^2 = a^4/2 tr((W R)^2), W the rows' information, R their correlation."""
    total = 0.0
    for r in sets:
        w = (1 / r.variance(camera)).sum(1)
        n = w.size
        f = np.fft.fftfreq(n)
        power = np.divide(1, np.abs(f), out=np.zeros(n), where=f != 0)
        lag = np.fft.ifft(power / power.mean()).real
        R = lag[np.abs(np.subtract.outer(np.arange(n), np.arange(n)))]
        total += r.frames * float(np.sum(np.outer(w, w) * R * R))
    return Strength(float(np.sqrt(total / 2)), 2)


def _raster_pink(camera: Camera, sets: Sequence[Exposed]) -> Strength:
    """1/f along the scan, the mean information standing for each pixel's: d^2 = a^4/2 w^2 sum_f P(f)^2."""
    total = 0.0
    for r in sets:
        w = float(np.mean(1 / r.variance(camera)))
        n = r.electrons.size
        f = np.abs(np.fft.fftfreq(n))
        power = np.divide(1, f, out=np.zeros(n), where=f > 0)
        total += r.frames * w**2 * float(np.sum((power / power.mean()) ** 2) - n)
    return Strength(float(np.sqrt(total / 2)), 2)


def _sinusoid(camera: Camera, sets: Sequence[Exposed], load: Load) -> Strength:
    """A line of known frequency, phase redrawn: two quadratures of variance a^2/2, loads 1/2 each."""
    total = sum(
        r.frames * 2 * float(np.sum(load(camera, r) ** 2 / r.variance(camera)) / 4) ** 2 for r in sets
    )
    return Strength(float(np.sqrt(total / 2)), 2)


def _corner(camera: Camera, r: Exposed) -> np.ndarray:
    height, width = r.electrons.shape
    y, x = np.mgrid[:height, :width]
    glow = np.exp(-np.hypot(y, x) / (0.2 * max(height, width)))
    return glow / np.sqrt(np.mean(glow**2)) * r.exposure


def _site(camera: Camera, r: Exposed) -> np.ndarray:
    return tile((1, -1, -1, 1), r.electrons.shape)


def strength(mechanism: str, camera: Camera, sets: Sequence[Exposed]) -> Strength | None:
    """How the shift of `mechanism` grows with its amplitude in these recordings; None: no law known here."""
    lit = [r for r in sets if r.kind in ("scene", "flat")]
    height, width = sets[0].electrons.shape
    full = (camera.white - np.mean(camera.black)) / camera.gain
    greens = np.abs(tile((0, 1, 1, 0) if camera.cfa in ("RGGB", "BGGR") else (1, 0, 0, 1), (height, width)))
    y, x = np.mgrid[:height, :width]
    radius = ((2 * y / (height - 1) - 1) ** 2 + (2 * x / (width - 1) - 1) ** 2) / 2
    match mechanism:
        case "prnu":
            return _random(camera, lit, _signal, "unit_pixel")
        case "column_gain":
            return _random(camera, lit, _signal, "unit_column")
        case "dsnu":
            return _random(camera, sets, _one, "unit_pixel")
        case "hot_pixels":
            s = _random(camera, sets, lambda c, r: r.exposure * _one(c, r), "unit_pixel")
            # Exponential over few pixels: the fourth moment is 6/fraction times the square of the second.
            return Strength(s.slope * np.sqrt(6 / 5e-4), 2)
        case "row_fpn":
            return _random(camera, sets, _one, "unit_row")
        case "column_fpn":
            return _random(camera, sets, _one, "unit_column")
        case "row_noise":
            return _random(camera, sets, _one, "row")
        case "column_noise":
            return _random(camera, sets, _one, "column")
        case "offset_drift":
            return _random(camera, sets, _one, "frame")
        case "row_pink_noise":
            return _row_pink(camera, sets)
        case "pink_noise":
            return _raster_pink(camera, sets)
        case "banding":
            return _sinusoid(camera, sets, _one)
        case "flicker":
            return _sinusoid(camera, lit, _signal)
        case "illumination_drift":
            moving = [r for r in lit if r.frames > 1]
            return _template(camera, moving, _signal, static=False) if moving else None
        case "nonlinearity":
            return _template(camera, lit, lambda c, r: _signal(c, r) * r.electrons / full)
        case "lens_shading":
            return _template(camera, lit, lambda c, r: _signal(c, r) * radius)
        case "green_imbalance":
            return _template(camera, lit, lambda c, r: _signal(c, r) * greens)
        case "amp_glow":
            return _template(camera, sets, _corner)
        case "amplifier_mismatch":
            return _template(camera, sets, lambda c, r: (x >= width // 2) - 0.5)
        case "channel_offset":
            return _template(camera, sets, _site, channels=False)
        case "dark_current":
            return _template(camera, sets, lambda c, r: np.full_like(r.electrons, c.gain * r.exposure_s))
        case "heavy_tails":
            return _pooled(camera, sets, lambda c, r: _read_share(c, r) ** 4 / 24, 1)
        case "pixel_read_noise_map":
            return _read_map(camera, sets)
        case "rts":
            return _telegraph(camera, sets)
        case "crosstalk":
            return _pooled(camera, lit, lambda c, r: 2 * (_shot_share(c, r) / 2) ** 2, 1)
        case "in_camera_denoising":
            return _pooled(camera, sets, lambda c, r: np.full_like(r.electrons, 2 * 0.5**2), 1)
        case _:
            return None
