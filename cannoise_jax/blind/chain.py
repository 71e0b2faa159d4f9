"""The injector's own camera: photons to codes in NumPy, written from the equations alone.

The signal chain runs in the order in which a sensor works. An effect is one function at one stage of it:

    photons    expected photo-electrons, before anything is drawn
    pixel      expected electrons of the pixel: dark charge joins the photo-electrons here
    charge     electrons that were really collected (after the Poisson draw)
    read       read noise in DN, before it is added
    analog     DN before the converter
    code       stored codes

Nothing here knows how a simulator or a detector of effects is built; this module shares no code with them.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

STAGES = ("photons", "pixel", "charge", "read", "analog", "code")


@dataclass(frozen=True)
class Camera:
    """One unit: gain in DN/e-, read noise in e-, black per mosaic site and white in DN, code step in DN."""

    gain: float
    read_e: float
    black: tuple[float, float, float, float]
    white: float
    step: float
    cfa: str
    iso: float
    unit: int
    longest_exposure_s: float

    def black_map(self, size: tuple[int, int]) -> np.ndarray:
        """Black level of every pixel, DN."""
        return tile(self.black, size)

    def electrons(self, clean: np.ndarray) -> np.ndarray:
        """Expected photo-electrons of a normalised clean signal."""
        return np.maximum(clean, 0) * (self.white - np.mean(self.black)) / self.gain


@dataclass(frozen=True)
class Shot:
    """What is recorded: a normalised clean mosaic (zeros for darks), how often, and for how long."""

    name: str
    kind: str
    clean: np.ndarray
    frames: int
    exposure_s: float


class Context(NamedTuple):
    """What an effect may look at: camera, shot, temporal draws, and the unit's frozen draws by name."""

    camera: Camera
    shot: Shot
    rng: np.random.Generator
    expected: np.ndarray  # photo-electrons without any effect, [H, W]

    def frozen(self, name: str) -> np.random.Generator:
        """A generator that gives the same draws whenever this unit is asked for `name`."""
        return frozen(self.camera.unit, name)

    @property
    def exposure(self) -> float:
        """Exposure as a fraction of the longest one of the set."""
        return self.shot.exposure_s / self.camera.longest_exposure_s

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        height, width = self.expected.shape
        return height, width


class Effect(NamedTuple):
    """A mechanism at one amplitude: `apply(values[T, H, W], context)` at `stage`."""

    mechanism: str
    amplitude: float
    stage: str
    apply: Callable[[np.ndarray, Context], np.ndarray]


def frozen(unit: int, name: str) -> np.random.Generator:
    """A generator of the unit's draws called `name`."""
    return np.random.default_rng([unit, zlib.crc32(name.encode())])


def tile(cell, size: tuple[int, int]) -> np.ndarray:
    """A 2x2 cell, mosaic order, over a mosaic of `size`."""
    height, width = size
    return np.tile(np.reshape(cell, (2, 2)), ((height + 1) // 2, (width + 1) // 2))[:height, :width]


def expose(camera: Camera, shot: Shot, effects: tuple[Effect, ...], rng: np.random.Generator) -> np.ndarray:
    """Records `shot`: `uint16[T, H, W]`. The same unit shows the same frozen patterns in every call."""
    expected = camera.electrons(shot.clean)
    context = Context(camera, shot, rng, expected)

    def through(stage: str, values: np.ndarray) -> np.ndarray:
        for effect in effects:
            if effect.stage == stage:
                values = effect.apply(values, context)
        return values

    shape = (shot.frames, *expected.shape)
    mean = through("pixel", through("photons", np.broadcast_to(expected, shape).astype(np.float64)))
    charge = through("charge", rng.poisson(np.maximum(mean, 0)).astype(np.float64))
    read = through("read", rng.standard_normal(shape) * (camera.read_e * camera.gain))
    analog = through("analog", camera.black_map(context.size) + camera.gain * charge + read)
    return through("code", digitise(analog, camera)).astype(np.uint16)


def digitise(analog: np.ndarray, camera: Camera) -> np.ndarray:
    """Rounds DN to the code lattice and clips at 0 and the white level."""
    top = np.floor(camera.white / camera.step) * camera.step
    return np.clip(np.rint(analog / camera.step) * camera.step, 0, top)
