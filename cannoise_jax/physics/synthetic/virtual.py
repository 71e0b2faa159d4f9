"""Five virtual cameras: recordings with known truth, from a key, for training and tests without a download.

They carry the names, colour patterns and ISO settings of the five phones of SIDD. What is handed on as the
noise level function is the published one; the noise itself follows measured numbers that disagree with it, as
the noise of the real phones does:

- shot and read noise: the re-calibrated values for IP, S6 and GP; for N6 and G4 the published function times
  the ratio of standard deviations measured on two learned models (see `tables/phones.json`);
- row noise of 0.09 to 0.16 of the read noise, as measured on a Sony A7S2; on N6 it is 1/f from row to row;
- read noise with Tukey-lambda tails, shapes -0.2 to +0.1 as measured on the cameras of ELD and PMN;
- black-level errors per colour channel of 0.15 to 0.45 of the read noise, as in the tables of ELD;
- on G4, whose noise is *below* its published function at ISO 100, weak denoising inside the camera, which
  correlates neighbours of one colour. Its clean signal is what the denoising makes of the scene.

Codes are 10 bit. Shares and shapes are set per camera within the measured ranges, and named below.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int32, Key, UInt16

from cannoise_jax.physics.core.presets import by_iso, read_table
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.synthetic.scenes import PATCH, SPLITS, Split, draw_scenes, mosaic, numpy_generator
from cannoise_jax.recordings.packing import pack
from cannoise_jax.recordings.recording import BadInput


class Nlf(NamedTuple):
    """A noise level function, var = shot * clean + read, in normalised units."""

    shot: float
    read: float


@dataclass(frozen=True, eq=False)
class VirtualCamera:
    """A camera with a published noise level function and a true noise that is not quite it.

    published: by ISO, as handed on. sensor: the whole truth.
    """

    name: str
    cfa: str
    published: dict[int, Nlf]
    sensor: SensorModel

    @property
    def isos(self) -> tuple[int, ...]:
        """The ISO settings it records at."""
        return tuple(self.published)

    @property
    def denoises(self) -> bool:
        """Whether it averages neighbours, so that its clean signal is a blend of the scene."""
        return any(fitted.mechanism == "in_camera_denoising" for fitted in self.sensor.mechanisms)

    @property
    def black_level(self) -> float:
        """Black level, DN."""
        return float(np.asarray(self.sensor.black_level)[0])

    @property
    def white_level(self) -> float:
        """White level, DN; the code step is 1 DN."""
        return float(self.sensor.white_level)


class VirtualPatches(NamedTuple):
    """Pairs of patches of several cameras, packed R, Gr, Gb, B, normalised units; not clipped at black.

    shot, read: the *published* noise level function. camera: index into `virtual_cameras()`. scene: one
    number per scene, never shared between splits.
    """

    clean: Float[np.ndarray, "n h w 4"]
    noisy: Float[np.ndarray, "n h w 4"]
    shot: Float[np.ndarray, "n 4"]
    read: Float[np.ndarray, "n 4"]
    camera: Int32[np.ndarray, "n"]
    iso: Int32[np.ndarray, "n"]
    scene: Int32[np.ndarray, "n"]


@functools.cache
def virtual_cameras(ratio: float | None = None) -> tuple[VirtualCamera, ...]:
    """The five virtual cameras IP, GP, S6, N6 and G4, in the order of the camera index.

    ratio: of the true over the published standard deviation, in place of the measured ones.
    """
    camera = functools.partial(_camera, ratio=ratio)
    return (
        camera("IP", "RGGB", 64, unit=0, row=0.16, tail=0.10, offset=0.2),
        camera("GP", "BGGR", 64, unit=1, row=0.12, tail=-0.03, offset=0.15),
        camera("S6", "GRBG", 0, unit=2, row=0.14, tail=-0.09, offset=0.45),
        camera("N6", "BGGR", 64, unit=3, pink_row=0.16, tail=-0.20, offset=0.15),
        camera("G4", "BGGR", 64, unit=4, row=0.09, tail=0.05, offset=0.35, denoising=0.15),
    )


def record(
    camera: VirtualCamera, key: Key[Array, ""], clean: Float[np.ndarray, "h w"], iso: int, frames: int = 1
) -> tuple[UInt16[np.ndarray, "t h w"], Float[np.ndarray, "h w"]]:
    """Frames (DN) of a clean mosaic, and the noise-free signal they are about (normalised).

    That signal is `clean` itself unless the camera denoises, which it does to the scene as well.
    Raises BadInput for an ISO that the camera has not.
    """
    if iso not in camera.published:
        raise BadInput(f"{camera.name}: no ISO {iso}, use one of {', '.join(map(str, camera.isos))}")
    taken = camera.sensor.sample(key, jnp.asarray(clean, jnp.float32), Settings(iso=iso, frames=frames))
    expected = _denoised(camera.sensor, jnp.asarray(clean)) if camera.denoises else clean
    return np.asarray(taken), np.asarray(expected, np.float32)


def virtual_patches(
    key: Key[Array, ""],
    split: Split = "train",
    scenes: int = 48,
    per_scene: int = 16,
    cameras: tuple[VirtualCamera, ...] | None = None,
    patch: int = PATCH,
) -> VirtualPatches:
    """Patches of `scenes` scenes, each taken once by every camera at an ISO that goes through its list.

    From every frame `per_scene` patches are cut on a grid: `len(cameras) * scenes * per_scene` in all,
    ordered by camera, then scene. The same key gives the same patches; splits share no scene and no draw.
    Raises ValueError for an unknown split or a `per_scene` that is no square number.
    """
    cameras = cameras or virtual_cameras()
    side = math.isqrt(per_scene)
    if side * side != per_scene:
        raise ValueError(f"per_scene must be a square number, got {per_scene}")
    if split not in SPLITS:
        raise ValueError(f"unknown split {split!r}: use one of {', '.join(SPLITS)}")
    key = jax.random.fold_in(key, SPLITS.index(split))
    scene_key, noise_key, iso_key = jax.random.split(key, 3)
    pictures = draw_scenes(scene_key, split, scenes, (2 * patch * side, 2 * patch * side))
    start = int(numpy_generator(iso_key).integers(1 << 16))
    parts = []
    for c, camera in enumerate(cameras):
        for s, scene in enumerate(pictures):
            iso = camera.isos[(start + c + s) % len(camera.isos)]
            draw = jax.random.fold_in(jax.random.fold_in(noise_key, c), s)
            taken, expected = record(camera, draw, mosaic(scene.image, camera.cfa), iso)
            span = camera.white_level - camera.black_level
            noisy = (taken[0].astype(np.float32) - camera.black_level) / np.float32(span)
            number = s * len(SPLITS) + SPLITS.index(split)
            parts.append(_patches(camera, c, iso, number, clean=expected, noisy=noisy, side=side))
    return VirtualPatches(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _camera(
    name: str,
    cfa: str,
    black: float,
    *,
    unit: int,
    tail: float,
    offset: float,
    row: float = 0.0,
    pink_row: float = 0.0,
    denoising: float = 0.0,
    ratio: float | None = None,
) -> VirtualCamera:
    """A camera of the table. row, pink_row, offset: rms in units of the read noise; tail: Tukey-lambda shape;
    unit: the camera unit, from which its black-level errors are drawn; ratio: see `virtual_cameras`."""
    tables, white = read_table("phones"), 1023.0
    published = {int(iso): Nlf(*value) for iso, value in tables["published"][name].items()}
    # White noise that passes the blend keeps this share of its variance.
    kept = (1 - denoising) ** 2 + denoising**2 / 4
    true = {iso: _true_nlf(tables, name, iso, nlf, kept, ratio) for iso, nlf in published.items()}
    isos = tuple(float(iso) for iso in true)
    read_dn = np.sqrt([nlf.read for nlf in true.values()]) * (white - black)
    sensor = SensorModel.from_nlf(
        np.array([[nlf.shot] for nlf in true.values()]),
        np.array([[nlf.read] for nlf in true.values()]),
        black,
        white,
        cfa,
        iso=isos,
        camera=name,
        unit_key=jax.random.key(unit),
    ).with_mechanism("heavy_tails", tukey_lambda=tail)
    for id, share in (("row_noise", row), ("row_pink_noise", pink_row), ("channel_offset", offset)):
        if share:
            sensor = sensor.with_mechanism(id, sigma_dn=by_iso(isos, share * read_dn))
    if denoising:
        sensor = sensor.with_mechanism("in_camera_denoising", weight=denoising)
    return VirtualCamera(name, cfa, published, sensor)


def _true_nlf(
    tables: dict, name: str, iso: int, published: Nlf, kept: float, ratio: float | None = None
) -> Nlf:
    """The published function times the ratio; without one, re-calibrated values where there are any, else it
    times the measured ratio."""
    if ratio is None:
        if name in tables["recalibrated"]:
            return Nlf(*tables["recalibrated"][name][str(iso)])
        known = tables["sigma_ratio"][name]
        at = np.log([float(i) for i in known])
        # Two learned models were measured: their geometric mean, linear in log ISO in between.
        ratio = float(np.exp(np.interp(math.log(iso), at, np.log(list(known.values())).mean(axis=1))))
    return Nlf(published.shot * ratio**2 / kept, published.read * ratio**2 / kept)


@jax.jit
def _denoised(sensor: SensorModel, clean: Float[Array, "h w"]) -> Float[Array, "h w"]:
    """What the camera's denoising makes of a noise-free mosaic (normalised): its closed form alone."""
    kept = tuple(f for f in sensor.mechanisms if f.mechanism == "in_camera_denoising")
    alone = dataclasses.replace(sensor, mechanisms=kept)
    black = jnp.asarray(sensor.black_level)[0]
    return (alone.expected(clean) - black) / (sensor.white_level - black)


def _patches(camera: VirtualCamera, index: int, iso: int, scene: int, *, clean, noisy, side: int):
    def cut(image):
        packed = pack(image, camera.cfa)
        size = packed.shape[0] // side
        grid = packed.reshape(side, size, side, size, 4).swapaxes(1, 2)
        return grid.reshape(side * side, size, size, 4)

    count = side * side
    nlf = camera.published[iso]
    return (
        cut(clean),
        cut(noisy),
        np.full((count, 4), nlf.shot, np.float32),
        np.full((count, 4), nlf.read, np.float32),
        np.full(count, index, np.int32),
        np.full(count, iso, np.int32),
        np.full(count, scene, np.int32),
    )


def camera_of_level(shot: float, read_e: float, black: float = 256.0, white: float = 4095.0) -> VirtualCamera:
    """A camera of one ISO, heavy tails in its read noise. shot: normalised; read_e: e-; black, white: DN."""
    read = (shot * read_e) ** 2
    sensor = SensorModel.from_nlf(shot, read, black, white).with_mechanism("heavy_tails", tukey_lambda=-0.1)
    return VirtualCamera(f"shot {shot:g}, read {read_e:g} e-", "RGGB", {100: Nlf(shot, read)}, sensor)
