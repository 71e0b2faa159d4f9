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

Scores of different kinds cannot be compared. `compare` judges two models by the kind that serves both.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import NamedTuple, get_args

import jax
import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.likelihood_composite import Ruler, composite_score, profile, ruler
from cannoise_jax.physics.likelihood_model import frame_log_prob, pixel_law
from cannoise_jax.physics.mechanism import Likelihood
from cannoise_jax.physics.registry import mechanism
from cannoise_jax.physics.sensor import SensorModel, Settings

_ORDER: tuple[Likelihood, ...] = get_args(Likelihood)
_SIMULATED = 4  # frames simulated for the composite score, per frame scored


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
    Raises ValueError for a kind that is stronger than the model allows.
    """
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
    kind = _weakest((likelihood_of_model(before), likelihood_of_model(after)))
    by = _baseline_ruler(before, clean, settings) if kind == "none" else None
    return (
        score(before, frames, clean, settings, key, kind=kind, by=by),
        score(after, frames, clean, settings, key, kind=kind, by=by),
    )


def _baseline_ruler(model: SensorModel, clean: Float[np.ndarray, "h w"], settings: Settings) -> Ruler:
    law = pixel_law(dataclasses.replace(model, mechanisms=()), clean, settings)
    step = max(float(np.asarray(model.code_step)), 1.0)
    sigma = np.sqrt(np.asarray(law.variance, np.float64) + step**2 / 12)
    return ruler(np.asarray(law.mean, np.float64), sigma, step)
