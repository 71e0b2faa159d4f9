"""What a run leaves behind: a model to sample from, and how it compares with the baselines on test scenes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from ml_collections import ConfigDict

from cannoise_jax.evaluation.compare import evaluate_model
from cannoise_jax.evaluation.samplers import Samplers, by_latents, samplers
from cannoise_jax.model_file import MODEL_FILE, save_model
from cannoise_jax.sampling import Model, common_latent, latents_of, make_model, noise_at, of_camera
from cannoise_jax.training.compiler import compiler_options
from cannoise_jax.training.data import TrainingData
from cannoise_jax.training.state import State, make_networks


def export_model(config: ConfigDict, state: State, data: TrainingData) -> Model:
    """The averaged generator and encoder with the cameras' references, as `sample_noise` takes them."""
    networks = make_networks(config)
    return make_model(
        networks.generator,
        {"params": state.average["generator"], "spectral": state.generator["spectral"]},
        networks.encoder,
        {"params": state.average["encoder"], "spectral": state.encoder["spectral"]},
        data.examples,
        config.initial_noise,
        config.level,
        config.exposure_s,
    )


def write_model(config: ConfigDict, state: State, data: TrainingData, workdir: Path) -> Model:
    """`export_model` into the workdir, where `load_model` looks for it. Raises BadInput for a full disk.

    A model whose initial noise is a function of the caller's is not written: files hold names only.
    """
    model = export_model(config, state, data)
    if isinstance(config.initial_noise, str):
        save_model(workdir / MODEL_FILE, model)
    return model


def samplers_of(model: Model, config: ConfigDict) -> Samplers:
    """What `sample_noise` gives on batches with references of their own, as `evaluation` takes it:
    (key, clean, reference, shot, read) -> noise; compiled as `config.compiler` says. A model with a sensor
    for each camera is told the camera."""
    options = compiler_options(config)
    encode = jax.jit(latents_of, compiler_options=options)

    @partial(jax.jit, compiler_options=options)
    def draw(model, key, clean, latent, level):
        def one(key, clean, latent, level):
            return noise_at(model, key, *jax.tree.map(lambda v: v[None], (clean, latent, level)))[0]

        return jax.vmap(one)(jax.random.split(key, clean.shape[0]), clean, latent, level)

    def of_all(key, clean, latents, level):
        return draw(model, key, clean, common_latent(model, latents), level)

    def of_its_camera(key, clean, latents, level, camera):
        latent = common_latent(model, latents)
        own = [of_camera(model, sensor.camera) for sensor in model.sensors]
        made = [np.asarray(draw(m, key, clean, latent, level)) for m in own]
        return np.stack(made)[camera, np.arange(len(camera))]

    several = len(model.sensors) > 1
    sample = by_latents(partial(encode, model), of_its_camera if several else of_all)
    return samplers(model.level, sample, by_camera=several)


def compare(
    sampler: Samplers,
    config: ConfigDict,
    data: TrainingData,
    tell: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Every noise model on the test scenes, unseen until now. sampler: `samplers_of` gives it. tell: how far
    it is, see `evaluate_model`."""
    return evaluate_model(
        sampler.usual,
        data.test,
        data.cameras,
        jax.random.key(config.seed),
        recalibrated=data.recalibrated,
        batch=16,
        references=config.references,
        given=sampler.given,
        tell=tell,
    )
