"""The signal chain: from expected charge through the noise steps to stored codes. See `mechanism` for its
stages."""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Mapping
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from cannoise_jax.physics.core import tukey_lambda
from cannoise_jax.physics.core.foreign import called, of_another_type
from cannoise_jax.physics.core.mechanism import ACTS_ON, Context, Effect, Mechanism, Noise
from cannoise_jax.physics.core.poisson_gaussian import centred_uniform, sample_normal, sample_poisson
from cannoise_jax.recordings.recording import BadInput

_LINES = ("row", "column", "frame")
_APART = 8
"""Lines further apart than this never meet in one pixel."""
_SHOT, _READ = 1, 2
"""Streams of the two noise steps; those of the mechanisms are named by their ids."""


def mechanism_key(key: Key[Array, ""], model, index: int) -> Key[Array, ""]:
    """A key of its own for one mechanism, the same whatever other mechanisms the model has."""
    id = model.mechanisms[index].mechanism
    occurrence = sum(f.mechanism == id for f in model.mechanisms[:index])
    return jax.random.fold_in(key, (zlib.crc32(id.encode()) + occurrence) % 2**31)


def maps_of(model, index: int, values, context: Context) -> dict[str, Array]:
    """The frozen maps of one mechanism: measured, or drawn from the unit's key. Raises BadInput where a
    measured map has another size than the frame."""
    fitted = model.mechanisms[index]
    if fitted.maps:
        for name, values_map in fitted.maps.items():
            for have, want in zip(values_map.shape[-2:], context.size, strict=True):
                if have not in (1, want):
                    raise BadInput(
                        f"{model.camera}: map {name} of {fitted.mechanism} is {values_map.shape[-2:]}, "
                        f"the frame {context.size}: use that size, or another unit, whose maps are drawn"
                    )
        return {
            name: jnp.asarray(m).reshape((1,) * (3 - m.ndim) + m.shape) for name, m in fitted.maps.items()
        }
    if fitted.record.draw_maps is None:
        return {}
    maps = _answer(fitted.record, "draw_maps", mechanism_key(model.unit_key, model, index), values, context)
    return _checked_maps(fitted.record, maps, context.size)


def _answer(record: Mechanism, name: str, *given):
    """What a function of a record returns; of a mechanism from outside its errors are one line."""
    function = getattr(record, name)
    return called(record.id, f"`{name}`", function, *given) if record.home else function(*given)


def _checked_maps(record: Mechanism, maps, size: tuple[int, int]) -> dict[str, Array]:
    """Maps that a mechanism drew. Raises BadInput where one from outside drew none, or another size."""
    if not record.home:
        return maps
    if not isinstance(maps, Mapping):
        raise of_another_type(record.id, "`draw_maps`", maps, "maps by name")
    for name, values in maps.items():
        shape = called(record.id, f"`draw_maps` ({name})", jnp.shape, values)
        fits = all(have in (1, want) for have, want in zip(shape[-2:], size, strict=False))
        if len(shape) > 3 or not fits:
            raise BadInput(
                f"{record.id}: its `draw_maps` gives {name} the shape {shape} for frames of {size}: it "
                "must broadcast against [T, H, W]"
            )
    return dict(maps)


def altered_noise(model, context: Context, values) -> Noise:
    """The noise steps and the rounding as the mechanisms leave them."""
    noise = Noise(context.gain_dn_per_e, context.read_noise_e, context.code_step)
    for i, fitted in enumerate(model.mechanisms):
        if fitted.record.baseline is not None:
            maps = maps_of(model, i, values[i], context)
            noise = _answer(fitted.record, "baseline", noise, values[i], maps, context)
            if not isinstance(noise, Noise):
                raise of_another_type(fitted.mechanism, "`baseline`", noise, "a Noise")
    return noise


def inside(context: Context, noise: Noise) -> Context:
    """The context as charge sees it: with the gain and read noise that the noise steps really have."""
    return dataclasses.replace(context, gain_dn_per_e=noise.gain_dn_per_e, read_noise_e=noise.read_noise_e)


