"""Every effect that can be injected, by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from cannoise_jax.blind import effects_readout, effects_signal, effects_unlisted
from cannoise_jax.blind.chain import Camera, Effect, frozen
from cannoise_jax.blind.listed import NAMES

_MODULES = (effects_signal, effects_readout)

LISTED: dict[str, Callable[[float], Effect]] = {
    name: getattr(module, name) for module in _MODULES for name in NAMES if hasattr(module, name)
}
UNLISTED: dict[str, Callable[[float], Effect]] = {
    name: getattr(effects_unlisted, name) for name in effects_unlisted.SCALES
}


def effect(name: str, amplitude: float) -> Effect:
    """The effect `name` at an amplitude in the vocabulary's units. Raises KeyError for an unknown name."""
    return {**LISTED, **UNLISTED}[name](amplitude)


def facts(name: str, camera: Camera, size: tuple[int, int]) -> dict[str, Any]:
    """Where the effect lies in this unit, as far as one number says it: period in px, first column."""
    if name == "banding":
        return {"period_px": 1 / frozen(camera.unit, "banding").uniform(0.002, 0.45)}
    if name == "flicker":
        return {"period_px": frozen(camera.unit, "flicker").uniform(0.15, 0.45) * size[0]}
    if name == "amplifier_mismatch":
        return {"columns": [size[1] // 2]}
    return {}
