"""The likelihood of frames under a camera model, of the laws of its pixels and what they share.

Offsets that rows, columns and frames share are integrated; the light of a whole frame is integrated alone,
and beside other shared terms at the mean light. See `likelihood_law` for the law of a pixel.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.likelihood.codes import gaussian_log_prob, log_normal_cdf
from cannoise_jax.physics.likelihood.crossed import SharedTerms, crossed_laplace
from cannoise_jax.physics.likelihood.law import TINY, PixelLaw, pixel_law
from cannoise_jax.physics.likelihood.shared import shared_log_prob
from cannoise_jax.physics.likelihood.shot import EXACT_BELOW_E, poisson_log_prob, shot_log_prob
from cannoise_jax.physics.likelihood.tails import tukey_log_prob

__all__ = ["Form", "PixelLaw", "frame_log_prob", "pixel_form", "pixel_law", "pixel_log_prob"]

Form = Literal["gaussian", "skewed", "counts", "tukey"]


def pixel_form(law: PixelLaw) -> Form:
    """The pixel likelihood that a law needs: "counts" where some pixels hold too few electrons for their
    skewness to tell all, and where the law is traced and nobody can tell."""
    if law.tukey_lambda is not None:
        return "tukey"
    if any(isinstance(v, jax.core.Tracer) for v in (law.electrons, law.poisson_share)):
        return "counts" if law.poisson_share is None else "gaussian"
    if law.poisson_share is not None and float(np.mean(law.poisson_share)) < 0.5:
        return "gaussian"
    return "counts" if bool(np.any(np.asarray(law.electrons) < EXACT_BELOW_E)) else "skewed"


def pixel_log_prob(
    law: PixelLaw, codes: Float[Array, "... h w"], form: Form, offset=0.0
) -> Float[Array, "... h w"]:
    """Log-probability of codes, DN, given offsets that are added to the mean, DN."""
    black = law.black + offset
    free = _free_log_prob(law, codes, form, black)
    if law.full_e is None:
        return free
    # Normal charge cut at the full well: a code is of a free pixel, as far as its charge is then below the
    # well, or of a full one, which has read noise alone.
    shot, read = law.gain**2 * jnp.maximum(law.electrons, TINY), law.read_sigma**2
    full, mean = black + law.gain * law.full_e, black + law.gain * law.electrons
    spread = read + jnp.square(law.grid.step) / 12
    charge = (mean * spread + codes * shot) / (shot + spread)
    below = log_normal_cdf((full - charge) / jnp.sqrt(shot * spread / (shot + spread)))
    above = log_normal_cdf((mean - full) / jnp.sqrt(shot))
    if form == "tukey":
        there = tukey_log_prob(codes, full, TINY, law.read_sigma, jnp.mean(law.tukey_lambda), law.grid)
    else:
        there = gaussian_log_prob(codes, full, read, law.grid)
    return jnp.logaddexp(free + below, above + there)


def _free_log_prob(law: PixelLaw, codes, form: Form, black) -> Float[Array, "... h w"]:
    """Of pixels that are never full."""
    if form == "tukey":
        shot = law.gain**2 * jnp.maximum(law.electrons, 0.0)
        mean = black + law.gain * law.electrons
        return tukey_log_prob(codes, mean, shot, law.read_sigma, jnp.mean(law.tukey_lambda), law.grid)
    args = (law.electrons, law.gain, black, law.read_sigma, law.grid)
    if form == "gaussian":
        return shot_log_prob(codes, *args, "gaussian")
    skewed = shot_log_prob(codes, *args, "skewed")
    if form == "skewed":
        return skewed
    return jnp.where(law.electrons < EXACT_BELOW_E, poisson_log_prob(codes, *args), skewed)


def frame_log_prob(
    model: SensorModel,
    frames: Float[np.ndarray, "t h w"],
    clean: Float[np.ndarray, "h w"],
    settings: Settings,
    form: Form | None = None,
) -> Float[Array, "t"]:
    """Log-probability of each frame, nats: differentiable in the model's numbers and the clean mosaic, works
    under jit.

    form: default that of `pixel_form`; under jit and grad it cannot see the light, and the form of a law that
      is not traced saves time: `pixel_form(pixel_law(model, clean, settings))`.
    Raises ValueError for a mechanism without likelihood.
    """
    law = pixel_law(model, clean, settings)
    form, shared, law = form or pixel_form(law), law.shared, law._replace(shared=None)
    codes = jnp.asarray(frames, jnp.float32)
    height, width = codes.shape[1:]
    has_light = shared.light is not None
    signal = jnp.broadcast_to(0.0 if shared.lit is None else shared.lit, (1, height, width))[0]
    level = jnp.mean(signal)
    if not shared.terms and not has_light:
        return _independent(law, codes, form)
    if not shared.terms:
        return _nested(law, codes, level * shared.light, signal / jnp.maximum(level, TINY), form, "frame")
    if len(shared.terms) == 1 and not has_light and shared.terms[0][0] != "coloured":
        over, sigma = shared.terms[0]
        return _nested(law, codes, sigma, jnp.ones_like(signal), form, over)
    terms = SharedTerms(
        jnp.concatenate(shared.rows or [jnp.zeros((height, 1))], axis=1),
        jnp.concatenate(shared.columns or [jnp.zeros((width, 1))], axis=1),
        jnp.hypot(shared.frame, shared.light * level) if has_light else jnp.asarray(shared.frame),
    )
    return _crossed(law, codes, terms, form)


@partial(jax.jit, static_argnames="form")
def _independent(law: PixelLaw, codes: Float[Array, "t h w"], form: Form) -> Float[Array, "t"]:
    return pixel_log_prob(law, codes, form).sum((1, 2))


@partial(jax.jit, static_argnames=("form", "over"))
def _nested(law: PixelLaw, codes, sigma, weight, form: Form, over: str) -> Float[Array, "t"]:
    """One white term of rows, columns or frames; weight: what an offset of 1 adds to a pixel."""
    count, height, width = codes.shape
    shape = {"row": (count, height, 1), "column": (count, 1, width), "frame": (count, 1, 1)}[over]

    def grouped(offset):
        found = pixel_log_prob(law, codes, form, weight * offset.reshape(shape))
        if over == "column":
            found = found.transpose(0, 2, 1)
        return found.reshape(offset.shape[0], -1)

    return shared_log_prob(grouped, sigma, math.prod(shape)).reshape(count, -1).sum(1)


@partial(jax.jit, static_argnames="form")
def _crossed(law: PixelLaw, codes, terms: SharedTerms, form: Form) -> Float[Array, "t"]:
    """Several terms, or coloured ones, frame by frame."""

    def of_frame(frame):
        return crossed_laplace(
            lambda offset: pixel_log_prob(law, frame, form, offset), terms, (codes.shape[1], codes.shape[2])
        )

    return jax.lax.map(of_frame, codes)
