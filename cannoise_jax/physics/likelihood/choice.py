"""The score of frames under a camera model, by the function that its mechanisms call for.

The weakest likelihood among the mechanisms decides:
- "exact": pixels are independent once the frozen maps are known. What mechanisms do to the mean, to gain,
  read noise, black level, code step and rails is put into the pixel likelihood of `likelihood_shot`.
- "approximate": offsets that rows, columns or frames share are integrated, one white term by quadrature
  (`likelihood_shared`), several or pink ones by Laplace's approximation (`likelihood_crossed`); heavy tails
  by `likelihood_tails`; of the others the closed form of mean and variance is used. That of `reference_error`
  is within 3e-4 nats per pixel of a frame's exact one from 80 electrons on (at 8 electrons 0.003 where its
  sigma is a third of the signal); that frames of one recording share the error is not used, which loses
  ln(1 + r) / 2 - ln(1 + T r) / (2 T) nats per pixel and frame, r its variance over that of the noise: 0.011
  for T = 8 and r = 0.1.
- "none": the composite score of `likelihood_composite`, learned from frames that the model simulates.

A lattice of codes coarser than the model's is said in a `CodeStepWarning`.
Scores of different kinds cannot be compared. `compare` judges two models by the kind that serves both.
"""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Iterable
from typing import NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.core.chain import altered_noise
from cannoise_jax.physics.core.mechanism import Likelihood
from cannoise_jax.physics.core.registry import mechanism
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.core.settings import context_of, resolve
from cannoise_jax.physics.likelihood.composite import Ruler, composite_score, profile, ruler
from cannoise_jax.physics.likelihood.model import frame_log_prob, pixel_law
from cannoise_jax.recordings.codes import detect_code_step

_ORDER: tuple[Likelihood, ...] = get_args(Likelihood)
_SIMULATED = 4  # frames simulated for the composite score, per frame scored


class CodeStepWarning(UserWarning):
    """Frames are on a coarser lattice of codes than the model that scores them."""


class Score(NamedTuple):
    """Nats per pixel, larger is better, and per frame `[T]`. kind: how it was found."""

    kind: Likelihood
    total: float
    per_frame: Float[np.ndarray, "t"]


def likelihood_of(ids: Iterable[str]) -> Likelihood:
    """The weakest likelihood among mechanisms; "exact" without any. Raises ValueError for unknown ids."""
    return _weakest(mechanism(id).likelihood for id in ids)


def likelihood_of_model(model: SensorModel) -> Likelihood:
    """The weakest likelihood among the mechanisms of a model, those without a name included."""
    return _weakest(fitted.record.likelihood for fitted in model.mechanisms)


def _weakest(kinds: Iterable[Likelihood]) -> Likelihood:
    return max(kinds, key=_ORDER.index, default="exact")


def score(
    model: SensorModel,
    frames: Float[np.ndarray, "t h w"],
    clean: Float[np.ndarray, "h w"],
    settings: Settings,
    key: jax.Array,
    *,
    kind: Likelihood | None = None,
    by: Ruler | None = None,
) -> Score:
    """Score of frames, DN, of a clean mosaic (normalised) under a model.

    kind: a weaker one than the model has, to compare it with a model that has no better.
    key, by: for the composite score: of the simulated frames, and what is compared; default: residuals of the
      model's baseline, which are the same whatever mechanisms it has.
    Warns with a `CodeStepWarning` where the codes lie on a coarser lattice than the model's.
    Raises ValueError for a kind that is stronger than the model allows.
    """
    _check_step((model,), frames, clean, settings)
    return _score(model, frames, clean, settings, key, kind, by)


def _score(model, frames, clean, settings, key, kind, by) -> Score:
    own = likelihood_of_model(model)
    kind = own if kind is None else kind
    if _ORDER.index(kind) < _ORDER.index(own):
        raise ValueError(f"{model.camera}: its likelihood is {own}, it cannot be scored as {kind}")
    frames = np.asarray(frames, np.float32)
    if kind == "none":
        by = _baseline_ruler(model, clean, settings) if by is None else by
        taken = dataclasses.replace(settings, frames=_SIMULATED * len(frames))
        simulated = np.asarray(model.sample(key, np.asarray(clean, np.float32), taken))
        found = composite_score(profile(simulated, by), frames, by)
        return Score(kind, found.total, found.per_frame)
    per_frame = np.asarray(frame_log_prob(model, frames, clean, settings), np.float64) / frames[0].size
    return Score(kind, float(per_frame.mean()), per_frame)


def compare(
    before: SensorModel,
    after: SensorModel,
    frames: Float[np.ndarray, "t h w"],
    clean: Float[np.ndarray, "h w"],
    settings: Settings,
    key: jax.Array,
) -> tuple[Score, Score]:
    """Scores of two models of one camera by the one kind, and the one ruler, that serve both."""
    _check_step((before, after), frames, clean, settings)
    kind = _weakest((likelihood_of_model(before), likelihood_of_model(after)))
    by = _baseline_ruler(before, clean, settings) if kind == "none" else None
    return (
        _score(before, frames, clean, settings, key, kind, by),
        _score(after, frames, clean, settings, key, kind, by),
    )


def _check_step(models: tuple[SensorModel, ...], frames, clean, settings: Settings) -> None:
    """One `CodeStepWarning` where every model has finer codes than the frames."""
    codes = np.asarray(frames)
    if not ((codes >= 0) & (codes < 65536) & (codes == np.floor(codes))).all():
        return  # processed values, on no lattice that can be detected
    found = detect_code_step(codes.astype(np.uint16))
    own = max(_step_of(model, clean, settings) for model in models)
    if found > 1.5 * own:
        warnings.warn(
            f"{models[0].camera}: the codes are {found:g} DN apart, the model's {own:g}: its log-likelihood "
            f"is too low by up to {math.log(found / own):.2f} nats per pixel; use code_step={found:g}",
            CodeStepWarning,
            stacklevel=3,
        )


def _step_of(model: SensorModel, clean, settings: Settings) -> float:
    context = context_of(model, jnp.asarray(clean, jnp.float32)[None], settings)
    return max(float(np.mean(altered_noise(model, context, resolve(model, context)).code_step)), 1.0)


def _baseline_ruler(model: SensorModel, clean: Float[np.ndarray, "h w"], settings: Settings) -> Ruler:
    law = pixel_law(dataclasses.replace(model, mechanisms=()), clean, settings)
    step = max(float(np.asarray(model.code_step)), 1.0)
    sigma = np.sqrt(np.asarray(law.variance, np.float64) + step**2 / 12)
    return ruler(np.asarray(law.mean, np.float64), sigma, step)
