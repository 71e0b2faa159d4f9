"""Mechanisms of the pixel that act on collected charge: leaks, traps, the full well, and fixed offsets."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from cannoise_jax.mechanisms import imprints, looks
from cannoise_jax.mechanisms.entry import DARK, FLAT, LADDER, Case, Entry, Examples, Shot
from cannoise_jax.physics.core import fields
from cannoise_jax.physics.core.grammar import Point, mechanism_from_grammar
from cannoise_jax.physics.core.mechanism import Context, Effect, Mechanism, Parameter, Scaling, effect_in_dn
from cannoise_jax.physics.core.mosaic_ops import cut_above, shifted
from cannoise_jax.physics.core.poisson_gaussian import sample_normal
from cannoise_jax.physics.transfer import maps as measured
from cannoise_jax.physics.transfer.bent import of_straight, small_signal
from cannoise_jax.physics.transfer.estimator import Estimator
from cannoise_jax.physics.transfer.estimators import light, maps, particles, telegraph
from cannoise_jax.vocabulary import RMS, Term

_JANESICK = "Janesick, Photon Transfer, SPIE Press 2007"


def _bend(key, x, values, maps, context: Context):
    return x * (1 - values["loss"] * _share(x, values["order"], context))


def _share(charge, order, context: Context):
    """Charge over that of the white level, to the power `order`, of the charge's sign."""
    share = charge * context.gain_dn_per_e / context.span_dn
    return jnp.sign(share) * jnp.abs(share) ** order


def _bend_effect(values, maps, context):
    mu, p = context.mean_charge(), values["order"]
    lost = values["loss"] * _share(mu, p, context)
    each = lost / jnp.maximum(jnp.abs(mu), 1e-6) * jnp.sign(mu)
    # Moments of a curve of Poisson N to the second derivative, which of order 1 are exact.
    slope, bend = 1 - (p + 1) * lost, -(p + 1) * p * each
    variance = mu * (slope**2 + slope * bend + bend**2 / 4 * (1 + 2 * mu))
    return effect_in_dn(context, -mu * lost + bend * mu / 2, variance - mu)


NONLINEARITY = Mechanism(
    id="nonlinearity",
    point=Point("pixel", "charge", "frame", "frozen", "multiply", signal=1.0),
    parameters=(
        Parameter("loss", "1", 0.02, -0.49, 0.49, "share of the signal lost at white"),
        Parameter("order", "1", 1.0, 1.0, 4.0, "power of the signal by which that share grows", absent=1.0),
    ),
    equation=r"e \to e\,(1 - a\,(K e/(W-b))^p)",
    sentence="Charge lowers the voltage that collects it, so bright signals read a little too low.",
    reference="EMVA 1288 release 4.0, section 6.7 (linearity error); " + _JANESICK,
    needs=("flat", "exposure"),
    confused_with=("saturation", "prnu", "reference_error", "brighter_fatter"),
    amplitude=lambda values, context: values["loss"],
    sample=_bend,
    effect=_bend_effect,
)


def _saturation_effect(values, maps, context):
    mu = context.mean_charge()
    # Shot noise is near Gaussian at any full well.
    mean, variance = cut_above(mu, jnp.maximum(mu, 1e-6), values["full_well_e"])
    return effect_in_dn(context, mean - mu, variance - mu)


SATURATION = Mechanism(
    id="saturation",
    point=Point("pixel", "charge", "pixel", "frozen", "multiply"),
    parameters=(Parameter("full_well_e", "e-", 1000.0, 1.0, 1e7, "charge at which a pixel is full"),),
    equation=r"e \to \min(e, e_{FW})",
    sentence="A full pixel holds no more electrons: highlights flatten below the white level, without noise.",
    reference="EMVA 1288 release 4.0, section 6.6 (saturation capacity)",
    needs=("pair", "flat"),
    confused_with=("nonlinearity", "bookkeeping"),
    amplitude=lambda values, context: (
        jnp.mean(context.gain_dn_per_e / context.span_dn) * values["full_well_e"]
    ),
    sample=lambda key, x, values, maps, context: jnp.minimum(x, values["full_well_e"]),
    effect=_saturation_effect,
)


DSNU = mechanism_from_grammar(
    Point("pixel", "charge", "pixel", "frozen"),
    id="dsnu",
    default=0.5,
    equation=r"y_{tij} \to y_{tij} + \sigma d_{ij}",
    sentence="Pixels differ a little in their dark value, always by the same amount: a fixed pattern that a "
    "dark average removes.",
    reference="EMVA 1288 release 4.0, section 4.2 (DSNU1288)",
    needs=("dark", "pair_independent"),
    confused_with=("prnu", "hot_pixels", "amp_glow", "row_fpn", "column_fpn"),
)


def _rts_maps(key, values, context: Context):
    sites = jax.random.uniform(key, (1, *context.size)) < values["fraction"]
    return {"sites": sites.astype(jnp.float32)}


def _rts(key, x, values, maps, context: Context):
    state = fields.telegraph(key, x.shape[0], context.size, values["rate"])
    return x + values["jump_dn"] / context.gain_dn_per_e / 2 * maps["sites"] * state


