"""Mechanisms that act on the light and on the response of the pixels to it, in proportion to the signal."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from cannoise_jax.mechanisms import imprints, looks
from cannoise_jax.mechanisms.entry import FLAT, Case, Entry, Examples
from cannoise_jax.physics.core.grammar import Point, mechanism_from_grammar
from cannoise_jax.physics.core.mechanism import Context, Effect, Mechanism, Parameter
from cannoise_jax.physics.transfer import maps as measured
from cannoise_jax.physics.transfer.estimator import Estimator
from cannoise_jax.physics.transfer.estimators import dead, maps
from cannoise_jax.recordings.packing import green_sites
from cannoise_jax.vocabulary import FRACTION, Term

_EMVA = "EMVA 1288 release 4.0, section 4.2 (PRNU1288)"

PRNU = mechanism_from_grammar(
    Point("photons", "mean", "pixel", "frozen", "multiply"),
    id="prnu",
    default=0.01,
    equation=r"\mu_{ij} \to \mu_{ij}\,(1+\sigma p_{ij})",
    sentence="Pixels differ a little in sensitivity, always by the same factor: a fixed pattern that a flat "
    "field removes.",
    reference=_EMVA,
    needs=("flat", "pair_independent"),
    confused_with=("dsnu", "column_gain", "nonlinearity", "reference_error"),
)

COLUMN_GAIN = mechanism_from_grammar(
    Point("photons", "mean", "column", "frozen", "multiply"),
    id="column_gain",
    default=0.003,
    equation=r"\mu_{ij} \to \mu_{ij}\,(1+\sigma g_j)",
    sentence="Each column's converter has its own gain: vertical stripes that grow with the light.",
    reference="EMVA 1288 release 4.0, section 8.2 (column nonuniformity)",
    needs=("flat", "pair_independent"),
    confused_with=("column_fpn", "prnu", "smear"),
)


def _green_maps(key, values, context: Context):
    cell = np.zeros(4, np.float32)
    sites = green_sites(context.cfa)
    if sites:
        cell[sites[0]], cell[sites[1]] = 1.0, -1.0
    height, width = context.size
    tiled = np.tile(cell.reshape(2, 2), ((height + 1) // 2, (width + 1) // 2))[:height, :width]
    return {"field": jnp.asarray(tiled)[None]}


GREEN_IMBALANCE = dataclasses.replace(
    mechanism_from_grammar(
        Point("photons", "mean", "channel", "frozen", "multiply"),
        id="green_imbalance",
        parameters=(Parameter("sigma", "1", 0.01, -0.5, 0.5, "Gr gains and Gb loses this share"),),
        equation=r"\mu_{Gr} \to \mu_{Gr}(1+a),\quad \mu_{Gb} \to \mu_{Gb}(1-a)",
        sentence="Green pixels beside red and beside blue see different light leak in, so a fine "
        "checkerboard appears on green areas.",
        reference="Nakamura, Image Sensors and Signal Processing for Digital Still Cameras, 2006, chapter 3",
        needs=("flat", "pair_independent"),
        confused_with=("channel_offset", "crosstalk", "prnu"),
        amplitude=lambda values, context: jnp.abs(values["sigma"]),
    ),
    draw_maps=_green_maps,
)


def _shading_maps(key, values, context: Context):
    height, width = context.size
    y = (np.arange(height) - (height - 1) / 2)[:, None] / max((height - 1) / 2, 1)
    x = (np.arange(width) - (width - 1) / 2)[None, :] / max((width - 1) / 2, 1)
    return {"field": jnp.asarray(-(x**2 + y**2) / 2, jnp.float32)[None]}


LENS_SHADING = dataclasses.replace(
    mechanism_from_grammar(
        Point("photons", "mean", "pixel", "frozen", "multiply"),
        id="lens_shading",
        parameters=(Parameter("sigma", "1", 0.1, -1.0, 1.0, "share of the signal lost in the corners"),),
        equation=r"\mu \to \mu\,(1 - v\,r^2/r_{corner}^2)",
        sentence="The lens and the tilt of the rays take light from the corners, smoothly.",
        reference="Nakamura, Image Sensors and Signal Processing for Digital Still Cameras, 2006, chapter 2",
        needs=("flat",),
        confused_with=("reference_error", "prnu"),
    ),
    draw_maps=_shading_maps,
)


def _dead_maps(key, values, context: Context):
    import jax

    return {"dead": (jax.random.uniform(key, (1, *context.size)) < values["fraction"]).astype(jnp.float32)}


def _dead_effect(values, maps, context):
    lost = context.mean_dn[0] * maps["dead"][0]
    gain = context.gain_dn_per_e
    return Effect(mean=-lost, variance=(-gain * lost)[0])


DEAD_PIXELS = Mechanism(
    id="dead_pixels",
    point=Point("pixel", "mean", "pixel", "frozen", "multiply", distribution="sparse"),
    parameters=(Parameter("fraction", "1", 0.001, 1e-7, 0.5, "share of the pixels"),),
    equation=r"\mu_{ij} \to 0 \ \mathrm{at\ listed\ pixels}",
    sentence="A broken pixel gives the black level whatever the light.",
    reference="EMVA 1288 release 4.0, section 4.4 (defect pixels)",
    needs=("flat", "pair_independent"),
    confused_with=("prnu", "defect_correction"),
    amplitude=lambda values, context: values["fraction"],
    sample=lambda key, x, values, maps, context: x * (1 - maps["dead"]),
    draw_maps=_dead_maps,
    effect=_dead_effect,
)

ENTRIES: tuple[Entry, ...] = (
    Entry(
        Term("lens_shading",
             "Sensitivity falls smoothly towards the corners.",
             15, "sensor", "1", "fraction of the signal lost in the corners", ("prnu",), listed=430),
        LENS_SHADING,
        needs="flats with a reference of the light falling on the sensor (clean)",
        signatures=lambda recorded: (
            looks.light.shaded(recorded, name="shading", parameter="sigma", covers=("shading",
        *looks.SCALES)), ),
        examples=Examples("radius", strong={"sigma": 0.3}),
    ),
    Entry(
        Term("prnu",
             "Photo-response non-uniformity: every pixel has its own fixed sensitivity.",
             5, "sensor", "1", FRACTION, listed=20),
        PRNU,
        needs="flats of two frames or more, or scenes with an independent reference",
        signatures=looks.always(
            looks.patterns.pixel("signal", name="pixel_relative_static", parameter="sigma",
                covers=looks.LIGHT_LEVELS),
        ),
        estimator=Estimator(maps.prnu, least=1e-3, of_light=True, maps=measured.response),
        examples=Examples("spatial", shown={"sigma": 0.03}, strong={"sigma": 0.1},
                          cases=(Case({"sigma": 0.005}, FLAT),)),
    ),
    Entry(
        Term("column_gain",
             "Every column has its own fixed gain.",
             6, "sensor", "1", FRACTION, ("prnu",), listed=40),
        COLUMN_GAIN,
        needs="flats of two frames or more, or scenes with an independent reference",
        signatures=looks.always(
            looks.line_maps.frozen("column", "signal", name="column_relative_static", parameter="sigma",
                covers=looks.LIGHT_LEVELS),
        ),
        estimator=Estimator(maps.column_gain, white=True, least=3e-4, of_light=True,
                            maps=measured.column_response),
        examples=Examples("columns", shown={"sigma": 0.02}, strong={"sigma": 0.1},
                          cases=(Case({"sigma": 0.002}, FLAT),)),
    ),
    Entry(
        Term("green_imbalance",
             "The two green channels differ in sensitivity.",
             49, "sensor", "1",
             "rms fraction of the signal over the green pixels: half of the relative difference", ("prnu",),
             listed=260),
        GREEN_IMBALANCE,
        needs="flats, or scenes with an independent reference, from a Bayer sensor",
        signatures=lambda recorded: looks.light.two_greens(
            recorded, names=("greens", "greens_beside_patterns"), parameter="sigma"),
        estimator=Estimator(maps.green_imbalance, least=1e-3),
        examples=Examples("sites", strong={"sigma": 0.05}, cases=(Case({"sigma": 0.01}, FLAT),)),
    ),
    Entry(
        Term("dead_pixels",
             "A few pixels do not respond to light.",
             23, "sensor", "1", "fraction of the pixels", ("prnu",), listed=310),
        DEAD_PIXELS,
        needs="flats at two levels, with a hundred dead pixels or more in the frame",
        signatures=looks.always(
            looks.defects.dead(name="dead", lifted_by=imprints.NO_RESPONSE),
        ),
        estimator=Estimator(dead.dead_pixels, maps=dead.dead_map),
        examples=Examples("mean", shown={"fraction": 0.003}, strong={"fraction": 0.1},
                          cases=(Case({"fraction": 0.005}, FLAT),)),
    ),
)  # fmt: skip