def along_chain(model) -> list[int]:
    """Places of the mechanisms in the order in which the chain calls them."""
    acts = [fitted.record.acts_on for fitted in model.mechanisms]
    return sorted(range(len(acts)), key=lambda i: ACTS_ON.index(acts[i]))


def seen_at(context: Context, mean: Array, variance: Array | None = None) -> Context:
    """The context with the signal (DN above black) as earlier mechanisms leave it; variance: DN^2, which
    `own_variance` then gives. None: charge, whose variance follows the mean."""
    if variance is None:
        return dataclasses.replace(context, mean_dn=mean)
    least = variance / jnp.where(mean > 0, mean, 1.0)
    gain = jnp.where(mean > 0, jnp.minimum(context.gain_dn_per_e, least), context.gain_dn_per_e)
    gain = jnp.maximum(gain, 1e-12)
    spare = variance - gain * mean
    # The root of zero has no slope, and its product with that of none is no number.
    read = jnp.where(spare > 0, jnp.sqrt(jnp.where(spare > 0, spare, 1.0)), 0.0) / gain
    return dataclasses.replace(context, mean_dn=mean, gain_dn_per_e=gain, read_noise_e=read)


def closed_form(model, context: Context, values) -> tuple[Array, Array]:
    """Mean (DN) and variance (DN^2) of the analogue value just before rounding, [1, H, W]: of the noise steps
    as altered, and every other mechanism on what the earlier ones leave (the few without a closed form leave
    both alone). Variance that is not shot noise passes a mechanism by the slope of its mean."""
    noise = altered_noise(model, context, values)
    inner = inside(context, noise)
    shape, gain = (1, *context.size), inner.gain_dn_per_e
    mean = jnp.broadcast_to(context.mean_dn, shape)
    # Before read noise the variance is that of the charge; lines: what of it rows, columns, frames share.
    variance, read = gain * mean, jnp.broadcast_to((gain * inner.read_noise_e) ** 2, shape)
    lines = {name: jnp.zeros(shape) for name in _LINES}
    analogue = False
    for i in along_chain(model):
        record = model.mechanisms[i].record
        if record.effect is None or record.baseline is not None:
            continue
        if not analogue and record.acts_on in ("signal", "code"):
            analogue, variance = True, variance + read
        maps = maps_of(model, i, values[i], inner)
        shared = sum(lines.values()) if _digital(record) else jnp.zeros(shape)
        own = jnp.maximum(variance - shared, 1e-12) if analogue else None

        def effect_at(mean, record=record, value=values[i], maps=maps, own=own):
            effect = _answer(record, "effect", value, maps, seen_at(inner, mean, own))
            if not isinstance(effect, Effect):
                raise of_another_type(record.id, "`effect`", effect, "an Effect")
            return effect

        def after(mean, effect_at=effect_at):
            effect = effect_at(mean)
            return mean if effect.mean is None else jnp.broadcast_to(mean + effect.mean, shape), effect

        moved, along, effect = jax.linearize(after, mean, has_aux=True)
        slope = along(jnp.ones(shape))
        change = 0.0 if effect.variance is None else effect.variance
        if own is None:
            variance = gain * mean + change + slope**2 * (variance - gain * mean)
            lines = {name: slope**2 * v for name, v in lines.items()}
        else:
            passed = {name: _passed(along, slope, v, name, record) for name, v in lines.items()}
            variance = (own + change + sum(passed.values())) if _digital(record) else own + change
            lines = passed
        for name in _LINES:
            more = getattr(effect, name)
            lines[name] = lines[name] if more is None else lines[name] + more
        mean = moved
    return context.black_level + mean, variance if analogue else variance + read


def _digital(record) -> bool:
    """Whether a mechanism is of what the camera makes of its values: it may mix those of neighbours."""
    return record.acts_on == "code" or record.stage == "digital"


def _passed(along, slope: Array, shared: Array, name: str, record) -> Array:
    """What is left of a shared variance behind a mechanism, of whose mean `along` is the derivative: times
    its slope squared, but where it mixes the codes of neighbouring lines, which differ."""
    if not _digital(record) or name == "frame":
        return slope**2 * shared
    place = jnp.arange(slope.shape[1])[:, None] if name == "row" else jnp.arange(slope.shape[2])
    parts = [jnp.broadcast_to(place % _APART == k, slope.shape).astype(slope.dtype) for k in range(_APART)]
    return shared * sum(along(part) ** 2 for part in parts)