def _rts_effect(values, maps, context):
    power = (values["jump_dn"] * maps["sites"][0]) ** 2 / 4
    memory = 1 - 2 * values["rate"]
    return Effect(variance=power, fourth=-2 * power**2, temporal={n: power * memory**n for n in (1, 2)})


RTS = Mechanism(
    id="rts",
    point=Point("pixel", "charge", "pixel", "telegraph", distribution="sparse"),
    parameters=(
        Parameter("jump_dn", "DN", 10.0, 0.0, 1e4, "distance of the two levels"),
        Parameter("fraction", "1", 0.01, 1e-6, 1.0, "share of the pixels"),
        Parameter("rate", "1/frame", 0.2, 0.0, 1.0, "chance of a jump from one frame to the next"),
    ),
    equation=r"y_{tij} \to y_{tij} \pm J/2 \ \mathrm{at\ listed\ pixels}",
    sentence="A single trap in a pixel's transistor fills and empties: the pixel blinks between two values.",
    reference="Wang, Rao, Mierop and Theuwissen, Random Telegraph Signal in CMOS Image Sensor Pixels, IEDM "
    "2006",
    needs=("dark", "burst"),
    confused_with=("heavy_tails", "pixel_read_noise_map", "hot_pixels"),
    amplitude=lambda values, context: values["jump_dn"] / 2 * jnp.sqrt(values["fraction"]),
    sample=_rts,
    draw_maps=_rts_maps,
    effect=_rts_effect,
    scaling=Scaling(gain=1.0),
    scales="jump_dn",
)


def _cosmic(key, x, values, maps, context: Context):
    where, charge = jax.random.split(key)
    chance = values["rate"] * 1e-6 * context.exposure_s
    hits = jax.random.uniform(where, x.shape) < chance
    energy = hits * jax.random.exponential(charge, x.shape) * values["charge_e"]
    return x + 0.5 * energy + 0.3 * shifted(energy, 0, 1) + 0.2 * shifted(energy, 1, 1)


def _cosmic_effect(values, maps, context):
    chance, q = values["rate"] * 1e-6 * context.exposure_s, values["charge_e"]
    # An exponential charge has a second moment of 2 q^2; the track spreads it over three pixels.
    power = chance * q**2 * (2 - chance) * (0.25 + 0.09 + 0.04)
    ones = jnp.ones((1, *context.size))
    return effect_in_dn(context, chance * q * ones, power * ones)


COSMIC_RAYS = Mechanism(
    id="cosmic_rays",
    point=Point("pixel", "charge", "pixel", "redrawn", distribution="sparse"),
    parameters=(
        Parameter("rate", "1/(Mpx s)", 5000.0, 0.0, 1e9, "events per megapixel and second"),
        Parameter("charge_e", "e-", 500.0, 1.0, 1e6, "mean charge of an event"),
    ),
    equation=r"e \to e + \sum_k q_k\,h(\mathrm{r} - \mathrm{r}_k)",
    sentence="A charged particle crosses the sensor: a bright short track in one frame that never returns.",
    reference="Groom, Cosmic rays and other nonsense in astronomical CCD imagers, Exp. Astron. 14, 45 (2002)",
    needs=("burst", "dark"),
    confused_with=("hot_pixels", "heavy_tails"),
    amplitude=lambda values, context: values["rate"],
    sample=_cosmic,
    effect=_cosmic_effect,
)


def _multiply(key, x, values, maps, context: Context):
    """Gamma-distributed output of an electron multiplier, by the cube of a normal (Wilson and Hilferty)."""
    excess = jnp.maximum(values["excess"], 1e-6)
    shape = jnp.maximum(x, 1e-6) / excess
    root = 1 - 1 / (9 * shape) + sample_normal(key, x.shape) / (3 * jnp.sqrt(shape))
    return jnp.where(x > 0, excess * shape * jnp.maximum(root, 0.0) ** 3, x)


def _multiply_effect(values, maps, context):
    return effect_in_dn(context, variance=values["excess"] * context.mean_charge())


EXCESS_NOISE = Mechanism(
    id="excess_noise",
    point=Point("pixel", "charge", "pixel", "redrawn", signal=0.5),
    parameters=(Parameter("excess", "1", 0.3, 0.0, 3.0, "excess noise factor F^2, minus one"),),
    equation=r"e \to \Gamma(e/x,\ x),\quad F^2 = 1 + x",
    sentence="Electron multiplication is itself random: shot noise grows though the signal is the same.",
    reference="Robbins and Hadwen, The noise performance of electron multiplying CCDs, IEEE TED 50, 1227 "
    "(2003)",
    needs=("flat", "pair"),
    confused_with=("gain_error",),
    amplitude=lambda values, context: values["excess"],
    sample=_multiply,
    effect=_multiply_effect,
)

