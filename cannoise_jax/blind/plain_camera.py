"""Cameras in plain NumPy with one effect each, apart from the other injectors in code, forms and numbers.

What is recorded, and how a frame comes about: light in electrons, Poisson charge, read noise, codes. An
effect is a record of functions that change one of these; what it keeps between frames of a recording lies in
the state of that recording.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt16
from scipy import ndimage

from cannoise_jax.recordings.recording import CaptureSet, Kind, Recording

SIZE = (128, 160)
COLOURS = {
    "MONO": np.ones((2, 2)),
    "RGGB": np.array([[0.55, 1.0], [1.0, 0.7]]),
    "GBRG": np.array([[1.0, 0.7], [0.55, 1.0]]),
}
"""Transmission of the colours of a mosaic."""


class Camera(NamedTuple):
    """gain: DN/e-; read_e: read noise, e-; black, top: DN; span: top less black, DN; size: rows, columns."""

    cfa: str
    gain: float
    read_e: float
    black: float
    top: float
    size: tuple[int, int]

    @property
    def read_dn(self) -> float:
        """Read noise, DN."""
        return self.gain * self.read_e

    @property
    def span(self) -> float:
        """DN from black to the highest code."""
        return self.top - self.black


class Shot(NamedTuple):
    """One frame: kind of the recording, exposure, s, number of the frame, and what an effect keeps between
    the frames of a recording."""

    kind: str
    seconds: float
    frame: int
    state: dict[str, Any]


Change = Callable[[np.ndarray, Shot, np.random.Generator], np.ndarray]


def same(values: np.ndarray, shot: Shot, rng: np.random.Generator) -> np.ndarray:
    """No change."""
    return values


class Effect(NamedTuple):
    """light: expected electrons; charge: electrons after Poisson; read: read noise, e-; analog: DN above
    black before rounding; code: stored codes."""

    light: Change = same
    charge: Change = same
    read: Change = same
    analog: Change = same
    code: Change = same


Make = Callable[[np.random.Generator, Camera], Effect]


def draw_camera(rng: np.random.Generator, size: tuple[int, int] = SIZE) -> Camera:
    """10, 12 or 14 bits, one or four colours, 0.1 to 4 DN/e-, noise of one to twenty codes."""
    bits = int(rng.choice([10, 12, 14]))
    black = {10: 40, 12: 200, 14: 800}[bits] * rng.uniform(0.8, 1.3)
    gain = float(rng.uniform(0.4, 2.0) * {10: 0.25, 12: 1, 14: 2}[bits])
    read_e = float(rng.uniform(1.2, 2.5) / gain if bits == 10 else rng.uniform(2, 6))
    return Camera(str(rng.choice(list(COLOURS))), gain, read_e, float(black), 2.0**bits - 1, size)


def plan(rng: np.random.Generator) -> list[tuple[Kind, float, float, int]]:
    """Recordings: kind, level of the light, exposure in seconds, frames."""
    out: list[tuple[Kind, float, float, int]] = [("bias", 0.0, 0.001, int(rng.integers(8, 13)))]
    out += [("dark", 0.0, seconds, int(rng.integers(6, 11))) for seconds in (0.5, 2.0)]
    out += [("flat", level, 0.2 * level, int(rng.integers(6, 10))) for level in (0.08, 0.25, 0.5, 0.8)]
    return [*out, ("scene", 0.8, 0.05, int(rng.integers(6, 9)))]


def scene(rng: np.random.Generator, size: tuple[int, int]) -> Float[np.ndarray, "h w"]:
    """Texture of four sizes and a few boxes, 0.05 to 0.7 of the range."""
    image = np.zeros(size)
    for width in (2, 5, 12, 25):
        texture = ndimage.gaussian_filter(rng.normal(size=size), width)
        image += texture / texture.std()
    for _ in range(8):
        y, x = rng.integers(size[0]), rng.integers(size[1])
        image[y : y + rng.integers(5, 40), x : x + rng.integers(5, 40)] += rng.uniform(-2, 2)
    return 0.05 + 0.65 * (image - image.min()) / np.ptp(image)


def expose(
    camera: Camera, effect: Effect, clean: np.ndarray, shot: Shot, rng: np.random.Generator
) -> UInt16[np.ndarray, "h w"]:
    """One frame of normalised light."""
    electrons = effect.light(clean * camera.span / camera.gain, shot, rng)
    charge = effect.charge(rng.poisson(np.maximum(electrons, 0)).astype(float), shot, rng)
    read = effect.read(camera.read_e * rng.normal(size=camera.size), shot, rng)
    value = effect.analog(camera.gain * (charge + read), shot, rng)
    codes = np.clip(np.round(value + camera.black), 0, camera.top).astype(np.int64)
    return np.clip(effect.code(codes, shot, rng), 0, camera.top).astype(np.uint16)


def capture_set(make: Make, rng: np.random.Generator, size: tuple[int, int] = SIZE) -> CaptureSet:
    """A camera with one effect, recorded: bias, darks, flats and a scene of known light."""
    camera = draw_camera(rng, size)
    effect = make(rng, camera)
    colours = np.tile(COLOURS[camera.cfa], (size[0] // 2, size[1] // 2))
    out = []
    for number, (kind, level, seconds, frames) in enumerate(plan(rng)):
        clean = (scene(rng, size) if kind == "scene" else np.full(size, level)) * colours
        state: dict[str, Any] = {}
        stack = [expose(camera, effect, clean, Shot(kind, seconds, t, state), rng) for t in range(frames)]
        known = clean.astype(np.float32) if kind == "scene" else None
        out.append(
            Recording(
                np.stack(stack), camera.cfa, (camera.black,) * 4, camera.top, "plain camera", kind, known,
                iso=100.0, exposure_s=seconds, shot=(camera.gain / camera.span,) * 4,
                read=((camera.read_dn / camera.span) ** 2,) * 4, code_step=1.0,
                reference=None if known is None else "independent", path=f"{number}_{kind}.h5",
            )
        )  # fmt: skip
    return CaptureSet("plain camera", tuple(out))