def stage(model, key, x, acts_on: str, context: Context, values) -> Array:
    """What the mechanisms of one stage make of its values, in their order."""
    for i, fitted in enumerate(model.mechanisms):
        record = fitted.record
        if record.acts_on == acts_on and record.sample is not None:
            maps = maps_of(model, i, values[i], context)
            drawn = _answer(record, "sample", mechanism_key(key, model, i), x, values[i], maps, context)
            if not hasattr(drawn, "shape") or drawn.shape != jnp.shape(x):
                found = getattr(drawn, "shape", f"a value of type {type(drawn).__name__}")
                raise BadInput(
                    f"{record.id}: its sampler returns {found} for frames of {jnp.shape(x)}: "
                    "return every pixel of every frame"
                )
            x = drawn
    return x


def shot_noise(key: Key[Array, ""], mean: Float[Array, "t h w"], share) -> Float[Array, "t h w"]:
    """Charge of a given mean, e-: Poisson (share None), Gaussian (0), or a sum of both with variance
    `mean`."""
    mean = jnp.maximum(mean, 0.0)
    if share is None:
        return sample_poisson(key, mean)
    poisson, gaussian = jax.random.split(key)
    counts = sample_poisson(poisson, mean) - mean
    return mean + share * counts + jnp.sqrt((1 - share**2) * mean) * sample_normal(gaussian, mean.shape)


def _twice(values: Array, scenes: int) -> Array:
    """Every scene two times in a row, where the values have a first axis of scenes."""
    return jnp.repeat(values, 2, axis=0) if values.ndim == 3 and values.shape[0] == scenes else values


def run_chain(
    model, key: Key[Array, ""], context: Context, values, frames: int
) -> tuple[Float[Array, "t h w"], Array]:
    """Analogue values in DN just before rounding, and the code step: [T, H, W]."""
    noise = altered_noise(model, context, values)
    gain, read_noise, drawn = noise.gain_dn_per_e, noise.read_noise_e, frames
    inner, mean, keep = inside(context, noise), context.mean_dn / gain, slice(None)
    if any(fitted.record.looks_back for fitted in model.mechanisms):
        if mean.shape[0] > 1:  # a scene per frame, each there before its own
            inner, mean, noise = jax.tree.map(partial(_twice, scenes=mean.shape[0]), (inner, mean, noise))
            keep, drawn = slice(1, None, 2), 2 * frames
        else:
            # Last, so that the others are the frames that the model would draw without looking back.
            inner = dataclasses.replace(inner, frame_before=True)
            keep, drawn = slice(frames), frames + 1
    mean = jnp.broadcast_to(mean, (drawn, *context.size))
    mean = stage(model, key, mean, "mean", inner, values)
    charge = shot_noise(jax.random.fold_in(key, _SHOT), mean, noise.poisson_share)
    charge = stage(model, key, charge, "charge", inner, values)[keep]
    read_key = jax.random.fold_in(key, _READ)
    if noise.tukey_lambda is None:
        read = sample_normal(read_key, charge.shape)
    else:
        read = tukey_lambda.standard_quantile(centred_uniform(read_key, charge.shape), noise.tukey_lambda)
    y = context.black_level + gain * (charge + read_noise * read)
    return stage(model, key, y, "signal", context, values), noise.code_step


def to_codes(model, key: Key[Array, ""], y: Float[Array, "t h w"], step, context: Context, values):
    """Stored codes in DN as float32: rounded to the step, clipped at 0 and the white level, then the digital
    mechanisms, rounded and clipped again."""
    step = jnp.where(step > 0, step, 1.0)
    highest = jnp.floor(context.white_level / step) * step
    codes = jnp.clip(jnp.round(y / step) * step, 0.0, highest)
    codes = stage(model, key, codes, "code", dataclasses.replace(context, code_step=step), values)
    return jnp.clip(jnp.round(codes / step) * step, 0.0, highest)
