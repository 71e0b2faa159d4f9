"""Mechanisms of the analogue-digital converter and of what stores its codes: the lattice of codes and its
ends."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from cannoise_jax.mechanisms import imprints, looks
from cannoise_jax.mechanisms.entry import DARK, FLAT, Case, Entry, Examples
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import Context, Effect, Mechanism, Parameter
from cannoise_jax.physics.core.mosaic_ops import cut_below
from cannoise_jax.physics.transfer.estimator import Estimator
from cannoise_jax.physics.transfer.estimators import codes
from cannoise_jax.vocabulary import Term


def _clip_effect(values, maps, context):
    own = context.own_variance()
    mean, variance = cut_below(context.mean_dn, own, values["level_dn"])
    low = jnp.min(context.black_level) + values["level_dn"]
    return Effect(mean=(mean - context.mean_dn)[0], variance=(variance - own)[0], lattice={"low": low})


BLACK_CLIPPING = Mechanism(
    id="black_clipping",
    point=Point("converter", "signal", "pixel", "frozen"),
    parameters=(Parameter("level_dn", "DN", 0.0, -1e4, 1e4, "lowest value, above the black level"),),
    equation=r"y \to \max(y,\ b + \ell)",
    sentence="Codes below black are cut off, so darks keep only the upper half of their noise and their mean "
    "is too high.",
    reference="Foi, Clipped noisy images: heteroskedastic modeling and practical denoising, Signal "
    "Processing 89, 2609 (2009)",
    needs=("dark", "pair"),
    confused_with=("poisson_skew", "bookkeeping", "read_noise_error"),
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


def _compress_effect(values, maps, context: Context):
    # Uniform within a step, as long as the noise spans one.
    step = values["step_dn"] * jnp.abs(context.mean_dn / context.span_dn) ** values["exponent"]
    return Effect(variance=(step**2 / 12)[0], lattice={"step": values["step_dn"]})


LOSSY_COMPRESSION = Mechanism(
    id="lossy_compression",
    point=Point("converter", "signal", "pixel", "frozen", signal=0.5),
    parameters=(
        Parameter("step_dn", "DN", 8.0, 0.1, 1e4, "code spacing at the white level"),
        Parameter("exponent", "1", 0.5, 0.0, 0.95, "growth of the spacing with the signal"),
    ),
    equation=r"\Delta y = \Delta_W\,((y-b)/(W-b))^p",
    sentence="The file keeps fewer codes for bright pixels, trusting that shot noise hides the steps.",
    reference="Adobe Digital Negative specification 1.7, tag LinearizationTable",
    needs=("pair", "flat"),
    confused_with=("quantization", "missing_codes", "gain_error"),
    amplitude=lambda values, context: values["step_dn"],
    sample=_compress,
    effect=_compress_effect,
)

QUANTIZATION = Mechanism(
    id="quantization",
    point=Point("converter", "signal", "pixel", "frozen"),
    parameters=(Parameter("step_dn", "DN", 4.0, 1.0, 4096.0, "spacing of the codes"),),
    equation=r"y \to q\,\mathrm{round}(y/q)",
    sentence="The converter has fewer bits than the file: codes come in steps, which add a twelfth of a "
    "squared step to the variance.",
    reference="EMVA 1288 release 4.0, section 2.3 (quantization noise)",
    needs=("pair",),
    confused_with=("missing_codes", "lossy_compression", "read_noise_error", "heavy_tails"),
    amplitude=lambda values, context: values["step_dn"],
    baseline=lambda noise, values, maps, context: noise._replace(code_step=values["step_dn"]),
    effect=lambda values, maps, context: Effect(lattice={"step": values["step_dn"]}),
)


def _skip_codes(key, x, values, maps, context: Context):
    index = jnp.round(x / context.code_step)
    rare = jnp.mod(index - jnp.round(values["phase"]), jnp.round(values["period"])) == 0
    chance, moved = jax.random.uniform(key, x.shape), 1 - values["kept"]
    side = jnp.where(chance < moved * values["above"], 1.0, -1.0) * (chance < moved)
    return (index + rare * side) * context.code_step


def _skip_effect(values, maps, context):
    # One code in `period` moves by a step, up or down, or stays.
    moved = (1 - values["kept"]) * context.code_step / jnp.round(values["period"])
    mean = (2 * values["above"] - 1) * moved
    return Effect(mean=mean, lattice={"missing_period": jnp.round(values["period"])})


MISSING_CODES = Mechanism(
    id="missing_codes",
    point=Point("converter", "code", "frame", "frozen"),
    parameters=(
        Parameter("period", "code steps", 8.0, 2.0, 4096.0, "one code in so many is missing, or rarer"),
        Parameter("phase", "code steps", 0.0, 0.0, 4095.0, "which of them, counted from code 0", 0.0),
        Parameter("above", "1", 1.0, 0.0, 1.0, "share of its values on the next code above, else below", 1.0),
        Parameter("kept", "1", 0.0, 0.0, 1.0, "share of its values that stay", 0.0),
    ),
    equation=r"k \to k \pm [\,k \ \mathrm{mod}\ p = \varphi\,]",
    sentence="The camera multiplied the codes after conversion, or its converter skips some: the histogram "
    "has a comb of empty bins.",
    reference="IEEE 1241-2010, section 4 (missing codes of a converter)",
    needs=("pair",),
    confused_with=("quantization", "lossy_compression"),
    amplitude=lambda values, context: jnp.round(values["period"]),
    sample=_skip_codes,
    effect=_skip_effect,
)

ENTRIES: tuple[Entry, ...] = (
    Entry(
        Term("lossy_compression",
             "Raw codes are rounded to a step that grows with the signal.",
             44, "sensor", "DN", "code spacing at the white level, DN", listed=490),
        LOSSY_COMPRESSION,
        needs="flats at ten levels up to the white level",
        signatures=lambda recorded: (
            looks.code_spacing.spacing(recorded, name="code_spacing", covers=imprints.SPACING,
                lifted_by=imprints.SPACING),
        ),
        examples=Examples("high codes", shown={"step_dn": 40.0}, strong={"step_dn": 30.0}),
    ),
    Entry(
        Term("black_clipping",
             "Values below a level near black are cut off.",
             10, "sensor", "DN", "clipping level above (positive) or below the black level, DN",
             listed=70),
        BLACK_CLIPPING,
        needs="darks",
        signatures=lambda recorded: (
            # Noise cut off at black is skewed and less where levels are lower, and means are curved, without
            # more.
            looks.codes.piled_up(recorded, name="pile_up", parameter="level_dn",
                covers=("pile_up", *looks.SHAPES, *looks.CURVES, "black_level", "black_channels", "lags_any",
                        "lags_read", "curvature", "row_spread", "column_spread", "dark_noise"),
                off=looks.HOT),
        ),
        estimator=Estimator(codes.black_clipping, exact=True),
        examples=Examples("codes", dim=True, strong={"level_dn": 60.0},
                          cases=(Case({"level_dn": -3.0}, DARK, exact=True),)),
    ),
    Entry(
        Term("quantization",
             "Codes are spaced more widely than assumed.",
             41, "sensor", "DN", "spacing of the codes, DN", ("lossy_compression",), listed=270),
        QUANTIZATION,
        needs="files that state code_step",
        signatures=lambda recorded: (
            looks.codes.coarse(recorded, name="coarse", parameter="step_dn", covers=("coarse", "comb")),
        ),
        estimator=Estimator(codes.quantization, in_baseline=True),
        examples=Examples("codes", shown={"step_dn": 8.0}, cases=(Case({"step_dn": 4.0}, DARK, exact=True),)),
    ),
    Entry(
        Term("missing_codes",
             "Some codes never occur: digital scaling or converter faults.",
             42, "sensor", "code steps", "period: one code in every so many is missing", listed=280),
        MISSING_CODES,
        needs="flats or scenes whose noise spans three codes or more",
        signatures=lambda recorded: (
            looks.codes.combed(recorded, name="comb", parameter="period", covers=("comb",),
                shapes=looks.OF_CODES),
        ),
        estimator=Estimator(codes.missing_codes, exact=True),
        examples=Examples("codes", strong={"period": 4.0}, cases=(Case({"period": 8.0}, FLAT, exact=True),)),
    ),
)  # fmt: skip
