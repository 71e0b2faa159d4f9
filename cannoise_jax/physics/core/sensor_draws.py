"""Compiled programs of a sensor model: its frames, its frozen maps, and moments in closed form."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt16

from cannoise_jax.physics.core.camera import Camera
from cannoise_jax.physics.core.chain import closed_form, maps_of, run_chain, to_codes
from cannoise_jax.physics.core.mechanism import Context
from cannoise_jax.physics.core.settings import Settings, context_of, resolve


@jax.jit
def closed_moments(
    model: Camera, clean: Float[Array, "h w"], settings: Settings
) -> tuple[Float[Array, "h w"], Float[Array, "h w"]]:
    """Mean (DN) and temporal variance (DN^2) before rounding and clipping, see `chain.closed_form`. Compiled
    once for models of the same mechanisms."""
    clean = jnp.asarray(clean, jnp.float32)[None]
    context = context_of(model, clean, settings)
    mean, variance = closed_form(model, context, resolve(model, context))
    return jnp.broadcast_to(mean, clean.shape)[0], jnp.broadcast_to(variance, clean.shape)[0]


@partial(jax.jit, static_argnames="size")
def draw_maps(model: Camera, setting: tuple, size: tuple[int, int]) -> tuple[dict[str, Array], ...]:
    """The frozen maps of every mechanism, measured or drawn."""
    context = context_of(model, jnp.zeros((1, *size)), Settings(*setting))
    values = resolve(model, context)
    return tuple(maps_of(model, i, values[i], context) for i in range(len(model.mechanisms)))


@partial(jax.jit, static_argnames="frames")
def sample_codes(model: Camera, key, clean, setting: tuple, frames: int) -> UInt16[Array, "t h w"]:
    """Frames in one program."""
    return sample_digital(model, key, clean, setting, sample_analogue(model, key, clean, setting, frames))


@partial(jax.jit, static_argnames="frames")
def sample_analogue(model: Camera, key, clean, setting: tuple, frames: int) -> tuple[Array, Array]:
    """Frames in DN just before rounding, and the code step."""
    context = _context_of(model, clean, setting, frames)
    return run_chain(model, key, context, resolve(model, context), frames)


@jax.jit
def sample_digital(
    model: Camera, key, clean, setting: tuple, analogue: tuple[Array, Array]
) -> UInt16[Array, "t h w"]:
    """The codes of frames in DN: what acts on codes, rounding and the rails."""
    context = _context_of(model, clean, setting, len(analogue[0]))
    return to_codes(model, key, *analogue, context, resolve(model, context)).astype(jnp.uint16)


def _context_of(model: Camera, clean, setting: tuple, frames: int) -> Context:
    return context_of(
        model, jnp.asarray(clean, jnp.float32)[None], Settings(setting[0], setting[1], setting[2], frames)
    )
