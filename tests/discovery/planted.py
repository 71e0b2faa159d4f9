"""Effects planted into fields without any: offsets, or factors of the light, that groups of pixels share, and
what laws of their own leave."""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from cannoise_jax.signatures.fields import Fields, helmert, refit
from cannoise_jax.signatures.signature import Signature
from tests.discovery.drawn import SIZE, Many, drawn, standing_out, wide
from tests.discovery.looks import SIGNATURES


def _tiles(side: int):
    def offsets(rng, t, size):
        return np.kron(rng.standard_normal((t, size[0] // side, size[1] // side)), np.ones((side, side)))

    return offsets


def _diagonal(rng, t, size):
    rows, columns = np.indices(size)
    return rng.standard_normal((t, sum(size)))[:, columns - rows + size[0]]


PLANTED = {
    "row": lambda rng, t, size: rng.standard_normal((t, size[0], 1)),
    "column": lambda rng, t, size: rng.standard_normal((t, 1, size[1])),
    "column by turns": lambda rng, t, size: (
        (-1.0) ** np.arange(size[0])[:, None] * rng.standard_normal((t, 1, size[1]))
    ),
    "frame": lambda rng, t, size: rng.standard_normal((t, 1, 1)),
    "pixel": lambda rng, t, size: rng.standard_normal((t, *size)),
    **{f"tile_{side}": _tiles(side) for side in (8, 16, 32, 64)},
    "diagonal": _diagonal,
    "antidiagonal": lambda rng, t, size: _diagonal(rng, t, size)[:, :, ::-1],
    "site": lambda rng, t, size: np.tile(rng.standard_normal((t, 2, 2)), (1, size[0] // 2, size[1] // 2)),
    "row_parity": lambda rng, t, size: np.tile(rng.standard_normal((t, 2, 1)), (1, size[0] // 2, 1)),
    "column_parity": lambda rng, t, size: np.tile(rng.standard_normal((t, 1, 2)), (1, 1, size[1] // 2)),
}
"""Unit offsets [t, h, w] by the kin of a signature."""
SHARED = [s for s in SIGNATURES.values() if s.kin in PLANTED and s.axes.law == "white"]


def _bare(signature: Signature):
    return wide if signature.kin in ("tile_32", "tile_64") else drawn


@cache
def _shift(name: str) -> float:
    signature = SIGNATURES[name]
    score = signature.score(_bare(signature)(6))
    assert score is not None
    return score.shift


def planted(signature: Signature, times: float, seed: int = 6) -> tuple[Many, float]:
    """White fields with offsets, or factors of the light, of `times` what shifts the score by one."""
    fields, axes = _bare(signature)(seed), signature.axes
    rng, offsets = np.random.default_rng(seed), PLANTED[signature.kin]
    amplitude = math.sqrt(times) * _shift(signature.name)
    longest = max(f.exposure_s for f in fields)
    size = fields[0].mean.shape
    frozen = offsets(rng, 1, size)[0]
    out = []
    for f in fields:
        unit = {"additive": 1.0, "signal": f.signal if f.lit else 0.0, "exposure": f.exposure_s / longest}[
            axes.scales
        ]
        load = (amplitude * unit * f.weight).astype(np.float32)
        if axes.time == "frozen":
            moved = f.static + np.float32(np.sqrt(f.frames)) * frozen * load
            out.append(f._replace(static=moved.astype(np.float32)))
        else:
            new = offsets(rng, len(f.contrasts), size)
            out.append(f._replace(contrasts=(f.contrasts + new * load).astype(np.float32)))
    return tuple(out), amplitude


ROWS, COLUMNS = np.indices(SIZE)
FIRST = (SIZE[1] // 2 > COLUMNS) - 0.5


def _new(f: Fields) -> tuple[int, int, int]:
    return (len(f.contrasts), 1, 1)


def _wave(phase):
    return np.cos(2 * np.pi * (0.11 * ROWS + 0.23 * COLUMNS) + phase)


def _waves_of_frames(rng, f: Fields):
    """What waves of a phase of its own in every frame leave between frames."""
    waves = _wave(rng.uniform(0, 6.3, (f.frames, 1, 1)))
    return np.einsum("nt,tij->nij", helmert(f.frames), waves)[: len(f.contrasts)]


def _pink(rng, shape):
    """1/f noise along the last axis, of unit rms."""
    frequency = np.maximum(np.fft.rfftfreq(shape[-1]), 1 / shape[-1])
    values = np.fft.irfft(np.fft.rfft(rng.standard_normal(shape)) / np.sqrt(frequency), shape[-1])
    return values / values.std()


def _alike(*lags: tuple[int, int]):
    """Noise that each pixel shares with those so many rows and columns away."""

    def values(rng, unit, f):
        own = rng.standard_normal(f.contrasts.shape)
        return 2 * (own + 0.5 / len(lags) * sum(np.roll(own, lag, (1, 2)) for lag in lags))

    return values


def _of_light(law, electrons: bool = False):
    """Of lit fields; by the root of the signal where the correlation grows with the electrons."""
    return lambda rng, unit, f: law(rng, unit, f) * f.lit * (np.sqrt(f.signal / 60) if electrons else 1.0)


def _sparse(unit):
    return np.where(unit.random(SIZE) < 0.01, unit.exponential(60.0, SIZE), 0.0)


def _jumps(rng, unit, f):
    """Pixels that are at one of two levels, in units of the contrasts."""
    chosen = unit.random(SIZE) < 0.03
    return np.einsum("nt,tij->nij", helmert(f.frames), 15 * chosen * (rng.random((f.frames, *SIZE)) < 0.5))


def _swelling(rng, f):
    """A glow from a corner whose strength is new in every contrast, of unit rms."""
    glow = np.exp(-np.hypot(ROWS, COLUMNS) / 20)
    glow = glow - glow.mean()
    return rng.standard_normal(_new(f)) * glow / glow.std()


def _tile():
    """Of 6 rows and 4 columns, of unit rms."""
    tile = np.random.default_rng(7).standard_normal((6, 4))
    tile = (tile - tile.mean()) / tile.std()
    return tile[ROWS % 6, COLUMNS % 4]


def _moved_tiles(rng, f):
    """Of 6 rows and 10 columns, of unit rms, new in every contrast."""
    return rng.standard_normal((len(f.contrasts), 6, 10))[:, ROWS % 6, COLUMNS % 10]


def _leak(f):
    """Light that leaks into darks as a stripe that fades along the rows: no fall from a corner or edge."""
    stripe = np.exp(-(((ROWS - 12) / 7.0) ** 2)) * np.exp(-COLUMNS / 20.0)
    return stripe / stripe.std() * (f.kind == "dark")


OWN = {
    "smooth_additive": lambda rng, unit, f: 3 * _leak(f),
    "repeating": lambda rng, unit, f: 2 * _tile(),
    "repeating_redrawn": lambda rng, unit, f: 2 * _moved_tiles(rng, f),
    "smooth_thermal": lambda rng, unit, f: 8 * f.exposure_s * _leak(f),
    "modulated_additive": lambda rng, unit, f: 2 * _swelling(rng, f),
    "modulated_relative": lambda rng, unit, f: 0.02 * f.signal * _swelling(rng, f) * f.lit,
    "modulated_thermal": lambda rng, unit, f: 2 * f.exposure_s * _swelling(rng, f),
    "wave_redrawn": lambda rng, unit, f: 1.5 * _waves_of_frames(rng, f),
    "wave_frozen": lambda rng, unit, f: 1.5 * _wave(unit.uniform(0, 6.3)),
    "flicker": lambda rng, unit, f: (
        0.02 * f.signal * np.cos(2 * np.pi * 0.1 * ROWS + rng.uniform(0, 6.3, _new(f)))
    ),
    "row_slope": lambda rng, unit, f: 3 * _pink(rng, (len(f.contrasts), SIZE[0]))[:, :, None],
    "raster_slope": lambda rng, unit, f: 3 * _pink(rng, (len(f.contrasts), ROWS.size)).reshape(-1, *SIZE),
    "hot_additive": lambda rng, unit, f: _sparse(unit),
    "hot_thermal": lambda rng, unit, f: _sparse(unit) * f.exposure_s,
    "step": lambda rng, unit, f: 2 * FIRST,
    "dead": lambda rng, unit, f: np.where(unit.random(SIZE) < 0.003, -f.signal, 0.0),
    "telegraph": _jumps,
    "smear": lambda rng, unit, f: 0.05 * (f.signal.mean(0) - f.signal.mean()) * (f.kind == "scene"),
    "curvature": lambda rng, unit, f: 2e-4 * f.signal**2 * (f.kind == "scene"),
    "glow": lambda rng, unit, f: (
        20 * f.exposure_s * np.exp(-np.hypot(ROWS, COLUMNS) / 10) * (f.kind == "dark")
    ),
    "lags_any": _alike((0, 1)),
    "lags_read": _alike((0, 1)),
    "lags_brighter_fatter": _of_light(_alike((0, 1), (1, 0)), electrons=True),
    "lags_crosstalk": _of_light(_alike((0, 1), (1, 0))),
    "lags_demosaicing": _alike((0, 1), (1, 0)),
    "lags_in_camera_denoising": _alike((0, 2), (2, 0)),
    "lags_in_camera_denoising_8": _alike((0, 2), (2, 0), (2, 2), (2, -2)),
    "scene_static": lambda rng, unit, f: 2 * rng.standard_normal(SIZE) * (f.kind == "scene"),
}
"""What laws of their own leave in a field, DN: new in every contrast `[n, H, W]`, or a map that stays. unit:
of the camera, the same for all of its fields."""
TRUE = {
    "wave_redrawn": 1.5,
    "wave_frozen": 1.5,
    "repeating": 2.0,
    "flicker": 0.02,
    "row_slope": 3.0,
    "raster_slope": 3.0,
    "step": 2.0,
    "smear": 0.05,
    "scene_static": 2.0,
}
"""Amplitudes of those that were planted in the unit of the signature."""


def by_own_law(name: str, seed: int = 6) -> Many:
    """Fields with what a law of its own leaves, as a baseline leaves them."""
    rng, bare = np.random.default_rng(seed), drawn(seed)

    def laid_over(f: Fields) -> Fields:
        values = OWN[name](rng, np.random.default_rng([9, seed]), f)
        if np.ndim(values) == 3:
            return f._replace(contrasts=(f.contrasts + values * f.weight).astype(np.float32))
        return f._replace(static=(f.static + np.sqrt(f.frames) * values * f.weight).astype(np.float32))

    return refit(tuple(laid_over(f) for f in bare), bare)


def with_tails(axis: int, share: float, seed: int = 6) -> Many:
    """Fields of pixels that stand out, of which each leaves a share to the next one along an axis."""

    def late(x: np.ndarray) -> np.ndarray:
        return ((1 - share) * x + share * np.roll(x, 1, axis - 2)).astype(np.float32)

    return tuple(f._replace(contrasts=late(f.contrasts), static=late(f.static)) for f in standing_out(seed))
