"""The noise that a learned generator starts from: drawn from a noise level function, with its standard
deviation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from cannoise_jax.physics.core.poisson_gaussian import InitialNoise, nlf_sigma, sample_normal
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.core.sensor_json import MissingEntry

_LEAST_VARIANCE = 1e-9
"""Normalised units: a third of a code of a 16-bit converter, so that sigma can be divided by."""


def poisson_gaussian(
    key: Key[Array, ""],
    clean: Float[Array, "*b h w 4"],
    shot: Float[Array, "*b 4"],
    read: Float[Array, "*b 4"],
) -> tuple[Float[Array, "*b h w 4"], Float[Array, "*b h w 4"]]:
    """Noise of variance shot * clean + read (Chang et al. 2020, eq. 2), and its standard deviation.

    Normal draws, as in the reference release; shot and read in packed order, normalised units;
    a negative shot counts as zero, and a read below the least variance as that.
    """
    shot, read = jnp.maximum(shot, 0), jnp.maximum(read, _LEAST_VARIANCE)
    sigma = nlf_sigma(clean, shot[..., None, None, :], read[..., None, None, :])
    return sigma * sample_normal(key, clean.shape), sigma


def gaussian(
    key: Key[Array, ""],
    clean: Float[Array, "*b h w 4"],
    shot: Float[Array, "*b 4"],
    read: Float[Array, "*b 4"],
) -> tuple[Float[Array, "*b h w 4"], Float[Array, "*b h w 4"]]:
    """Noise of variance shot everywhere: the reference's Gaussian baseline."""
    sigma = jnp.broadcast_to(jnp.sqrt(jnp.maximum(shot, _LEAST_VARIANCE))[..., None, None, :], clean.shape)
    return sigma * sample_normal(key, clean.shape), sigma


INITIAL_NOISE: dict[str, InitialNoise] = {"poisson_gaussian": poisson_gaussian, "gaussian": gaussian}


def initial_noise(choice: str | InitialNoise) -> InitialNoise:
    """By name; any `f(key, clean, shot, read) -> (noise, sigma)` as it stands. Raises ValueError for another
    name."""
    if callable(choice):
        return choice
    if choice not in INITIAL_NOISE:
        names = ", ".join(INITIAL_NOISE)
        raise ValueError(
            f"initial_noise must be {names}, sensor:FILE, preset:NAME or a function, got {choice!r}"
        )
    return INITIAL_NOISE[choice]


def sensors_of(choice: str | InitialNoise) -> tuple[SensorModel, ...]:
    """The sensor models of "sensor:FILE", "sensor:FILE,FILE" (one a camera) or "preset:NAME"; none for other
    choices. Raises BadInput for a file or preset that is not one."""
    kind, _, name = choice.partition(":") if isinstance(choice, str) else ("", "", "")
    if name and kind == "sensor":
        try:
            return tuple(SensorModel.load(file) for file in name.split(","))
        except MissingEntry as error:
            raise error.not_taken("training") from error
    return (SensorModel.preset(name),) if name and kind == "preset" else ()


def initial_noise_by_camera(
    choice: str | InitialNoise, exposure_s: float | None = None
) -> Callable[..., tuple[Any, Any]]:
    """`(key, clean, shot, read, camera) -> (noise, sigma)`: of the sensor of each image's camera, `[B]`,
    where the choice names several; else as `initial_noise`. exposure_s: of sensors, see
    `SensorModel.n_init`."""
    sensors = sensors_of(choice)
    draws = [sensor.n_init(exposure_s=exposure_s) for sensor in sensors] or [initial_noise(choice)]

    def draw(key, clean, shot, read, camera):
        if len(draws) == 1:
            return draws[0](key, clean, shot, read)
        made = [jnp.stack(part) for part in zip(*(d(key, clean, shot, read) for d in draws), strict=True)]
        return tuple(part[camera, jnp.arange(clean.shape[0])] for part in made)

    return draw
