"""The noise that a learned generator starts from: drawn from a noise level function, with its standard
deviation."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from cannoise_jax.physics.core.poisson_gaussian import InitialNoise, nlf_sigma, sample_normal
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.core.sensor_json import read_sensor

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
    """By name; "sensor:FILE" or "preset:NAME" for that of a sensor model; or any
    `f(key, clean, shot, read) -> (noise, sigma)` as it stands. Raises ValueError for another name, BadInput
    for a file or preset that is not one."""
    if callable(choice):
        return choice
    kind, _, name = choice.partition(":")
    if name and kind in ("sensor", "preset"):
        return (read_sensor(name) if kind == "sensor" else SensorModel.preset(name)).n_init()
    if choice not in INITIAL_NOISE:
        names = ", ".join(INITIAL_NOISE)
        raise ValueError(
            f"initial_noise must be {names}, sensor:FILE, preset:NAME or a function, got {choice!r}"
        )
    return INITIAL_NOISE[choice]
