"""Charge that is not light: it adds to the expected charge, so it brings its own shot noise."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from cannoise_jax.mechanisms import imprints, looks
from cannoise_jax.mechanisms.dark_laws import (
    THERMAL,
    VARIATION,
    WIDENHORN,
    added_charge,
    log_normal_pixels,
    of_pixels,
    per_second,
    rate_of,
)
from cannoise_jax.mechanisms.entry import LONG, SERIES, Case, Entry, Examples
from cannoise_jax.physics.core import fields
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import (
    DOUBLING_C,
    Context,
    Effect,
    Mechanism,
    Parameter,
    Scaling,
)
from cannoise_jax.physics.core.poisson_gaussian import sample_normal, sample_poisson
from cannoise_jax.physics.transfer import maps as measured
from cannoise_jax.physics.transfer.estimator import Estimator
from cannoise_jax.physics.transfer.estimators import charge, glow
from cannoise_jax.vocabulary import RMS, Term

DARK_CURRENT = Mechanism(
    id="dark_current",
    point=Point("pixel", "mean", "frame", "frozen"),
    parameters=(rate_of("mean dark current", 10.0), VARIATION),
    equation=r"\mu_{ij} \to \mu_{ij} + D\,(1 + v\,d_{ij})\,t\,2^{(T-T_0)/T_d}",
    sentence="Warm silicon frees electrons without light: the darks rise with exposure and temperature, and "
    "get noisier as they do.",
    reference=WIDENHORN,
    needs=("dark", "exposure"),
    confused_with=(
        "bookkeeping",
        "clock_induced_charge",
        "read_noise_error",
        "amp_glow",
        "compensated_dark_current",
    ),
    amplitude=per_second,
    sample=lambda key, x, values, maps, context: x + of_pixels(values, maps),
    draw_maps=log_normal_pixels,
    effect=lambda values, maps, context: added_charge(of_pixels(values, maps), context),
    scaling=THERMAL,
    scales="e_per_s",
)


def _compensated(key, x, values, maps, context: Context):
    # What scatters is left of the charge: the clamp takes its mean away.
    charge = sample_poisson(key, jnp.broadcast_to(of_pixels(values, maps), x.shape))
    return x + charge - values["share"] * values["e_per_s"]


def _compensated_effect(values, maps, context):
    added = added_charge(of_pixels(values, maps), context)
    taken = values["share"] * values["e_per_s"] * context.gain_dn_per_e
    return added._replace(mean=added.mean - jnp.broadcast_to(taken, (1, *context.size))[0])


COMPENSATED_DARK_CURRENT = Mechanism(
    id="compensated_dark_current",
    point=Point("pixel", "charge", "pixel", "redrawn"),
    parameters=(
        rate_of("dark current whose mean the camera subtracts", 10.0),
        Parameter("share", "1", 1.0, 0.0, 10.0, "what is subtracted, over its mean"),
        VARIATION,
    ),
    equation=r"e \to e + n - s\,q,\quad n \sim \mathrm{Poisson}(q\,(1 + v\,d_{ij})),\ "
    r"q = D\,t\,2^{(T-T_0)/T_d}",
    sentence="The camera clamps its black level to shielded pixels: long darks do not rise, yet the noise of "
    "the dark current stays in them.",
    reference="EMVA 1288 release 4.0, section 7 (dark current from the variance)",
    needs=("dark", "exposure", "pair"),
    confused_with=("dark_current", "read_noise_error"),
    amplitude=per_second,
    sample=_compensated,
    draw_maps=log_normal_pixels,
    effect=_compensated_effect,
    scaling=THERMAL,
    scales="e_per_s",
)


def _glow_maps(key, values, context: Context):
    """exp(-distance / length) from a point on the frame's edge that the camera unit has."""
    height, width = context.size
    side, along = jax.random.split(key)
    side, along = jax.random.randint(side, (), 0, 4), jax.random.uniform(along)
    y0 = jnp.select([side == 0, side == 1], [0.0, height - 1.0], along * (height - 1))
    x0 = jnp.select([side == 2, side == 3], [0.0, width - 1.0], along * (width - 1))
    y, x = jnp.arange(height)[:, None] - y0, jnp.arange(width)[None, :] - x0
    distance = jnp.sqrt(y**2 + x**2) / max(height, width)
    return {"glow": jnp.exp(-distance / values["length"])[None]}


def _glow_amplitude(values, context):
    # The mean square of exp(-d / L) around a point on the edge, its half plane taken to hold all of it.
    height, width = context.size
    area = math.pi / 4 * values["length"] ** 2 * max(height, width) ** 2 / (height * width)
    return jnp.mean(context.gain_dn_per_e) * values["e_per_s"] * jnp.sqrt(jnp.minimum(1.0, area))


