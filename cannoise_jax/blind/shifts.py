"""Shapes in which the shift of a known effect grows: a template, random terms, pooled pixels, spectra.

The likelihood-ratio test that knows an effect's form, with black level, gain and read noise unknown, is
shifted by d null standard deviations over all frames of a set. Two shapes of that shift cover almost all:

    a known mean template m:  d^2 = a^2 (sum m^2/v - its projection on black level and gain)
    a random term, one draw per group g (row, pixel, frame ...) with loads m:
                              d^2 = a^4/2 (sum_g (sum_i m_i^2/v_i)^2 - sum_i (m_i^2/v_i)^2)

v is the variance of a pixel in a frame. The second sum takes the diagonal away, for a change of variance
alone is what gain and read noise absorb. Multiples multiply d: `amplitude_at(k)` solves d = 5 k.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from cannoise_jax.blind.chain import Camera, tile


class Law(Protocol):
    """How the shift of an effect, in null standard deviations, grows with its amplitude."""

    def amplitude_at(self, multiple: float) -> float:
        """Amplitude whose shift is `multiple` times five."""

    def shift(self, amplitude: float) -> float:
        """Shift at an amplitude."""


@dataclass(frozen=True)
class Exposed:
    """What strength needs of one recording: electrons expected, exposure as a share."""

    electrons: np.ndarray
    frames: int
    kind: str
    exposure: float
    exposure_s: float
    static: bool  # False: the reference is a mean of the same camera's frames, static effects cancel
    referenced: bool  # False: a flat whose light is not known

    def variance(self, camera: Camera) -> np.ndarray:
        """Variance of a pixel in one frame, DN^2."""
        return camera.gain**2 * (self.electrons + camera.read_e**2) + camera.step**2 / 12


@dataclass(frozen=True)
class Strength:
    """d(a) = slope * a^power, the shift in null standard deviations."""

    slope: float
    power: int

    def amplitude_at(self, multiple: float) -> float:
        """Amplitude whose shift is `multiple` times that of the MDE; infinite where nothing shows."""
        return float((5 * multiple / self.slope) ** (1 / self.power)) if self.slope > 0 else float("inf")

    def shift(self, amplitude: float) -> float:
        """Shift at an amplitude."""
        return float(self.slope * amplitude**self.power)


Load = Callable[[Camera, Exposed], np.ndarray]


def signal(camera: Camera, r: Exposed) -> np.ndarray:
    """Light of every pixel, DN."""
    return camera.gain * r.electrons


def one(camera: Camera, r: Exposed) -> np.ndarray:
    """The same everywhere."""
    return np.ones_like(r.electrons)


def template(camera: Camera, sets: Sequence[Exposed], mean: Load, *, channels: bool = True) -> Strength:
    """Shift of a known mean template; black level (per channel, or one) and gain (one) projected off.

    A flat without a reference lies under an unknown smooth surface per channel, which is projected off too.
    """
    mm, mb, bb = 0.0, np.zeros(5), np.zeros((5, 5))
    for r in sets:
        if not r.static:
            continue
        m, w = mean(camera, r), r.frames / r.variance(camera)
        if not r.referenced:
            m = _off_surface(m, w)
        site = tile(np.arange(4), m.shape) if channels else np.zeros(m.shape, int)
        planes = [np.where(site == c, 1.0, 0.0) for c in range(4)]
        nuisance = np.stack([*planes, signal(camera, r)]) * r.referenced
        mm += float(np.sum(w * m * m))
        mb += np.einsum("nij,ij->n", nuisance, w * m)
        bb += np.einsum("nij,kij,ij->nk", nuisance, nuisance, w, optimize=True)
    left = mm - float(mb @ np.linalg.lstsq(bb, mb, rcond=1e-12)[0])
    return Strength(float(np.sqrt(left)) if left > 1e-9 * mm else 0.0, 1)


def _off_surface(m: np.ndarray, w: np.ndarray) -> np.ndarray:
    """What a quadratic surface per channel leaves of `m`, weights `w`."""
    height, width = m.shape
    y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    out = np.empty_like(m)
    for site in range(4):
        part = np.s_[site // 2 :: 2, site % 2 :: 2]
        u, v = y[part].ravel(), x[part].ravel()
        basis = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], 1) * np.sqrt(w[part]).ravel()[:, None]
        target = (m[part] * np.sqrt(w[part])).ravel()
        fitted = basis @ np.linalg.lstsq(basis, target, rcond=None)[0]
        out[part] = ((target - fitted) / np.sqrt(w[part]).ravel()).reshape(m[part].shape)
    return out


def groups(name: str, size: tuple[int, int]) -> np.ndarray:
    """Number of the group that each pixel belongs to: row, column, frame, pixel, tile (16 px) or diagonal."""
    y, x = np.mgrid[: size[0], : size[1]]
    return {
        "row": y,
        "column": x,
        "frame": np.zeros(size, int),
        "pixel": y * size[1] + x,
        "tile": (y // 16) * (-(-size[1] // 16)) + x // 16,
        "diagonal": y + x,
    }[name].ravel()


def random(camera: Camera, sets: Sequence[Exposed], load: Load, group: str, frozen: bool = False) -> Strength:
    """Shift of a random term: one draw per group and frame, or, `frozen`, per group of the unit."""
    total, unit = 0.0, np.zeros(1)
    for r in sets:
        if frozen and not r.static:
            continue
        w = load(camera, r) ** 2 / r.variance(camera)
        summed = np.bincount(groups(group, w.shape), w.ravel())
        own = float(np.sum(w * w))
        if frozen:
            unit = unit + r.frames * summed
            total -= r.frames * own
        else:
            total += r.frames * (float(np.sum(summed**2)) - own)
    total += float(np.sum(np.square(unit)))
    return Strength(float(np.sqrt(max(total, 0) / 2)), 2)


def pooled(camera: Camera, sets: Sequence[Exposed], information: Load, power: int) -> Strength:
    """Shift of an effect with `information` per pixel and frame at unit amplitude."""
    total = sum(r.frames * float(np.sum(information(camera, r))) for r in sets)
    return Strength(float(np.sqrt(total)), power)


def read_share(camera: Camera, r: Exposed) -> np.ndarray:
    """Share of the read noise in the variance of a pixel."""
    return (camera.gain * camera.read_e) ** 2 / r.variance(camera)


def neighbours(camera: Camera, r: Exposed) -> np.ndarray:
    """Shot noise shared with the neighbours right and below: each of two gives a quarter of a to the other,
    so the darker one of two colours is the more correlated with the brighter."""
    given, v = camera.gain**2 * r.electrons / 4, r.variance(camera)
    out = np.zeros_like(v)
    out[:, :-1] = (given[:, :-1] + given[:, 1:]) ** 2 / (v[:, :-1] * v[:, 1:])
    out[:-1] += (given[:-1] + given[1:]) ** 2 / (v[:-1] * v[1:])
    return out


def read_map(camera: Camera, sets: Sequence[Exposed]) -> Strength:
    """Spread of read noise over pixels, relative variance 2 a: frames show the same pixels noisier again, and
    every single one has the heavier tails of a mixture."""
    information = sum(r.frames * read_share(camera, r) ** 2 / 2 for r in sets)
    single = sum(r.frames * read_share(camera, r) ** 4 / 2 for r in sets)
    return Strength(float(np.sqrt(np.sum(np.square(information) + single) / 2)) * 4, 2)


def row_pink(camera: Camera, sets: Sequence[Exposed]) -> Strength:
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


def raster_pink(camera: Camera, sets: Sequence[Exposed]) -> Strength:
    """1/f along the scan, the mean information standing for each pixel's: d^2 = a^4/2 w^2 sum_f P(f)^2."""
    total = 0.0
    for r in sets:
        w = float(np.mean(1 / r.variance(camera)))
        n = r.electrons.size
        f = np.abs(np.fft.fftfreq(n))
        power = np.divide(1, f, out=np.zeros(n), where=f > 0)
        total += r.frames * w**2 * float(np.sum((power / power.mean()) ** 2) - n)
    return Strength(float(np.sqrt(total / 2)), 2)


def sinusoid(camera: Camera, sets: Sequence[Exposed], load: Load) -> Strength:
    """A line of known frequency, phase redrawn: two quadratures of variance a^2/2, loads 1/2 each."""
    total = sum(
        r.frames * 2 * float(np.sum(load(camera, r) ** 2 / r.variance(camera)) / 4) ** 2 for r in sets
    )
    return Strength(float(np.sqrt(total / 2)), 2)


def corner(camera: Camera, r: Exposed) -> np.ndarray:
    """Light that falls off from a corner, rms 1, as the exposure has it."""
    height, width = r.electrons.shape
    y, x = np.mgrid[:height, :width]
    glow = np.exp(-np.hypot(y, x) / (0.2 * max(height, width)))
    return glow / np.sqrt(np.mean(glow**2)) * r.exposure


def site(camera: Camera, r: Exposed) -> np.ndarray:
    """One sign at two sites of the mosaic, the other at the others."""
    return tile((1, -1, -1, 1), r.electrons.shape)
