"""Cameras from a distribution: what a model of any camera is trained on, so that it must read physics off
pixels.

A camera is a point of the sensor grammar (`physics.core`), drawn from ranges that hold the published
calibrations without being them; a quarter are those calibrations themselves (`physics.core.presets`: Sony
A7S2, IMX686, the five cameras of ELD), jittered. The five phones of SIDD, which the virtual cameras stand
for, are in neither: they are the test.

Drawn per camera, log-uniform unless said otherwise:
- shot 1e-4..2.5e-2 and read noise 0.25..10 e-, a second setting at 1/8..8 times the gain;
- Tukey-lambda shape of the read noise, uniform -0.24..0.2;
- offsets of rows, white (half of the cameras) or 1/f (a third), of columns (a third), and stripes (a tenth),
  0.03..0.4 of the read noise;
- black-level errors of the channels, 0..0.5 of the read noise, uniform;
- weak denoising in the camera, weight 0.02..0.3 uniform, in a third;
- 10, 12 or 14 bits; a black level of 0 in a quarter, so that shadows are clipped.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from cannoise_jax.physics.core.presets import PHONES, preset, preset_names
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.core.sensor_noise import analogue_at_level, noise_of_analogue

_DENOISING = "in_camera_denoising"
ROWS_MOST = 0.4
"""Largest offset of rows or columns, rms in units of the read noise."""


class DrawnCamera(NamedTuple):
    """One camera at one setting, or a batch of them. Normalised units.

    shot, read: of photons and pixels alone, before what else is drawn. tail: Tukey-lambda shape. row,
    slow_row, column, stripes, offset: rms in units of the read noise. blend: weight of the in-camera
    denoising.
    black, white: DN; codes are 1 DN apart. period: of the stripes, pixels. unit: seed of frozen patterns.
    """

    shot: Float[Array, "*b"]
    read: Float[Array, "*b"]
    tail: Float[Array, "*b"]
    row: Float[Array, "*b"]
    slow_row: Float[Array, "*b"]
    column: Float[Array, "*b"]
    stripes: Float[Array, "*b"]
    offset: Float[Array, "*b"]
    blend: Float[Array, "*b"]
    black: Float[Array, "*b"]
    white: Float[Array, "*b"]
    period: Float[Array, "*b"]
    unit: Any


def draw_camera(key: Key[Array, ""]) -> DrawnCamera:
    """One camera of the prior, at one setting."""
    keys = iter(jax.random.split(key, 24))

    def uniform(low: float, high: float):
        return jax.random.uniform(next(keys), minval=low, maxval=high)

    def log_uniform(low: float, high: float):
        return jnp.exp(uniform(math.log(low), math.log(high)))

    def sometimes(share: float, value):
        return jnp.where(uniform(0, 1) < share, value, 0.0)

    shot = log_uniform(1e-4, 2.5e-2)
    read = jnp.clip(jnp.square(shot * log_uniform(0.25, 10.0)), 2e-7, 3e-3)
    tail = uniform(-0.24, 0.2)
    row = sometimes(0.5, log_uniform(0.03, ROWS_MOST))
    table = jnp.asarray(_preset_table())
    known = table[jax.random.randint(next(keys), (), 0, len(table))]
    jitter = jnp.exp(0.1 * jax.random.normal(next(keys), (4,)))
    is_known = uniform(0, 1) < 0.25
    shot, read = (jnp.where(is_known, k * j, v) for k, j, v in zip(known, jitter, (shot, read), strict=False))
    tail = jnp.where(is_known, jnp.clip(known[2] + 0.1 * (jitter[2] - 1), -0.24, 0.2), tail)
    row = jnp.where(is_known, jnp.minimum(known[3] * jitter[3], ROWS_MOST), row)
    bits = 10 + 2 * jax.random.randint(next(keys), (), 0, 3)
    white = 2.0**bits - 1
    return DrawnCamera(
        shot, read, tail, row,
        slow_row=sometimes(0.33, log_uniform(0.03, ROWS_MOST)),
        column=sometimes(0.33, log_uniform(0.03, ROWS_MOST)),
        stripes=sometimes(0.1, log_uniform(0.03, 0.3)),
        offset=uniform(0, 0.5),
        blend=sometimes(0.33, uniform(0.02, 0.3)),
        black=sometimes(0.75, white / 16),
        white=white,
        period=log_uniform(5.0, 100.0),
        unit=next(keys),
    )  # fmt: skip


def another_setting(key: Key[Array, ""], camera: DrawnCamera) -> DrawnCamera:
    """The same camera at another gain: shot follows it, read noise more or less."""
    factor_key, law_key = jax.random.split(key)
    wanted = camera.shot * jnp.exp(jax.random.uniform(factor_key, minval=-2.1, maxval=2.1))
    shot = jnp.clip(wanted, 1e-4, 2.5e-2)
    law = jax.random.uniform(law_key, minval=0.5, maxval=2.0)
    return camera._replace(shot=shot, read=jnp.clip(camera.read * (shot / camera.shot) ** law, 2e-7, 3e-3))


def sensor_of(camera: DrawnCamera) -> SensorModel:
    """The camera as a model of the sensor grammar. Numbers may be traced."""
    read_dn = jnp.sqrt(camera.read) * (camera.white - camera.black)
    levels: Any = (camera.black, camera.white)
    sensor = SensorModel.from_nlf(camera.shot, camera.read, *levels, unit_key=camera.unit).with_mechanism(
        "heavy_tails", tukey_lambda=camera.tail
    )
    for id, share in (
        ("row_noise", camera.row),
        ("row_pink_noise", camera.slow_row),
        ("column_noise", camera.column),
        ("channel_offset", camera.offset),
    ):
        sensor = sensor.with_mechanism(id, sigma_dn=share * read_dn)
    return sensor.with_mechanism(_DENOISING, weight=camera.blend)


def analogue_drawn(
    key: Key[Array, ""], camera: DrawnCamera, clean: Float[Array, "n h w 4"]
) -> Float[Array, "n h w"]:
    """Values of one camera on packed patches just before it denoises and stores them, DN, mosaics: the
    first half of a recording.

    Two halves are two programs: in one, the compiler draws every pixel anew for each neighbour that the
    denoising mixes it with.
    """
    sensor = sensor_of(camera).without(_DENOISING)

    def of_one(key, image):
        return analogue_at_level(sensor, key, image[None], *_levels(camera))[0]

    return jax.vmap(of_one)(jax.random.split(jax.random.split(key)[0], clean.shape[0]), clean)


def stored_drawn(
    key: Key[Array, ""],
    camera: DrawnCamera,
    clean: Float[Array, "n h w 4"],
    analogue: Float[Array, "n h w"],
) -> tuple[Float[Array, "n h w 4"], Float[Array, "2"]]:
    """The second half, by the same key: noise of the camera on the patches as stored codes show it
    (normalised, about `clean`), and the line of its whole variance, (shot, read), rows and rounding and all.
    """
    sensor, levels = sensor_of(camera), _levels(camera)
    last = dataclasses.replace(
        sensor, mechanisms=tuple(f for f in sensor.mechanisms if f.mechanism == _DENOISING)
    )
    noise_key, stripe_key = jax.random.split(key)

    def of_one(key, image, analogue):
        return noise_of_analogue(sensor, last, key, image[None], *levels, analogue=analogue[None])[0]

    noise = jax.vmap(of_one)(jax.random.split(noise_key, clean.shape[0]), clean, analogue)
    draw, bright = sensor.n_init(), 0.2
    flats = jnp.stack([jnp.zeros((2, 2, 4)), jnp.full((2, 2, 4), bright)])
    both = tuple(jnp.repeat(v, 2, 0) for v in levels)
    dark_power, bright_power = jnp.mean(jnp.square(draw(noise_key, flats, *both)[1]), (1, 2, 3))
    size = camera.stripes * jnp.sqrt(camera.read)
    noise = noise + size * _stripes(stripe_key, camera.period, clean.shape)
    shot = (bright_power - dark_power) / bright
    return noise, jnp.stack([shot, dark_power + jnp.square(size)])


def _levels(camera: DrawnCamera) -> tuple[Float[Array, "1 4"], Float[Array, "1 4"]]:
    return jnp.full((1, 4), camera.shot), jnp.full((1, 4), camera.read)


def _stripes(key, period, shape):
    """Horizontal stripes of unit power, of one phase an image: a sensor row is two packed channels."""
    count, height, _, _ = shape
    rows = jnp.arange(2 * height).reshape(height, 2)
    phase = jax.random.uniform(key, (count, 1, 1), maxval=2 * math.pi)
    wave = math.sqrt(2) * jnp.cos(2 * math.pi * rows / period + phase)  # n h 2
    return jnp.repeat(wave, 2, -1)[:, :, None, :]


@functools.cache
def _preset_table() -> Float[np.ndarray, "n 4"]:
    """(shot, read, tail, row) of every setting of the published calibrations, phones left out."""
    with jax.ensure_compile_time_eval():  # numbers, also where a program is being traced
        return np.array(_preset_rows(), np.float32)


def _preset_rows() -> list[tuple[float, ...]]:
    rows: list[tuple[float, ...]] = []
    for name in preset_names():
        if name in PHONES:
            continue
        sensor = preset(name)
        span = float(sensor.white_level) - float(sensor.black_level)
        fitted = dict(sensor.mechanisms)
        gains, reads = (np.asarray(v)[:, 0] for v in (sensor.gain_dn_per_e, sensor.read_noise_e))
        for i, (gain, read_e) in enumerate(zip(gains.tolist(), reads.tolist(), strict=True)):
            read_dn = gain * read_e
            tail = _at(fitted["heavy_tails"]["tukey_lambda"], i)
            row = _at(fitted["row_noise"]["sigma_dn"], i) / read_dn
            level = (gain / span, (read_dn / span) ** 2)
            rows.append((*level, min(max(tail, -0.24), 0.2), min(row, ROWS_MOST)))
    return rows


def _at(value: Any, i: int) -> float:
    values = np.asarray(getattr(value, "value", value), np.float64)
    return float(values.reshape(values.shape[0], -1)[i, 0]) if values.ndim else float(values)