ENTRIES: tuple[Entry, ...] = (
    Entry(
        Term("saturation",
             "Pixels hold no more charge than their full well.",
             9, "sensor", "1",
             "full well in normalised units: the clean signal at which the pixel is full", listed=60),
        SATURATION,
        needs="scenes or flats of several levels, two frames or more each, up to the white level",
        signatures=lambda recorded: (
            looks.curve.ceiling(recorded, name="saturation", parameter="full_well_e",
                covers=("saturation", *looks.CURVES, "skewness", "kurtosis", *looks.SCENES)),
        ),
        estimator=Estimator(light.saturation, exact=True),
        examples=Examples("high codes", shown={"full_well_e": 900.0}, strong={"full_well_e": 420.0},
                          cases=(Case({"full_well_e": 5000.0}, (*FLAT, Shot("flat", 0.9))),)),
    ),
    Entry(
        Term("excess_noise",
             "Random gain of an electron multiplier raises the shot noise.",
             3, "sensor", "1", "excess noise factor F^2, minus one", listed=370),
        EXCESS_NOISE,
        needs="flats at five levels and the gain from another source, such as single-photon peaks",
        signatures=lambda recorded: (
            looks.random_gain.skewed(recorded, name="excess_skewness", covers=imprints.EXCESS,
                lifted_by=imprints.EXCESS),
        ),
        examples=Examples("variance"),
    ),
    Entry(
        Term("nonlinearity",
             "The response bends: the mean signal is not proportional to the light.",
             8, "sensor", "1", "fraction of the signal lost at the white level", listed=50),
        NONLINEARITY,
        needs="scenes with an independent reference that spans the range, or flats of one lamp at three "
        "exposures or more",
        signatures=lambda recorded: (
            looks.curvature.curved(recorded, name="curvature", parameter="loss",
                                   covers=(*looks.SCALES, *looks.CURVES)),
            looks.response.of_flats(recorded, name="curvature_of_flats", parameter="loss", order="order",
                                    covers=(looks.BENT,), lifted_by=(looks.BENT,)),
        ),
        estimator=Estimator(light.nonlinearity, least=3e-3, corrects=small_signal, straight=of_straight),
        examples=Examples("mean", shown={"loss": 0.1}, strong={"loss": 0.2},
                          cases=(Case({"loss": 0.03}, LADDER),)),
    ),
    Entry(
        Term("rts",
             "Random telegraph signal: a few pixels jump between two levels.",
             28, "sensor", "DN", RMS, listed=140),
        RTS,
        needs="three dark frames or more whose noise exceeds two thirds of a code; a hundred show the two "
        "levels",
        signatures=looks.always(
            looks.telegraph.jumping(name="telegraph", mechanism="rts", covers=looks.NOISY,
                                    fixed="hot_additive", growing="hot_thermal",
                                    imprints=imprints.STANDING_OUT),
            looks.jumps_beside.beside_a_map(name="telegraph_beside", after="pixel_spread",
                                            simulate=looks.telegraph.simulated, covers=looks.COVERS_NOTHING),
        ),
        estimator=Estimator(telegraph.rts, white=True, law="telegraph", loud=telegraph.telegraph_sites,
                            maps=measured.telegraph),
        examples=Examples("spread", shown={"jump_dn": 12.0, "fraction": 0.05}, dim=True,
                          strong={"jump_dn": 12.0, "fraction": 0.3},
                          cases=(Case({"jump_dn": 40.0, "fraction": 0.03, "rate": 0.2},
                                      (Shot("dark", frames=16),)),)),
    ),
    Entry(
        Term("dsnu",
             "Dark-signal non-uniformity: every pixel has its own fixed offset.",
             20, "sensor", "DN", RMS, listed=30),
        DSNU,
        needs="darks of two frames or more",
        signatures=looks.wherever(
            looks.patterns.pixel("additive", name="pixel_additive_static", parameter="sigma_dn",
                covers=looks.DARK_LEVELS),
            looks.patterns.pixel("codes", name="pixel_additive_static_behind_gain", parameter="sigma_dn",
                covers=looks.DARK_LEVELS),
            looks.patterns.pixel("exposure", name="pixel_thermal_static", parameter="sigma_dn",
                covers=looks.DARK_LEVELS, charge_of=("dark_current", "compensated_dark_current")),
        ),
        estimator=Estimator(maps.dsnu, frozen=True, maps=measured.offsets),
        examples=Examples("spatial", dim=True, strong={"sigma_dn": 3.0},
                          cases=(Case({"sigma_dn": 0.5}, DARK),)),
    ),
)  # fmt: skip

EARLY = (
    Entry(
        Term("cosmic_rays",
             "Single bright tracks that do not repeat.",
             24, "sensor", "1/(Mpx s)", "events per megapixel and second", listed=300),
        COSMIC_RAYS,
        needs="long darks, ten frames or more",
        signatures=looks.always(
            looks.events.hits(name="hits", covers=("hits", "clocking"), lifted_by=imprints.HITS),
        ),
        estimator=Estimator(particles.cosmic_rays),
        examples=Examples("tail", shown={"rate": 600.0, "charge_e": 300.0}, dim=True,
                          strong={"rate": 40000.0, "charge_e": 60.0},
                          cases=(Case({"rate": 6.0, "charge_e": 2000.0},
                                      (Shot("dark", exposure_s=100.0),)),)),
    ),
)  # fmt: skip
