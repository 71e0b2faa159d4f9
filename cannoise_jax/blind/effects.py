"""Every effect that can be injected, by name."""

from __future__ import annotations

from collections.abc import Callable

from cannoise_jax.blind import effects_readout, effects_signal, effects_unlisted
from cannoise_jax.blind.chain import Effect
from cannoise_jax.vocabulary import VOCABULARY

_MODULES = (effects_signal, effects_readout)

LISTED: dict[str, Callable[[float], Effect]] = {
    name: getattr(module, name) for module in _MODULES for name in VOCABULARY if hasattr(module, name)
}
UNLISTED: dict[str, Callable[[float], Effect]] = {
    name: getattr(effects_unlisted, name) for name in effects_unlisted.CARDS
}


def effect(name: str, amplitude: float) -> Effect:
    """The effect `name` at an amplitude in the vocabulary's units. Raises KeyError for an unknown name."""
    return {**LISTED, **UNLISTED}[name](amplitude)
