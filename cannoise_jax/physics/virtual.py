"""Five virtual cameras: recordings with known truth, from a key, for training and tests without a download.

They carry the names, colour patterns and ISO settings of the five phones of SIDD. What is handed on as the
noise level function is the published one; the noise itself follows measured numbers that disagree with it, as
the noise of the real phones does:

- shot and read noise: the re-calibrated values for IP, S6 and GP; for N6 and G4 the published function times
  the ratio of standard deviations measured on two learned models (see `tables/phones.json`);
- row noise of 0.09 to 0.16 of the read noise, as measured on a Sony A7S2; on N6 it is 1/f from row to row;
- read noise with Tukey-lambda tails, shapes -0.2 to +0.1 as measured on the cameras of ELD and PMN;
- black-level errors per colour channel of a fraction of the read noise, as in the tables of ELD;
- on G4, whose noise is *below* its published function at ISO 100, weak denoising inside the camera, which
  correlates neighbours of one colour. Its clean signal is what the denoising makes of the scene.

Codes are 10 bit. Shares and shapes are set per camera within the measured ranges, and named below.
"""

from __future__ import annotations

import functools
import json
import math
from dataclasses import dataclass
from importlib import resources
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int32, Key, UInt16

from cannoise_jax.physics.poisson_gaussian import sample_normal, sample_poisson, uniform_open
from cannoise_jax.physics.scenes import SPLITS, Scene, Split, draw_scenes, mosaic, numpy_generator
from cannoise_jax.recordings.packing import pack, to_mosaic_order
from cannoise_jax.recordings.recording import CaptureSet, Recording, mosaic_map, per_channel

PATCH = 64
"""Side of a training patch in packed pixels; 128 on the mosaic."""


class Nlf(NamedTuple):
    """A noise level function, var = shot * clean + read, in normalised units."""

    shot: float
    read: float


class TrueNoise(NamedTuple):
    """What a virtual camera really does. Additive parts are in units of the read noise.

    nlf: its true shot and read noise. row: rms of the row noise. row_exponent: 0: white, 1: 1/f.
    tail: shape of the Tukey-lambda read noise (0.14 is near Gaussian, negative is heavy).
    offset: black-level error of R, Gr, Gb, B. denoising: weight of the four same-colour neighbours.
    """

    nlf: Nlf
    row: float
    row_exponent: float
    tail: float
    offset: tuple[float, float, float, float]
    denoising: float


@dataclass(frozen=True)
class VirtualCamera:
    """A camera with a published noise level function and a true noise that is not quite it.

    published, true: by ISO, same keys. black_level, white_level: DN; the code step is 1 DN.
    """

    name: str
    cfa: str
    black_level: float
    white_level: float
    published: dict[int, Nlf]
    true: dict[int, TrueNoise]

    @property
    def isos(self) -> tuple[int, ...]:
        """The ISO settings it records at."""
        return tuple(self.published)


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
def virtual_cameras() -> tuple[VirtualCamera, ...]:
    """The five virtual cameras IP, GP, S6, N6 and G4, in the order of the camera index."""
    return (
        _camera("IP", "RGGB", 64, row=0.16, tail=0.10, offset=(0.3, 0.1, 0.1, -0.2)),
        _camera("GP", "BGGR", 64, row=0.12, tail=-0.03, offset=(-0.1, 0.1, 0.1, 0.2)),
        _camera("S6", "GRBG", 0, row=0.14, tail=-0.09, offset=(0.6, 0.3, 0.4, 0.5)),
        _camera("N6", "BGGR", 64, row=0.16, row_exponent=1.0, tail=-0.20, offset=(0.1, -0.1, 0.0, 0.2)),
        _camera("G4", "BGGR", 64, row=0.09, tail=0.05, offset=(-0.4, -0.2, -0.3, -0.5), denoising=0.15),
    )


def record(
    camera: VirtualCamera, key: Key[Array, ""], clean: Float[Array, "t h w"], iso: int
) -> tuple[UInt16[np.ndarray, "t h w"], Float[np.ndarray, "t h w"]]:
    """Frames (DN) of `clean` mosaics, and the noise-free signal they are about (normalised).

    That signal is `clean` itself unless the camera denoises, which it does to the scene as well.
    Raises KeyError for an ISO that the camera has not.
    """
    true = camera.true[iso]
    offset = mosaic_map(
        per_channel(to_mosaic_order(np.array(true.offset), camera.cfa)), (clean.shape[1], clean.shape[2])
    )
    frames, expected = _record(
        key,
        jnp.asarray(clean, jnp.float32),
        jnp.array([*true.nlf, true.row, true.row_exponent, true.tail, true.denoising]),
        jnp.asarray(offset),
        camera.black_level,
        camera.white_level,
    )
    return np.asarray(frames), np.asarray(expected)