AMP_GLOW = Mechanism(
    id="amp_glow",
    point=Point("pixel", "mean", "pixel", "frozen"),
    parameters=(
        rate_of("at the brightest point", 100.0),
        Parameter("length", "frame sides", 0.2, 0.01, 10.0, "distance over which it falls to 1/e"),
    ),
    equation=r"\mu_{ij} \to \mu_{ij} + G\,t\,e^{-d_{ij}/L}",
    sentence="The readout amplifier glows and lights up the nearest edge or corner in long exposures.",
    reference="Janesick, Scientific Charge-Coupled Devices, SPIE Press 2001, chapter 7 (luminescence)",
    needs=("dark", "exposure"),
    confused_with=("dsnu", "lens_shading", "dark_current"),
    amplitude=_glow_amplitude,
    sample=lambda key, x, values, maps, context: x + values["e_per_s"] * maps["glow"],
    draw_maps=_glow_maps,
    effect=lambda values, maps, context: added_charge(values["e_per_s"] * maps["glow"], context),
    scaling=Scaling(exposure=1.0),
    scales="e_per_s",
)


def _hot_maps(key, values, context: Context):
    where, height = jax.random.split(key)
    shape = (1, *context.size)
    return {
        "heat": (jax.random.uniform(where, shape) < values["fraction"])
        * jax.random.exponential(height, shape)
    }


HOT_PIXELS = Mechanism(
    id="hot_pixels",
    point=Point("pixel", "mean", "pixel", "frozen", distribution="sparse"),
    parameters=(
        rate_of("mean over the hot pixels; their heights are exponential", 2000.0),
        Parameter("fraction", "1", 1e-3, 1e-7, 0.5, "share of hot pixels"),
    ),
    equation=r"\mu_{ij} \to \mu_{ij} + D\,h_{ij}\,t\,2^{(T-T_0)/T_d},\quad h \sim f\,\mathrm{Exp}(1)",
    sentence="Crystal defects leak strongly in a few pixels: fixed bright dots that grow with the exposure.",
    reference=WIDENHORN,
    needs=("dark",),
    confused_with=("cosmic_rays", "rts", "dsnu"),
    amplitude=lambda values, context: (
        jnp.mean(context.gain_dn_per_e) * values["e_per_s"] * jnp.sqrt(2 * values["fraction"])
    ),
    sample=lambda key, x, values, maps, context: x + values["e_per_s"] * maps["heat"],
    draw_maps=_hot_maps,
    effect=lambda values, maps, context: added_charge(values["e_per_s"] * maps["heat"], context),
    scaling=THERMAL,
    scales="e_per_s",
)


CLOCK_INDUCED_CHARGE = Mechanism(
    id="clock_induced_charge",
    point=Point("pixel", "mean", "frame", "frozen"),
    parameters=(Parameter("charge_e", "e-", 0.01, 0.0, 1e3, "mean per pixel and frame"),),
    equation=r"\mu \to \mu + c",
    sentence="The clocking itself frees an electron now and then, in bias frames as in long exposures.",
    reference="Janesick, Scientific Charge-Coupled Devices, SPIE Press 2001, chapter 7 (spurious charge)",
    needs=("dark", "exposure"),
    confused_with=("dark_current", "bookkeeping"),
    amplitude=lambda values, context: values["charge_e"],
    sample=lambda key, x, values, maps, context: x + values["charge_e"],
    effect=lambda values, maps, context: added_charge(values["charge_e"], context),
)


def _temperature(key, x, values, maps, context: Context):
    raw = sample_normal(key, (x.shape[0], 1, 1))
    kelvin = values["sigma_k"] * fields.remember(raw, values["memory_frames"])
    charge = values["e_per_s"] * (jnp.exp2(kelvin / DOUBLING_C) - 1 + values["base"])
    return jnp.maximum(x + charge, 0.0)


def _temperature_effect(values, maps, context):
    # The dark current is log-normal over the frames.
    width = values["sigma_k"] * math.log(2) / DOUBLING_C
    charge = values["e_per_s"] * jnp.exp(width**2 / 2)
    added = charge - values["e_per_s"] * (1 - values["base"])
    gain = context.gain_dn_per_e[0]
    shared = gain**2 * charge**2 * jnp.expm1(width**2)
    rho = jnp.exp(-1.0 / values["memory_frames"])
    lagged = {n: gain**2 * charge**2 * jnp.expm1(width**2 * rho**n) for n in (1, 2)}
    return Effect(mean=gain * added, variance=gain**2 * added + shared, frame=shared, temporal=lagged)


TEMPERATURE_DRIFT = Mechanism(
    id="temperature_drift",
    point=Point("pixel", "mean", "frame", "drifting"),
    parameters=(
        Parameter("sigma_k", "K", 1.0, 0.0, 30.0, "rms temperature change"),
        Parameter("memory_frames", "frames", 8.0, 0.1, 1e4, "correlation time"),
        rate_of("dark current at the mean temperature", 100.0),
        Parameter("base", "1", 1.0, 0.0, 1.0, "share of it added here; 0: by dark_current", 1.0),
    ),
    equation=r"\mu_t \to \mu + D\,t\,(2^{\Delta T_t/T_d} - 1 + b)",
    sentence="The sensor warms up while it records, and its dark current with it, from frame to frame.",
    reference=WIDENHORN,
    needs=("burst", "temperature"),
    confused_with=("offset_drift", "illumination_drift", "dark_current"),
    amplitude=lambda values, context: values["sigma_k"],
    sample=_temperature,
    effect=_temperature_effect,
    scaling=THERMAL,
    scales="e_per_s",
)

