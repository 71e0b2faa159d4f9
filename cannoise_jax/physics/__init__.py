"""Camera physics: mechanisms of noise, the sensor model, its estimators, likelihood and photon transfer.

The names below are its public face for the likelihood, imported when first used; the sensor model itself is
in `cannoise_jax`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from cannoise_jax.lazy import on_first_use

if TYPE_CHECKING:
    from cannoise_jax.physics.likelihood import CodeGrid, gaussian_log_prob
    from cannoise_jax.physics.likelihood_choice import CodeStepWarning, Score, compare, score
    from cannoise_jax.physics.likelihood_model import frame_log_prob

_HOMES = {
    "CodeGrid": "likelihood",
    "CodeStepWarning": "likelihood_choice",
    "Score": "likelihood_choice",
    "compare": "likelihood_choice",
    "frame_log_prob": "likelihood_model",
    "gaussian_log_prob": "likelihood",
    "score": "likelihood_choice",
}

__all__ = [
    "CodeGrid",
    "CodeStepWarning",
    "Score",
    "compare",
    "frame_log_prob",
    "gaussian_log_prob",
    "score",
]


def __getattr__(name: str) -> Any:
    return on_first_use(__name__, _HOMES, name)


def __dir__() -> list[str]:
    return __all__
