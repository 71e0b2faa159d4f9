"""Which scorer judges a camera model: the weakest likelihood among its mechanisms decides.

"exact": `likelihood_shot.shot_log_prob` (pixels independent once the frozen maps are known).
"approximate": `likelihood_shared.shared_log_prob` and `likelihood_crossed.crossed_laplace` over a pixel
likelihood of `likelihood_shot` or `likelihood_tails`. "none": `likelihood_composite.composite_score`, learned
from simulated frames. Scores of different scorers cannot be compared: judge a model before and after a change
by the scorer that serves both.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import get_args

import jax
import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.likelihood_composite import CompositeScore, Ruler, composite_score, profile
from cannoise_jax.physics.mechanism import Likelihood
from cannoise_jax.physics.registry import mechanism
from cannoise_jax.physics.sensor import SensorModel, Settings

_ORDER: tuple[Likelihood, ...] = get_args(Likelihood)

SCORERS: dict[Likelihood, tuple[str, ...]] = {
    "exact": ("likelihood_shot.shot_log_prob",),
    "approximate": (
        "likelihood_shared.shared_log_prob",
        "likelihood_crossed.crossed_laplace",
        "likelihood_tails.tukey_log_prob",
    ),
    "none": ("likelihood_composite.composite_score",),
}
"""Module and function by the likelihood of a model."""


def likelihood_of(ids: Iterable[str]) -> Likelihood:
    """The weakest likelihood among mechanisms; "exact" without any. Raises ValueError for unknown ids."""
    return max((mechanism(id).likelihood for id in ids), key=_ORDER.index, default="exact")


def composite_of(
    model: SensorModel,
    key: jax.Array,
    clean: Float[np.ndarray, "h w"],
    settings: Settings,
    frames: Float[np.ndarray, "t h w"],
    by: Ruler,
) -> CompositeScore:
    """Composite score of frames, DN, under a model: its profile is learned from `settings.frames` simulated
    ones. It serves every model, so it is the one to use where one of two models has no likelihood."""
    return composite_score(profile(np.asarray(model.sample(key, clean, settings)), by), frames, by)
