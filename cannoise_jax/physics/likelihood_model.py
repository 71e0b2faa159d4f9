"""The likelihood of a camera model: what its mechanisms make of each pixel, and what pixels share.

Frozen maps, gains and rails enter as they are. Of mechanisms whose likelihood is approximate, offsets that
rows, columns and frames share are integrated; the light of a whole frame, which moves pixels in proportion to
their signal, is integrated alone, and beside other shared terms at the mean signal. Of the others the closed
form of mean and variance is used, their skewness left out.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cannoise_jax.physics import fields
from cannoise_jax.physics.chain import altered_noise, inside, maps_of
from cannoise_jax.physics.likelihood import CodeGrid
from cannoise_jax.physics.likelihood_crossed import SharedTerms, crossed_laplace, stationary_factor
from cannoise_jax.physics.likelihood_shared import shared_log_prob
from cannoise_jax.physics.likelihood_shot import EXACT_BELOW_E, poisson_log_prob, shot_log_prob
from cannoise_jax.physics.likelihood_tails import tukey_log_prob
from cannoise_jax.physics.mechanism import Context
from cannoise_jax.physics.sensor import SensorModel, Settings
from cannoise_jax.physics.settings import context_of, resolve

_TINY = 1e-6


class Shared(NamedTuple):
    """Offsets that pixels share, DN: factors of rows `[H, K]` and columns `[W, K]`, sigma of a frame, and
    sigma of its light as a fraction of the signal. terms: the axis ("coloured" where it is not white) and
    sigma of each."""

    rows: list[Array]
    columns: list[Array]
    frame: Any
    light: Any
    terms: list[tuple[str, Any]]


class PixelLaw(NamedTuple):
    """The law of every pixel `[H, W]` without what it shares with others. electrons: mean charge; black,
    read_sigma: DN; gain: DN/e-. tukey_lambda: shape of the read noise; poisson_share: 0 Gaussian, 1 Poisson;
    None: as usual. shared: a `Shared`."""

    electrons: Array
    gain: Array
    black: Array
    read_sigma: Array
    grid: CodeGrid
    shared: Any
    tukey_lambda: Any = None
    poisson_share: Any = None

    @property
    def mean(self) -> Array:
        """Expected value before rounding and clipping, DN."""
        return self.black + self.gain * self.electrons

    @property
    def variance(self) -> Array:
        """Variance of a pixel's own noise before rounding, DN^2."""
        return self.gain**2 * jnp.maximum(self.electrons, 0.0) + self.read_sigma**2


def pixel_law(model: SensorModel, clean: Float[np.ndarray, "h w"], settings: Settings) -> PixelLaw:
    """The law of a clean mosaic's pixels at a setting. Raises ValueError for a mechanism without
    likelihood."""
    context = context_of(model, jnp.asarray(clean, jnp.float32)[None], settings)
    values = resolve(model, context)
    noise = altered_noise(model, context, values)
    inner = inside(context, noise)
    gain = noise.gain_dn_per_e
    electrons = context.mean_dn / gain
    black, scale, read = context.black_level, jnp.ones(()), noise.read_noise_e * gain
    extra: Any = 0.0
    low: Any = 0.0
    shared = Shared([], [], 0.0, 0.0, [])
    for i, fitted in enumerate(model.mechanisms):
        record = fitted.record
        if record.baseline is not None:
            continue
        if record.likelihood == "none" or record.sample is None:
            raise ValueError(f"{fitted.mechanism} has no likelihood: use the composite score")
        maps = maps_of(model, i, values[i], inner)
        if fitted.mechanism == "black_clipping":
            low = context.black_level + values[i]["level_dn"]
        elif record.likelihood == "exact":
            # Affine in what it acts on, given the maps: two levels tell all.
            at = inner if record.acts_on in ("mean", "charge") else context
            level = context.black_level if record.acts_on == "signal" else jnp.zeros(())
            start = electrons if record.acts_on == "mean" else jnp.broadcast_to(level, electrons.shape)
            zero = record.sample(jax.random.key(0), start, values[i], maps, at)
            if record.acts_on == "mean":
                electrons = zero
                continue
            slope = record.sample(jax.random.key(0), start + 1, values[i], maps, at) - zero
            unit = gain * scale if record.acts_on == "charge" else 1.0
            black = context.black_level + (black - context.black_level) * slope + (zero - level) * unit
            scale = scale * slope
        else:
            shared, changed = _shared(fitted, record, values[i], context, inner, shared)
            if changed:
                continue
            if record.effect is None:
                raise ValueError(f"{fitted.mechanism} has no closed form: use the composite score")
            effect = record.effect(values[i], maps, inner)
            if effect.mean is not None:
                black = black + effect.mean  # of a small change of the mean the shot noise is in `variance`
            if effect.variance is not None:
                extra = extra + effect.variance
    gain = gain * scale
    read = jnp.sqrt(jnp.maximum((read * scale) ** 2 + extra, _TINY))
    step = jnp.where(noise.code_step > 0, noise.code_step, 1.0)
    # Analogue values below the cut are stored as the code nearest to it.
    grid = CodeGrid(step, jnp.maximum(jnp.round(low / step) * step, 0.0), jnp.asarray(context.white_level))

    def image(v) -> Array:
        return jnp.broadcast_to(v, (1, *context.size))[0]

    return PixelLaw(
        image(electrons), image(gain), image(black), image(read), CodeGrid(*(image(v) for v in grid)),
        shared, noise.tukey_lambda, noise.poisson_share,
    )  # fmt: skip


