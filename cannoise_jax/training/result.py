"""What a run leaves behind: a model to sample from, and how it compares with the baselines on test scenes."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import jax
from ml_collections import ConfigDict

from cannoise_jax.evaluation.compare import evaluate_model
from cannoise_jax.sampling import MODEL_FILE, Model, Samplers, make_model, sample_noise, samplers, save_model
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
    """`sample_noise` itself on batches with references of their own, as `evaluation` takes it:
    (key, clean, reference, shot, read) -> noise; compiled as `config.compiler` says."""

    @partial(jax.jit, compiler_options=compiler_options(config))
    def sample(model, key, clean, reference, nlf):
        def one(key, clean, reference, nlf):
            return sample_noise(model, key, clean, reference, nlf)

        return jax.vmap(one)(jax.random.split(key, clean.shape[0]), clean, reference, nlf)

    return samplers(model.level, partial(sample, model))


def compare(sampler: Samplers, config: ConfigDict, data: TrainingData) -> dict[str, Any]:
    """Every noise model on the test scenes, unseen until now. sampler: `samplers_of` gives it."""
    return evaluate_model(
        sampler.usual,
        data.test,
        data.cameras,
        jax.random.key(config.seed),
        recalibrated=data.recalibrated,
        batch=16,
        references=config.references,
        given=sampler.given,
    )