def virtual_capture_set(
    camera: VirtualCamera,
    key: Key[Array, ""],
    scenes: tuple[Scene, ...],
    isos: tuple[int, ...] | None = None,
    frames: int = 1,
) -> CaptureSet:
    """Every scene recorded at every ISO, `frames` frames each, with the published noise level function."""
    recordings = []
    for s, scene in enumerate(scenes):
        clean = mosaic(scene.image, camera.cfa)
        for iso in isos or camera.isos:
            draw = jax.random.fold_in(jax.random.fold_in(key, s), iso)
            taken, expected = record(camera, draw, jnp.stack([clean] * frames), iso)
            recordings.append(_recording(camera, iso, taken, expected[0]))
    return CaptureSet(camera.name, tuple(recordings))


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
        isos = [camera.isos[(start + c + s) % len(camera.isos)] for s in range(scenes)]
        for s, (scene, iso) in enumerate(zip(pictures, isos, strict=True)):
            draw = jax.random.fold_in(jax.random.fold_in(noise_key, c), s)
            clean = jnp.asarray(mosaic(scene.image, camera.cfa))[None]
            taken, expected = record(camera, draw, clean, iso)
            span = camera.white_level - camera.black_level
            noisy = (taken[0].astype(np.float32) - camera.black_level) / np.float32(span)
            number = s * len(SPLITS) + SPLITS.index(split)
            parts.append(_patches(camera, c, iso, number, expected[0], noisy, side))
    return VirtualPatches(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


@jax.jit
def _record(key, clean, parameters, offset, black, white):
    shot, read, row, exponent, tail, denoising = parameters
    count, height, width = clean.shape
    charge_key, read_key, row_key, round_key = jax.random.split(key, 4)
    span = white - black
    sigma = jnp.sqrt(read)
    signal = shot * sample_poisson(charge_key, clean / shot)
    floor = tukey_lambda(read_key, clean.shape, tail)
    rows = coloured_rows(row_key, (count, height), exponent)[..., None]
    noisy = signal + sigma * (floor + row * rows + offset)
    blend = functools.partial(same_colour_blend, weight=denoising)
    dn = black + span * blend(noisy)
    codes = jnp.clip(jnp.round(dn), 0, white).astype(jnp.uint16)
    return codes, blend(clean)


def tukey_lambda(key: Key[Array, ""], shape: tuple[int, ...], shape_parameter) -> Float[Array, "..."]:
    """Numbers of a symmetric Tukey-lambda distribution, scaled to variance one; shape > -0.5 and not 0."""
    lam = jnp.asarray(shape_parameter, jnp.float32)
    u = uniform_open(key, shape)
    gamma = jax.scipy.special.gammaln
    variance = 2 / lam**2 * (1 / (1 + 2 * lam) - jnp.exp(2 * gamma(1 + lam) - gamma(2 + 2 * lam)))
    return (u**lam - (1 - u) ** lam) / lam / jnp.sqrt(variance)


def coloured_rows(key: Key[Array, ""], shape: tuple[int, int], exponent) -> Float[Array, "t h"]:
    """One number per row, spectrum 1/f^exponent from row to row, unit variance, mean zero unless white."""
    white = sample_normal(key, shape)
    frequency = jnp.arange(shape[1] // 2 + 1, dtype=jnp.float32)
    gain = jnp.where(frequency > 0, jnp.maximum(frequency, 1.0) ** (-exponent / 2), exponent == 0)
    power = (2 * jnp.sum(gain**2) - gain[0] ** 2 - gain[-1] ** 2) / shape[1]
    shaped = jnp.fft.irfft(jnp.fft.rfft(white, axis=1) * gain, n=shape[1], axis=1)
    return shaped / jnp.sqrt(power)


def same_colour_blend(image: Float[Array, "t h w"], weight) -> Float[Array, "t h w"]:
    """Each pixel blended with the mean of its four nearest neighbours of its colour; mirrored borders."""
    padded = jnp.pad(image, ((0, 0), (2, 2), (2, 2)), mode="reflect")
    centre = padded[:, 2:-2, 2:-2]
    around = padded[:, :-4, 2:-2] + padded[:, 4:, 2:-2] + padded[:, 2:-2, :-4] + padded[:, 2:-2, 4:]
    return (1 - weight) * centre + weight * around / 4


def _camera(name, cfa, black, row, tail, offset, row_exponent=0.0, denoising=0.0) -> VirtualCamera:
    tables = _phones()
    published = {int(iso): Nlf(*value) for iso, value in tables["published"][name].items() if iso != "source"}
    # White noise that passes the blend keeps this share of its variance.
    kept = (1 - denoising) ** 2 + denoising**2 / 4
    true = {
        iso: TrueNoise(_true_nlf(tables, name, iso, nlf, kept), row, row_exponent, tail, offset, denoising)
        for iso, nlf in published.items()
    }
    return VirtualCamera(name, cfa, float(black), 1023.0, published, true)


def _true_nlf(tables: dict, name: str, iso: int, published: Nlf, kept: float) -> Nlf:
    """Re-calibrated values where there are any, else the published function times the measured ratio."""
    if name in tables["recalibrated"]:
        return Nlf(*tables["recalibrated"][name][str(iso)])
    known = tables["sigma_ratio"][name]
    at = np.log([float(i) for i in known])
    # Two learned models were measured: their geometric mean, linear in log ISO in between.
    ratio = float(np.exp(np.interp(math.log(iso), at, np.log(list(known.values())).mean(axis=1))))
    return Nlf(published.shot * ratio**2 / kept, published.read * ratio**2 / kept)


@functools.cache
def _phones() -> dict:
    text = (resources.files("cannoise_jax.physics") / "tables" / "phones.json").read_text()
    return json.loads(text)


def _recording(camera: VirtualCamera, iso: int, frames, clean) -> Recording:
    nlf = camera.published[iso]
    return Recording(
        frames=frames,
        cfa=camera.cfa,
        black_level=per_channel(camera.black_level),
        white_level=camera.white_level,
        camera=camera.name,
        clean=clean,
        iso=float(iso),
        shot=per_channel(nlf.shot),
        read=per_channel(nlf.read),
        code_step=1.0,
        reference="independent",
    )


def _patches(camera: VirtualCamera, index: int, iso: int, scene: int, clean, noisy, side: int):
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
