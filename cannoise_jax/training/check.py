"""Configs that cannot be trained, refused before anything is read or computed."""

from __future__ import annotations

import math

from ml_collections import ConfigDict

from cannoise_jax.physics.initial_noise import INITIAL_NOISE, sensors_of
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.sampling import LEVELS
from cannoise_jax.training.state import COMPUTE

_COUNTS = (
    "steps", "batch_size", "critic_updates", "log_every", "evaluate_every", "checkpoint_every",
    "validation_patches", "references", "data.scenes", "data.validation_scenes", "data.test_scenes",
    "data.per_scene", "data.held_out_per_scene",
    "data.per_recording", "data.half_real_scenes", "data.train_patches", "data.test_patches",
    "data.held_out_patches",
    "data.calibration_patches", "data.cameras", "data.references", "data.validation_cameras",
    "data.calibration_scenes",
)  # fmt: skip
_NEEDED = ("steps", "batch_size", "patch", "reference", "seed", "data", "loss", "optimiser", "networks")
_POSITIVE = (
    "width", "optimiser.generator_rate", "optimiser.encoder_rate", "optimiser.critic_rate", "exposure_s",
)  # fmt: skip
_NOT_NEGATIVE = (
    "optimiser.warmup", "loss.adversarial", "loss.penalty", "loss.feature_matching", "loss.statistics",
    "loss.triplet", "loss.margin", "loss.physics", "loss.quantiles", "loss.spectra", "loss.knee",
)  # fmt: skip
_BELOW_ONE = ("ema", "optimiser.beta1", "optimiser.beta2")
_CHOICES = {
    "level": LEVELS,
    "compute": COMPUTE,
    "critic_condition": ("none", "camera", "latent"),
    "optimiser.schedule": ("constant", "cosine"),
    "loss.feature_target": ("clean", "real"),
    "loss.triplets": ("drawn", "batch"),
}
_MULTIPLE, _SMALLEST, _LARGEST = 32, 16, 64


def check_config(config: ConfigDict) -> None:
    """Raises BadInput, one line with the field, for a value that no run could use, or that is missing."""
    missing = next((name for name in _NEEDED if _value(config, name) is None), None)
    if missing is not None:
        raise BadInput(f"config.{missing}: missing: state it as configs/default.py does")
    for name in (*_COUNTS, "patch", "reference"):
        value = _value(config, name)
        if value is None or isinstance(value, tuple):  # SIDD's test scenes are names
            continue
        if not (isinstance(value, int) and value >= 1):
            raise _wrong(name, value, "use a whole number from 1 on")
    for name in ("data.per_scene", "data.held_out_per_scene"):
        count = _value(config, name)
        if count is not None and math.isqrt(count) ** 2 != count:
            raise _wrong(name, count, "use a square number: patches are cut on a grid")
    if config.patch % _MULTIPLE or config.patch > _LARGEST:
        raise _wrong("patch", config.patch, f"use {_MULTIPLE} or {_LARGEST}")
    if not _SMALLEST <= config.reference <= _LARGEST or config.reference % 8:
        raise _wrong("reference", config.reference, f"use a multiple of 8 from {_SMALLEST} to {_LARGEST}")
    for names, holds, rule in (
        (_POSITIVE, lambda v: v > 0, "use a positive number"),
        (_NOT_NEGATIVE, lambda v: v >= 0, "use zero or more"),
        (_BELOW_ONE, lambda v: 0 <= v < 1, "use a number from 0 to below 1"),
    ):
        for name in names:
            value = _value(config, name)
            if value is not None and not (math.isfinite(value) and holds(value)):
                raise _wrong(name, value, rule)
    choices = dict(_CHOICES)
    noise = config.initial_noise
    if not callable(noise) and not str(noise).startswith(("sensor:", "preset:")):
        choices["initial_noise"] = tuple(INITIAL_NOISE)
    if "compute" not in config:  # a run of before there was a choice
        del choices["compute"]
    for name, allowed in choices.items():
        if _value(config, name) not in allowed:
            raise _wrong(name, _value(config, name), f"use one of {', '.join(allowed)}")


def check_sensors(config: ConfigDict, cameras: tuple[str, ...]) -> None:
    """Raises BadInput where "sensor:FILE,FILE" are not those of the cameras, in their order."""
    names = tuple(sensor.camera for sensor in sensors_of(config.initial_noise))
    if len(names) > 1 and names != cameras:
        raise BadInput(
            f"config.initial_noise: sensors of {', '.join(names)} for the cameras {', '.join(cameras)}: name "
            "one file for each camera, in the order of the recordings"
        )


def _value(config: ConfigDict, name: str):
    """A field by its dotted name; None where this config has no such field."""
    found = config
    for part in name.split("."):
        if part not in found:
            return None
        found = found[part]
    return found


def _wrong(name: str, value: object, rule: str) -> BadInput:
    return BadInput(f"config.{name}: {value!r}: {rule}")