ENTRIES: tuple[Entry, ...] = (
    Entry(
        Term("dark_current",
             "Thermal charge grows with the exposure and brings its own shot noise.",
             19, "sensor", "e-/s", "mean dark current, e-/s", listed=90, says_exposure=True),
        DARK_CURRENT,
        needs="darks at two exposures or more, exposure_s stated",
        signatures=lambda recorded: (
            looks.levels.by_exposure(recorded, name="dark_level", quantity="dark_current",
                parameter="e_per_s", covers=("dark_level",)),) if recorded.several_exposures else (),
        estimator=Estimator(charge.dark_current, frozen=True, maps=measured.currents),
        examples=Examples("mean", shown={"e_per_s": 30.0}, strong={"e_per_s": 60.0},
                          cases=(Case({"e_per_s": 2.0}, SERIES),)),
    ),
    Entry(
        Term("compensated_dark_current",
             "Noise of a dark current whose mean the camera's black clamp subtracts: it grows with the "
             "exposure, the level of the darks does not.",
             None, "sensor", "e-/s", "mean dark current, e-/s", listed=530, says_exposure=True),
        COMPENSATED_DARK_CURRENT,
        needs="darks at two exposures or more, two frames of each whose noise exceeds a code, exposure_s "
        "stated, and flats for the gain",
        signatures=lambda recorded: looks.dark_noise.beside_level(
            recorded, name="dark_noise", rate="e_per_s", share="share"),
        examples=Examples("variance", shown={"e_per_s": 30.0}, dim=True, strong={"e_per_s": 60.0}),
    ),
    Entry(
        Term("amp_glow",
             "Light of the readout electronics adds charge near an edge or corner.",
             21, "sensor", "DN", RMS, listed=100),
        AMP_GLOW,
        needs="darks, best at a long exposure",
        signatures=looks.always(
            looks.glow.from_edges(name="glow", parameter="e_per_s",
                covers=looks.SMOOTH, before=(*looks.MAPS, *looks.THERMAL_LINES, *looks.HOT),
                lifted_by=("dark_level",)),
        ),
        estimator=Estimator(glow.amp_glow, without=glow.without_glow, maps=measured.glow),
        examples=Examples("columns", strong={"e_per_s": 200.0, "length": 0.4},
                          cases=(Case({"e_per_s": 3.0, "length": 0.2}, LONG),)),
    ),
    Entry(
        Term("hot_pixels",
             "A few pixels have a dark current far above the others, at fixed places.",
             22, "sensor", "DN", RMS, listed=110),
        HOT_PIXELS,
        needs="darks, best at a long exposure",
        signatures=lambda recorded: (
            looks.hot.standing_out(recorded, "additive", name="hot_additive", maps=looks.MAPS,
                covers=("hot_thermal",), lifted_by=imprints.STANDING_OUT),
            looks.hot.standing_out(recorded, "exposure", name="hot_thermal", maps=looks.MAPS,
                covers=("hot_additive",), lifted_by=imprints.STANDING_OUT),
        ),
        estimator=Estimator(charge.hot_pixels, frozen=True, maps=measured.heat),
        examples=Examples("tail", shown={"e_per_s": 300.0, "fraction": 0.004}, dim=True,
                          strong={"fraction": 0.1, "e_per_s": 100.0},
                          cases=(Case({"e_per_s": 50.0, "fraction": 0.02}, LONG),
                          Case({"e_per_s": 300.0, "fraction": 0.05}, LONG, note="strong"))),
    ),
    Entry(
        Term("clock_induced_charge",
             "Spurious charge of the clocking, the same in every exposure time.",
             4, "sensor", "e-", "mean charge per pixel and frame, e-", listed=400,
             says_exposure=True),
        CLOCK_INDUCED_CHARGE,
        needs="several hundred short darks of an electron-multiplying sensor",
        signatures=looks.always(
            looks.clocking.clocking(name="clocking", mechanism="clock_induced_charge",
                                  covers=("hits", "clocking"), lifted_by=imprints.HITS),
        ),
        examples=Examples("variance", shown={"charge_e": 2.0}, dim=True, strong={"charge_e": 5.0}),
    ),
    Entry(
        Term("temperature_drift",
             "The temperature, and with it the dark current, moves from frame to frame.",
             25, "sensor", "K", "rms temperature change, K", listed=440),
        TEMPERATURE_DRIFT,
        needs="darks with the temperature of every frame stated",
        signatures=looks.always(
            looks.warm.warming(name="warm", offsets=("frame_additive",), lifted_by=imprints.WARM,
                beside={id: {"base": 0.0} for id in ("dark_current", "compensated_dark_current")}),
        ),
        examples=Examples("frames", shown={"e_per_s": 50.0, "sigma_k": 3.0},
                          strong={"sigma_k": 4.0, "e_per_s": 120.0, "memory_frames": 1.5}),
    ),
)  # fmt: skip
