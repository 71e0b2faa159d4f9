"""Where the darks of a camera model lie, as levels of recorded darks are told: of ordinary pixels, and with
what is cut off at code 0."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from cannoise_jax.discovery.frames.contrasts import Stack, ordinary
from cannoise_jax.physics.core.mosaic_ops import cut_below
from cannoise_jax.physics.core.rounding import CLEAR
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.core.sensor_draws import closed_moments
from cannoise_jax.recordings.packing import SITES


def stored_dark(model: SensorModel, size: tuple[int, int], settings: Settings) -> Float[np.ndarray, "h w"]:
    """Mean of every pixel of a dark, DN, with what is cut off at code 0, whether or not a mechanism of the
    converter says so: of two limits the higher one is that which cuts."""
    mean, variance, whole = _moments(model, size, settings)
    near = mean < CLEAR * np.sqrt(variance)
    if not near.any():
        return whole
    cut = np.asarray(cut_below(mean, np.maximum(variance, 1e-12), 0.0)[0])
    return np.where(near, np.maximum(whole, cut), whole)


def added_level(
    model: SensorModel, bare: SensorModel, dark: Stack, settings: Settings
) -> Float[np.ndarray, "4"]:
    """What a model adds to the level of every site of a dark, DN. The level of the bare one is that
    before code 0 cuts it off (`calibrate.fit_baseline`) where it lies so low, and what is cut off there adds
    nothing to that. It is the level of pixels that are ordinary in the recorded dark: few far ones have no
    part in it."""
    size = dark.mean.shape
    (free, variance, whole), (level, _, stored) = (_moments(m, size, settings) for m in (model, bare))
    near = level < CLEAR * np.sqrt(variance)
    lifted = np.where(near, free - level, whole - stored)
    return np.array([lifted[at][ordinary(dark.mean[at])].mean() for at in SITES])


def _moments(model: SensorModel, size: tuple[int, int], settings: Settings):
    """Mean and temporal variance of a dark before the converter, and its mean with that, DN and DN^2."""
    dark = jnp.zeros(size, jnp.float32)
    before = tuple(f for f in model.mechanisms if f.record.point.stage != "converter")
    whole = np.asarray(closed_moments(model, dark, settings)[0])
    if len(before) == len(model.mechanisms):
        return whole, np.asarray(closed_moments(model, dark, settings)[1]), whole
    free = dataclasses.replace(model, mechanisms=before)
    mean, variance = (np.asarray(v) for v in closed_moments(free, dark, settings))
    return mean, variance, whole