def _shared(fitted, record, values, context: Context, inner: Context, shared: Shared) -> tuple[Shared, bool]:
    """The shared terms with those of one more mechanism, and whether it has any."""
    point, size = record.point, context.size
    if point.time != "redrawn" or point.distribution != "gaussian" or point.over not in _SHARED_OVER:
        return shared, False
    sigma = jnp.mean(values[record.scales])  # it may scale with the gains of the channels
    if point.combine == "multiply" and point.over != "whole":
        return shared, False
    if point.combine == "multiply":
        return shared._replace(light=jnp.hypot(shared.light, sigma)), True
    if point.acts_on == "mean":
        sigma = sigma * jnp.mean(inner.gain_dn_per_e)
    if point.over == "whole":
        terms = [*shared.terms, ("frame", sigma)]
        return shared._replace(frame=jnp.hypot(shared.frame, sigma), terms=terms), True
    count = size[0] if point.over == "row" else size[1]
    if point.spectrum == "power_law":
        factor = sigma * stationary_factor(fields.power_law_correlation(jnp.mean(values["exponent"]), count))
    elif point.group > 1:
        group = fields.group_of(point, size)
        factor = sigma * jnp.asarray(group[:, None] == np.arange(group[-1] + 1), jnp.float32)
    else:
        factor = sigma * jnp.eye(count)
    lone = point.spectrum == "white" and point.group == 1
    terms = [*shared.terms, (point.over if lone else "coloured", sigma)]
    if point.over == "row":
        return shared._replace(rows=[*shared.rows, factor], terms=terms), True
    return shared._replace(columns=[*shared.columns, factor], terms=terms), True


_SHARED_OVER = ("row", "column", "whole")


Form = Literal["gaussian", "skewed", "counts", "tukey"]


def pixel_form(law: PixelLaw) -> Form:
    """The pixel likelihood that a law needs: "counts" where some pixels hold too few electrons for their
    skewness to tell all."""
    if law.tukey_lambda is not None:
        return "tukey"
    if law.poisson_share is not None and float(np.mean(law.poisson_share)) < 0.5:
        return "gaussian"
    return "counts" if bool(np.any(np.asarray(law.electrons) < EXACT_BELOW_E)) else "skewed"


def pixel_log_prob(
    law: PixelLaw, codes: Float[Array, "... h w"], form: Form, offset=0.0
) -> Float[Array, "... h w"]:
    """Log-probability of codes, DN, given offsets that are added to the mean, DN."""
    black = law.black + offset
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
) -> Float[Array, "t"]:
    """Log-probability of each frame, nats. Raises ValueError for a mechanism without likelihood."""
    law = pixel_law(model, clean, settings)
    form, shared, law = pixel_form(law), law.shared, law._replace(shared=None)
    codes = jnp.asarray(frames, jnp.float32)
    height, width = codes.shape[1:]
    has_light = bool(np.any(np.asarray(shared.light) > 0))
    signal = law.gain * law.electrons
    level = jnp.mean(signal)
    if not shared.terms and not has_light:
        return _independent(law, codes, form)
    if not shared.terms:
        return _nested(law, codes, level * shared.light, signal / jnp.maximum(level, _TINY), form, "frame")
    if len(shared.terms) == 1 and not has_light and shared.terms[0][0] != "coloured":
        over, sigma = shared.terms[0]
        return _nested(law, codes, sigma, jnp.ones_like(signal), form, over)
    terms = SharedTerms(
        jnp.concatenate(shared.rows or [jnp.zeros((height, 1))], axis=1),
        jnp.concatenate(shared.columns or [jnp.zeros((width, 1))], axis=1),
        jnp.hypot(shared.frame, shared.light * level),
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
