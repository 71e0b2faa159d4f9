"""The noise of a sensor model as a generator starts from it: at levels that are handed over, or its own."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from cannoise_jax.physics.core.chain import altered_noise, closed_form, run_chain, stage, to_codes
from cannoise_jax.physics.core.mechanism import Context
from cannoise_jax.physics.core.poisson_gaussian import InitialNoise
from cannoise_jax.physics.core.settings import Settings, context_of, context_of_nlf, resolve
from cannoise_jax.recordings.packing import pack, to_mosaic_order, unpack


def noise_at_level(model: Any, discretise: bool = True) -> InitialNoise:
    """Noise whose baseline is that of the shot and read that it is given; see `SensorModel.n_init`."""

    def draw(key, clean, shot, read):
        own, key, context, mosaic = _at_level(model, key, clean, shot, read)
        levels = tuple(to_mosaic_order(v, model.cfa) for v in (shot, read))
        noise = _noise(own, key, context, mosaic, discretise)

        def sigma(mosaic, shot, read):  # of one patch: closed forms know one frame
            return _sigma(own, context_of_nlf(own, mosaic[None], shot[None], read[None]), discretise)

        return pack(noise, model.cfa), pack(jax.vmap(sigma)(mosaic, *levels), model.cfa)

    return draw


def analogue_at_level(model: Any, key, clean, shot, read) -> Float[Array, "b h w"]:
    """The first half of `noise_at_level`: values in DN just before rounding, mosaics."""
    own, key, context, mosaic = _at_level(model, key, clean, shot, read)
    return run_chain(own, key, context, resolve(own, context), mosaic.shape[0])[0]


def noise_of_analogue(model: Any, last: Any, key, clean, shot, read, *, analogue) -> Float[Array, "b h w 4"]:
    """The second half of `noise_at_level`: the noise of values that are analogue, as codes show it.

    last: the model with the last mechanisms of the analogue signal alone, where the first half lacked them.
    """
    own, key, context, mosaic = _at_level(model, key, clean, shot, read)
    values = resolve(own, context)
    analogue = stage(last, key, analogue, "signal", context, resolve(last, context))
    step = altered_noise(own, context, values).code_step
    codes = to_codes(own, key, analogue, step, context, values)
    return pack((codes - context.black_level) / context.span_dn - mosaic, model.cfa)


def _at_level(model: Any, key, clean, shot, read) -> tuple[Any, Any, Context, Float[Array, "b h w"]]:
    """The model in its place, the key of its draws, the context, and clean mosaics."""
    mosaic = unpack(clean, model.cfa)
    place, key = jax.random.split(key)
    own = placed(model, place, mosaic.shape[-2:], repeat=False)
    levels = (to_mosaic_order(v, model.cfa) for v in (shot, read))
    return own, key, context_of_nlf(own, mosaic, *levels), mosaic


def noise_at_exposure(model: Any, exposure_s: float, discretise: bool = True) -> InitialNoise:
    """Noise of the model's own baseline at an exposure: of the levels that it is given only shot counts, by
    which the nearest of the model's gain settings is found.

    Every image lies at another even place of the measured maps, which are repeated where it is larger.
    """

    def draw(key, clean, shot, read):
        def one(key, clean, shot):
            place, key = jax.random.split(key)
            mosaic = unpack(clean, model.cfa)[None]
            own = placed(model, place, mosaic.shape[-2:], repeat=True)
            iso: Any = nearest_iso(model, shot)
            context = context_of(own, mosaic, Settings(iso=iso, exposure_s=exposure_s))
            noise = _noise(own, key, context, mosaic, discretise)[0]
            return pack(noise, model.cfa), pack(_sigma(own, context, discretise), model.cfa)

        shot = jnp.broadcast_to(shot, (clean.shape[0], 4))
        return jax.vmap(one)(jax.random.split(key, clean.shape[0]), clean, shot)

    return draw


def nearest_iso(model: Any, shot: Float[Array, "4"]) -> Float[Array, ""]:
    """The tabulated ISO whose gain is nearest, by its logarithm, to that of a shot coefficient."""
    span = jnp.asarray(model.white_level) - jnp.mean(jnp.asarray(model.black_level))
    wanted = jnp.log(jnp.maximum(jnp.mean(shot) * span, 1e-12))
    gains = jnp.log(jnp.mean(jnp.asarray(model.gain_dn_per_e), axis=1))
    return jnp.asarray(model.iso)[jnp.argmin(jnp.abs(gains - wanted))]


def with_drawn(model: Any, maps: tuple[dict[str, Array], ...]) -> Any:
    """The model with these frozen maps, one set for each mechanism."""
    kept = tuple(dataclasses.replace(f, maps=m) for f, m in zip(model.mechanisms, maps, strict=True))
    return dataclasses.replace(model, mechanisms=kept)


def _noise(model, key, context: Context, mosaic, discretise: bool) -> Float[Array, "t h w"]:
    values = resolve(model, context)
    y, step = run_chain(model, key, context, values, mosaic.shape[0])
    if discretise:
        y = to_codes(model, key, y, step, context, values)
    return (y - context.black_level) / context.span_dn - mosaic


def _sigma(model, context: Context, discretise: bool) -> Float[Array, "h w"]:
    """Standard deviation in closed form, of one frame, normalised units."""
    values = resolve(model, context)
    _, variance = closed_form(model, context, values)
    rounding = jnp.maximum(altered_noise(model, context, values).code_step, 1.0) ** 2 / 12
    variance = variance + rounding if discretise else variance
    return (jnp.sqrt(jnp.maximum(variance, rounding)) / context.span_dn)[0]


def placed(model: Any, key: Key[Array, ""] | None, size: tuple[int, int], repeat: bool) -> Any:
    """The model with its measured maps cut to [H, W], all at the same even place, which keeps the colours;
    without a key at the first. repeat: maps that are smaller go round; else they stay as they are."""
    shapes = [m.shape[-2:] for f in model.mechanisms for m in f.maps.values()]
    starts: list[Any] = [0, 0] if key is None else []
    for axis, axis_key in enumerate([] if key is None else jax.random.split(key)):
        spare = [shape[axis] - size[axis] for shape in shapes if shape[axis] > size[axis]]
        starts.append(2 * jax.random.randint(axis_key, (), 0, min(spare, default=0) // 2 + 1))

    def cut(values):
        for axis in (-2, -1):
            have, want = values.shape[axis], size[axis]
            if have > want:
                values = jax.lax.dynamic_slice_in_dim(
                    jnp.asarray(values), starts[axis], want, values.ndim + axis
                )
            elif repeat and 1 < have < want:
                values = jnp.take(jnp.asarray(values), np.arange(want) % (have // 2 * 2), axis)
        return values

    return with_drawn(model, tuple({name: cut(m) for name, m in f.maps.items()} for f in model.mechanisms))
