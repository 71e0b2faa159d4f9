"""Model files: a model of `sample_noise` as plain arrays with a description in JSON; nothing is unpickled."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax.errors import FlaxError
from flax.traverse_util import flatten_dict, unflatten_dict

from cannoise_jax.networks import Encoder, Generator
from cannoise_jax.networks.encoder import mean_latent
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.core.sensor_entries import model_of
from cannoise_jax.physics.core.sensor_json import sensor_document
from cannoise_jax.recordings.described import read_described, write_described
from cannoise_jax.recordings.opened import BROKEN_ARRAYS
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.sampling import Camera, Model, Setting

MODEL_FILE = "model.npz"
_FORMAT = "cannoise/model/4"
_OLDER = ("cannoise/model/1", "cannoise/model/2", "cannoise/model/3")
_CHECKED = 64
"""Side of the image by which shapes are checked: the U-Net halves it five times."""


def save_model(path: str | Path, model: Model) -> None:
    """Writes a model as one file of plain arrays with a description in JSON, complete or not at all.

    Raises ValueError for an initial noise that is a function: a file holds names only. Raises BadInput when
    the file cannot be written.
    """
    if not isinstance(model.initial_noise, str):
        raise ValueError("initial noise that is a function cannot be saved: build the model with make_model")
    description = {
        "format": _FORMAT,
        "generator": _fields(model.generator_module),
        "encoder": _fields(model.encoder_module) if model.encoder_module else None,
        "initial_noise": model.initial_noise,
        "level": model.level,
        "exposure_s": model.exposure_s,
        "cameras": {name: sorted(camera.settings, key=float) for name, camera in model.cameras.items()},
    }
    arrays: dict[str, Any] = {}
    description["sensors"] = [sensor_document(sensor) for sensor in model.sensors]
    for s, sensor in enumerate(model.sensors):
        for i, fitted in enumerate(sensor.mechanisms):
            for name, values in fitted.maps.items():
                arrays[f"sensors/{s}/{i}/{name}"] = np.asarray(values)
    for part in ("generator", "encoder"):
        for name, leaf in flatten_dict(getattr(model, part), sep="/").items():
            arrays[f"{part}/{name}"] = np.asarray(leaf)
    for i, (name, isos) in enumerate(description["cameras"].items()):
        arrays[f"cameras/{i}/reference"] = np.asarray(model.cameras[name].reference, np.float32)
        for j, iso in enumerate(isos):
            setting = model.cameras[name].settings[iso]
            arrays[f"cameras/{i}/{j}"] = np.stack([np.asarray(setting.shot), np.asarray(setting.read)])
    write_described(path, description, arrays)


def load_model(workdir: str | Path) -> Model:
    """The model of a training folder, or of a file that `save_model` wrote.

    Raises BadInput when there is none or it cannot be read; nothing is unpickled.
    """
    if not isinstance(workdir, str | Path):
        raise BadInput(f"workdir is {workdir!r}: name the folder of a trained model, or its file")
    path = Path(workdir)
    if path.is_dir():
        path = path / MODEL_FILE
    if not path.is_file():
        raise BadInput(f"{path}: no such file: train a model first, or name the folder of a trained one")
    try:
        found = read_described(path)
        _refuse_older(path, found.description["format"])
        model = _model(found.description, found.arrays)
        if not found.sealed:
            _check_shapes(model)
        return model
    except BadInput:
        raise
    except (*BROKEN_ARRAYS, KeyError, TypeError, AttributeError, RecursionError, FlaxError) as error:
        raise BadInput(f"{path}: not a readable model: train it again or name another") from error


def _check_shapes(model: Model) -> None:
    """Raises ValueError where the variables are not those that the networks have."""
    image = jax.ShapeDtypeStruct((1, _CHECKED, _CHECKED, 4), jnp.float32)
    key = jax.eval_shape(lambda: jax.random.key(0))
    module, encoder = model.generator_module, model.encoder_module
    latent = jax.ShapeDtypeStruct((1, 1), jnp.float32)
    if encoder is not None:
        told = jax.eval_shape(lambda v, i: encoder.apply(v, i, train=False), model.encoder, image)
        latent = jax.eval_shape(lambda latents: mean_latent(encoder, latents)[None], told)
    jax.eval_shape(
        lambda v, k, i, z: module.apply(v, i, i, z, i, train=False, rngs={"noise": k}),
        *(model.generator, key, image, latent),
    )
    for camera in model.cameras.values():
        if any(np.min(np.asarray(v)) < 0 for s in camera.settings.values() for v in (s.shot, s.read)):
            raise ValueError("noise levels below 0")


def _refuse_older(path: Path, found: str) -> None:
    if found in _OLDER:
        raise BadInput(
            f"{path}: a model of an older version, whose networks look at other numbers: train it again"
        )
    if found != _FORMAT:
        raise ValueError(found)


def _model(description, arrays):
    parts: dict[str, dict[str, Any]] = {"generator": {}, "encoder": {}}
    for name, value in arrays.items():
        part, _, rest = name.partition("/")
        if part in parts:
            parts[part][rest] = jnp.asarray(value)
    cameras = {
        name: Camera(
            jnp.asarray(arrays[f"cameras/{i}/reference"]),
            {iso: Setting(*map(jnp.asarray, arrays[f"cameras/{i}/{j}"])) for j, iso in enumerate(isos)},
        )
        for i, (name, isos) in enumerate(description["cameras"].items())
    }
    return Model(
        unflatten_dict(parts["generator"], sep="/"),
        unflatten_dict(parts["encoder"], sep="/"),
        cameras,
        Generator(**description["generator"]),
        Encoder(**description["encoder"]) if description["encoder"] else None,
        description["initial_noise"],
        description["level"],
        tuple(_sensor(d, arrays, f"sensors/{s}/") for s, d in enumerate(description.get("sensors", ()))),
        description.get("exposure_s"),
    )


def _sensor(document, arrays, prefix: str) -> SensorModel:
    """A camera model that a model file holds, with its maps."""
    maps = {n.removeprefix(prefix): v for n, v in arrays.items() if n.startswith(prefix)}
    return model_of(SensorModel.poisson_gaussian, document, maps)


def _fields(module):
    """All but its name and what it is worked out in: models are sampled in float32."""
    return {
        field.name: getattr(module, field.name)
        for field in dataclasses.fields(module)
        if field.name not in ("parent", "name", "dtype")
    }
