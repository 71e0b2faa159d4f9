"""Mechanisms of the analogue-digital converter and of what stores its codes: the lattice of codes and its
ends."""

from __future__ import annotations

import jax.numpy as jnp

from cannoise_jax.physics.core import scores
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import Context, Effect, Mechanism, Parameter
from cannoise_jax.physics.core.mosaic_ops import cut_below


def _clip_effect(values, maps, context):
    own = context.own_variance()
    mean, variance = cut_below(context.mean_dn, own, values["level_dn"])
    low = jnp.min(context.black_level) + values["level_dn"]
    return Effect(mean=(mean - context.mean_dn)[0], variance=(variance - own)[0], lattice={"low": low})


BLACK_CLIPPING = Mechanism(
    id="black_clipping",
    stage="converter",
    acts_on="signal",
    point=Point("converter", "signal", "pixel", "frozen"),
    parameters=(
        Parameter("level_dn", "DN", 0.0, -1e4, 1e4, "identity", "lowest value, above the black level"),
    ),
    equation=r"y \to \max(y,\ b + \ell)",
    sentence="Codes below black are cut off, so darks keep only the upper half of their noise and their mean "
    "is too high.",
    reference="Foi, Clipped noisy images: heteroskedastic modeling and practical denoising, Signal "
    "Processing "
    "89, 2609 (2009)",
    needs=("dark", "pair"),
    confused_with=("poisson_skew", "bookkeeping", "read_noise_error"),
    likelihood="exact",
    amplitude=lambda values, context: values["level_dn"],
    sample=lambda key, x, values, maps, context: jnp.maximum(x, context.black_level + values["level_dn"]),
    effect=_clip_effect,
)


def _compress(key, x, values, maps, context: Context):
    """Round on a scale whose step is step_dn at white and falls as signal^exponent."""
    left = 1 - jnp.minimum(values["exponent"], 0.95)
    span = context.span_dn
    signal = (x - context.black_level) / span
    level = jnp.abs(signal) ** left * span / (values["step_dn"] * left)
    back = (jnp.round(level) * values["step_dn"] * left / span) ** (1 / left)
    return context.black_level + jnp.sign(signal) * back * span


def _compress_score(z, values, maps, context: Context):
    step = values["step_dn"] * (context.mean_dn / context.span_dn) ** values["exponent"]
    return scores.variance_score(z, step**2 / 12 / context.own_variance())


def _compress_effect(values, maps, context: Context):
    # Uniform within a step, as long as the noise spans one.
    step = values["step_dn"] * (context.mean_dn / context.span_dn) ** values["exponent"]
    return Effect(variance=(step**2 / 12)[0], lattice={"step": values["step_dn"]})


LOSSY_COMPRESSION = Mechanism(
    id="lossy_compression",
    stage="converter",
    acts_on="signal",
    point=Point("converter", "signal", "pixel", "frozen", signal=0.5),
    parameters=(
        Parameter("step_dn", "DN", 8.0, 0.1, 1e4, "log", "code spacing at the white level"),
        Parameter("exponent", "1", 0.5, 0.0, 0.95, "identity", "growth of the spacing with the signal"),
    ),
    equation=r"\Delta y = \Delta_W\,((y-b)/(W-b))^p",
    sentence="The file keeps fewer codes for bright pixels, trusting that shot noise hides the steps.",
    reference="Adobe Digital Negative specification 1.7, tag LinearizationTable",
    needs=("pair", "flat"),
    confused_with=("quantization", "missing_codes", "gain_error"),
    likelihood="none",
    amplitude=lambda values, context: values["step_dn"],
    sample=_compress,
    effect=_compress_effect,
    score=_compress_score,
)

QUANTIZATION = Mechanism(
    id="quantization",
    stage="converter",
    acts_on="signal",
    point=Point("converter", "signal", "pixel", "frozen"),
    parameters=(Parameter("step_dn", "DN", 4.0, 1.0, 4096.0, "log", "spacing of the codes"),),
    equation=r"y \to q\,\mathrm{round}(y/q)",
    sentence="The converter has fewer bits than the file: codes come in steps, which add a twelfth of a "
    "squared "
    "step to the variance.",
    reference="EMVA 1288 release 4.0, section 2.3 (quantization noise)",
    needs=("pair",),
    confused_with=("missing_codes", "lossy_compression", "read_noise_error", "heavy_tails"),
    likelihood="exact",
    amplitude=lambda values, context: values["step_dn"],
    baseline=lambda noise, values, maps, context: noise._replace(code_step=values["step_dn"]),
    effect=lambda values, maps, context: Effect(lattice={"step": values["step_dn"]}),
)


def _skip_codes(key, x, values, maps, context: Context):
    period = jnp.round(values["period"])
    index = jnp.round(x / context.code_step)
    return (index + (jnp.mod(index, period) == 0)) * context.code_step


def _skip_effect(values, maps, context):
    # One code in `period` moves up by a step.
    mean = context.code_step / jnp.round(values["period"])
    return Effect(mean=mean, lattice={"missing_period": jnp.round(values["period"])})


MISSING_CODES = Mechanism(
    id="missing_codes",
    stage="converter",
    acts_on="code",
    point=Point("converter", "code", "whole", "frozen"),
    parameters=(
        Parameter("period", "code steps", 8.0, 2.0, 4096.0, "log", "one code in so many never occurs"),
    ),
    equation=r"k \to k + [\,k \ \mathrm{mod}\ p = 0\,]",
    sentence="The camera multiplied the codes after conversion, so the histogram has a comb of empty bins.",
    reference="IEEE 1241-2010, section 4 (missing codes of a converter)",
    needs=("pair",),
    confused_with=("quantization", "lossy_compression"),
    likelihood="none",
    amplitude=lambda values, context: jnp.round(values["period"]),
    sample=_skip_codes,
    effect=_skip_effect,
)

MECHANISMS: tuple[Mechanism, ...] = (LOSSY_COMPRESSION, BLACK_CLIPPING, QUANTIZATION, MISSING_CODES)
