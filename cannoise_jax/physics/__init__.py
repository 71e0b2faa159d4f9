"""Camera physics: mechanisms of noise, the sensor model, its estimators, likelihood and photon transfer.

The names below are its public face for the likelihood, imported when first used; the sensor model itself is
in `cannoise_jax`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from cannoise_jax.lazy import on_first_use

if TYPE_CHECKING:
    from cannoise_jax.physics.likelihood.choice import CodeStepWarning, Score, compare, score
    from cannoise_jax.physics.likelihood.codes import CodeGrid, gaussian_log_prob
    from cannoise_jax.physics.likelihood.model import frame_log_prob

_HOMES = {
    "CodeGrid": "likelihood.codes",
    "CodeStepWarning": "likelihood.choice",
    "Score": "likelihood.choice",
    "compare": "likelihood.choice",
    "frame_log_prob": "likelihood.model",
    "gaussian_log_prob": "likelihood.codes",
    "score": "likelihood.choice",
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
