"""A generator that refines the noise of one camera's sensor model at one exposure, for denoisers.

Its initial noise is what was calibrated or discovered: read noise, rows, dark charge, hot pixels and frozen
patterns of the exposure. It learns from the training part of half-real data alone what that lacks. With one
camera and one setting there is nothing for references to tell: there is no encoder.
"""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from ml_collections import ConfigDict

from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.core.sensor_json import write_sensor
from cannoise_jax.physics.core.settings import black_at
from cannoise_jax.physics.robust import robust_std
from cannoise_jax.physics.synthetic.scenes import PATCH, Split
from cannoise_jax.recordings.packing import pack
from cannoise_jax.recordings.pipeline import ArrayPatches
from cannoise_jax.recordings.recording import mosaic_map
from cannoise_jax.sampling import Camera, Setting
from cannoise_jax.training.data import HeldOut, TrainingData
from cannoise_jax.training.denoise_data import HalfReal, dim_scenes, site_medians, with_photons
from cannoise_jax.training.recorded import tiles

_MULTIPLE = 32
_SCENES = {"train": 32, "validation": 4}


def span_of(sensor: SensorModel, iso: float) -> float:
    """DN of a sensor model from black to white at an ISO: its unit."""
    return float(np.asarray(sensor.white_level) - np.asarray(black_at(sensor, iso)).mean())


def own_black(data: HalfReal, sensor: SensorModel) -> np.ndarray:
    """Where a sensor model's darks of the exposure lie, DN, per mosaic site."""
    shape = data.train.shape[1:]
    settings = Settings(iso=iso_of(data, sensor), exposure_s=data.exposure_s, frames=4)
    darks = sensor.sample(jax.random.key(0), np.zeros(shape, np.float32), settings)
    return site_medians(np.asarray(darks, np.float32))


def iso_of(data: HalfReal, sensor: SensorModel) -> float:
    """The ISO of the recordings; the sensor's first where they state none."""
    return float(np.asarray(sensor.iso)[0]) if data.iso is None else data.iso


def refine_data(data: HalfReal, sensor: SensorModel) -> TrainingData:
    """Scenes with counted photons on the training darks, in the sensor's units and about its black level."""
    iso = iso_of(data, sensor)
    span = np.float32(span_of(sensor, iso))
    scale = np.float32(data.span_dn) / span
    shift = (own_black(data, sensor) - np.asarray(black_at(sensor, iso))) / span
    # Robust: the level stands for what most pixels have; the losses are in units of it.
    read = np.float32(np.square(np.median(robust_std(data.train, 0)) * scale))
    shot = np.float32(scale / data.full_scale_e)

    def part(split: Split) -> HeldOut:
        clean = dim_scenes(jax.random.key(5), split, _SCENES[split], data.train.shape[1:], data.cfa)
        cut = []
        for i, scene in enumerate(clean):
            lit = with_photons(jax.random.fold_in(jax.random.key(6), i), scene, data.full_scale_e)
            noisy = (lit + data.train[i % len(data.train)]) * scale + mosaic_map(shift, scene.shape)
            cut.append([_patches(pack(x.astype(np.float32), data.cfa)) for x in (scene * scale, noisy)])
        images, noisies = (np.concatenate(parts) for parts in zip(*cut, strict=True))
        count = len(images)
        return HeldOut(
            clean=images, noisy=noisies,
            shot=np.full((count, 4), shot, np.float32), read=np.full((count, 4), read, np.float32),
            camera=np.zeros(count, np.int32), iso=np.zeros(count, np.int32),
            scene=np.repeat(np.arange(len(clean), dtype=np.int32), count // len(clean)),
        )  # fmt: skip

    train, validation = part("train"), part("validation")
    names = (data.camera,)
    setting = Setting(jnp.asarray(train.shot[0]), jnp.asarray(train.read[0]))
    examples = {data.camera: Camera(jnp.asarray(train.noisy[:1]), {"0": setting})}
    source = ArrayPatches(
        train.clean, train.noisy, train.shot, train.read, train.camera, names, (data.cfa,), train.iso
    )
    levels = {(0, 0): (float(shot), float(read))}
    return TrainingData(source, validation, validation, names, levels, examples)


def refine_config(config: ConfigDict, sensor: Path, exposure_s: float, steps: int, seed: int) -> ConfigDict:
    """The default config as a generator needs it that starts from a sensor model."""
    config.update(
        {
            "seed": seed, "steps": steps, "encoder": False, "level": "given", "clip": False, "references": 1,
            "reference": config.patch,
            "initial_noise": f"sensor:{sensor}", "exposure_s": exposure_s, "evaluate_every": steps,
            "checkpoint_every": steps, "validation_patches": 16,
        }
    )  # fmt: skip
    config.loss.update({"triplet": 0.0, "physics": 0.0, "knee": 4.0})
    config.optimiser.update({"warmup": min(config.optimiser.warmup, steps // 4)})
    return config


def write_unit(path: Path, sensor: SensorModel, size: tuple[int, int]) -> SensorModel:
    """The sensor with its frozen patterns drawn once where none were measured, as a file. Raises BadInput."""
    unit = sensor.with_maps(size)
    write_sensor(path, unit)
    return unit


def _patches(packed: np.ndarray) -> np.ndarray:
    """Patches on a grid; of an image smaller than a patch what there is that the networks take."""
    height, width = (min(PATCH, n // _MULTIPLE * _MULTIPLE) for n in packed.shape[:2])
    return tiles(packed, height, width)
