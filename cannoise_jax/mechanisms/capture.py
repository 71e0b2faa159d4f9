"""Mechanisms of the capture: the light, the reference image and its description, not the sensor."""

from __future__ import annotations

import jax.numpy as jnp

from cannoise_jax.mechanisms import imprints, lamp, looks
from cannoise_jax.mechanisms.entry import DARK, FLAT, Case, Entry, Examples, Shot
from cannoise_jax.physics.core.grammar import Point, mechanism_from_grammar
from cannoise_jax.physics.core.mechanism import Context, Effect, Mechanism, Parameter
from cannoise_jax.physics.core.mosaic_ops import moved, neighbour_mean
from cannoise_jax.physics.core.poisson_gaussian import sample_normal
from cannoise_jax.physics.transfer.estimator import Estimator
from cannoise_jax.physics.transfer.estimators import codes, light
from cannoise_jax.vocabulary import FRACTION, Term

ILLUMINATION_DRIFT = mechanism_from_grammar(
    Point("photons", "mean", "frame", "redrawn", "multiply"),
    id="illumination_drift",
    default=0.01,
    equation=r"\mu_t = \mu\,(1+\sigma l_t)",
    sentence="The lamp or the sun is a little brighter in one frame than in the next.",
    reference="EMVA 1288 release 4.0, section 6.2 (stability of the irradiation)",
    needs=("burst",),
    confused_with=("offset_drift", "temperature_drift", "flicker"),
    of_light=True,
)


def _deterministic(x, values):
    """The true mean where x is the reference: scaled, sharper, moved."""
    move = jnp.broadcast_to(values["shift_y"], x.shape[:1]), jnp.broadcast_to(values["shift_x"], x.shape[:1])
    sharper = x + values["blur"] * (x - neighbour_mean(x, 2))
    return moved(sharper, *move) * (1 + values["scale"])


def _reference(key, x, values, maps, context: Context):
    # One reference serves all frames of a recording, so its error is the same in all of them.
    noise = values["sigma_dn"] / context.gain_dn_per_e * sample_normal(key, (1, *context.size))
    return _deterministic(x, values) + noise


def _reference_effect(values, maps, context):
    mean = _deterministic(context.mean_dn, values) - context.mean_dn
    power = values["sigma_dn"] ** 2
    return Effect(
        mean=mean[0], variance=(power + context.gain_dn_per_e * mean)[0], temporal={1: power, 2: power}
    )


def _reference_amplitude(values, context):
    mean = _deterministic(context.mean_dn, values) - context.mean_dn
    return jnp.sqrt(values["sigma_dn"] ** 2 + jnp.mean(mean**2))


REFERENCE_ERROR = Mechanism(
    id="reference_error",
    point=Point("photons", "mean", "pixel", "frozen"),
    parameters=(
        Parameter("sigma_dn", "DN", 0.5, 0.0, 1e4, "rms noise of the reference"),
        Parameter("blur", "1", 0.0, 0.0, 1.0, "share of each pixel mixed with its neighbours"),
        Parameter("shift_y", "px", 0.0, -8.0, 8.0, "shift along the columns"),
        Parameter("shift_x", "px", 0.0, -8.0, 8.0, "shift along the rows"),
        Parameter("scale", "1", 0.0, -0.5, 0.5, "true over reference signal, minus one"),
    ),
    equation=r"\mu = (1+g)\,S_\delta[(1+w)\,\mu_r - w\,\bar\mu_r] + \sigma e",
    sentence="The image taken for noise-free is itself an average of few frames, a little soft, a little "
    "off: "
    "its error is in every residual.",
    reference="Abdelhamed et al., A High-Quality Denoising Dataset for Smartphone Cameras, CVPR 2018, "
    "section 4",
    needs=("pair", "burst"),
    confused_with=("misregistration", "gain_error", "in_camera_denoising", "read_noise_error", "prnu"),
    amplitude=_reference_amplitude,
    sample=_reference,
    effect=_reference_effect,
    of_light=True,
)


def _shift(values):
    return values["shift_px"] * jnp.sin(values["angle"]), values["shift_px"] * jnp.cos(values["angle"])


def _misregister(key, x, values, maps, context):
    dy, dx = (jnp.broadcast_to(v, x.shape[:1]) for v in _shift(values))
    return moved(x, dy, dx)


def _misregister_effect(values, maps, context):
    mean = _misregister(None, context.mean_dn, values, maps, context) - context.mean_dn
    return Effect(mean=mean[0], variance=(context.gain_dn_per_e * mean)[0])


MISREGISTRATION = Mechanism(
    id="misregistration",
    point=Point("photons", "mean", "pixel", "frozen"),
    parameters=(
        Parameter("shift_px", "px", 0.2, 0.0, 16.0, "length of the shift"),
        Parameter("angle", "rad", 0.0, -3.1416, 3.1416, "direction, from the rows"),
    ),
    equation=r"\mu(\mathrm{r}) \to \mu(\mathrm{r} + \delta)",
    sentence="Reference and frame do not lie on top of each other, so edges show up in the residual.",
    reference="Abdelhamed et al., A High-Quality Denoising Dataset for Smartphone Cameras, CVPR 2018, "
    "section 4",
    needs=("pair",),
    confused_with=("reference_error", "scene_motion", "in_camera_denoising"),
    amplitude=lambda values, context: values["shift_px"],
    sample=_misregister,
    effect=_misregister_effect,
    of_light=True,
)


def _move_scene(key, x, values, maps, context):
    dy, dx = _shift(values)
    t = jnp.arange(x.shape[0], dtype=jnp.float32)
    t = t.at[-1].set(-1.0) if context.frame_before else t
    return moved(x, t * jnp.reshape(dy, ()), t * jnp.reshape(dx, ()))


SCENE_MOTION = Mechanism(
    id="scene_motion",
    point=Point("photons", "mean", "pixel", "drifting"),
    parameters=(
        Parameter("shift_px", "px/frame", 0.1, 0.0, 16.0, "motion per frame; the first frame is unmoved"),
        Parameter("angle", "rad", 0.0, -3.1416, 3.1416, "direction, from the rows"),
    ),
    equation=r"\mu_t(\mathrm{r}) = \mu(\mathrm{r} + t\,\delta)",
    sentence="Something moves while the frames are taken: edges drift through the burst.",
    reference="Abdelhamed et al., A High-Quality Denoising Dataset for Smartphone Cameras, CVPR 2018, "
    "section 4",
    needs=("burst",),
    confused_with=("misregistration", "reference_error", "image_lag"),
    amplitude=lambda values, context: values["shift_px"],
    sample=_move_scene,
    of_light=True,
)


def _bookkeeping(key, x, values, maps, context: Context):
    # The frames are right and their description is wrong: seen through it, they are shifted and stretched,
    # and so is the level at which they saturate. Nothing analogue comes after it, so what has saturated
    # stays at one code.
    signal = jnp.minimum(x - context.black_level, context.span_dn)
    return context.black_level + values["black_dn"] + signal * (1 + values["white_error"])


def _bookkeeping_effect(values, maps, context):
    stretch, base = 1 + values["white_error"], context.mean_dn
    own = context.own_variance()
    mean = values["black_dn"] + base * values["white_error"]
    return Effect(mean=mean[0], variance=((stretch**2 - 1) * own)[0])


def _bookkeeping_amplitude(values, context):
    return jnp.sqrt(jnp.mean((values["black_dn"] + context.mean_dn * values["white_error"]) ** 2))


BOOKKEEPING = Mechanism(
    id="bookkeeping",
    point=Point("digital", "signal", "channel", "frozen"),
    parameters=(
        Parameter("black_dn", "DN", 2.0, -1e4, 1e4, "true minus stated black level"),
        Parameter("white_error", "1", 0.0, -0.9, 3.0, "relative stretch: wrong white level or units"),
    ),
    equation=r"y \to b + \beta + (1+\omega)(y-b)",
    sentence="The file says black or white is at another code than it is: everything measured from it is off "
    "in the same way, before any physics.",
    reference="Adobe Digital Negative specification 1.7, tags BlackLevel and WhiteLevel",
    needs=("dark", "pair"),
    confused_with=("channel_offset", "gain_error", "nonlinearity", "dark_current"),
    amplitude=_bookkeeping_amplitude,
    sample=_bookkeeping,
    effect=_bookkeeping_effect,
)

ENTRIES: tuple[Entry, ...] = (
    Entry(
        Term("misregistration",
             "The reference is shifted against the frames.",
             17, "capture", "px", "length of the shift, px", ("reference_error",), listed=630),
        MISREGISTRATION,
        needs="scenes with an independent reference",
        signatures=lambda recorded: (
            looks.reference.moved(recorded, name="reference_shift", covers=looks.SCENES),
        ),
        examples=Examples("edges", shown={"shift_px": 1.0}, strong={"shift_px": 1.5, "angle": 0.7}),
    ),
    Entry(
        Term("scene_motion",
             "The scene moves between frames.",
             17, "capture", "px", "motion per frame, px", listed=640),
        SCENE_MOTION,
        needs="ten frames or more of a scene with an independent reference",
        signatures=lambda recorded: (
            looks.motion.moving(recorded, name="moving", lifted_by=imprints.MOTION),
        ),
        examples=Examples("edges", shown={"shift_px": 0.3}),
    ),
    Entry(
        Term("reference_error",
             "The reference image is not the true mean: noisy, blurred, shifted or scaled.",
             17, "capture", "DN", "rms difference between the reference and the true mean, DN",
             listed=620),
        REFERENCE_ERROR,
        needs="scenes with an independent reference",
        signatures=lambda recorded: (
            looks.patterns.scenes(name="scene_static", covers=looks.SCALES),
            looks.scales.scaled(recorded, name="reference_scale", common=False, covers=looks.SCALES),
            looks.reference.blurred(recorded, "blur", name="reference_blur", error="reference_error",
                camera="in_camera_denoising", parameter="weight", partner=looks.BLENDS[0],
                template=looks.covariance.BLENDED_4, covers=(*looks.SCENES, *looks.BLENDS)),
        ),
        estimator=Estimator(light.reference_error),
        examples=Examples("spatial", shown={"sigma_dn": 3.0, "blur": 0.1},
                          strong={"sigma_dn": 5.0, "blur": 0.2, "shift_y": 0.6, "shift_x": -0.8,
                                  "scale": 0.03},
                          cases=(Case({"sigma_dn": 3.0, "blur": 0.05, "shift_y": 0.1, "shift_x": -0.05,
                                       "scale": 0.01}, (Shot("scene", scene=True),)),)),
    ),
    Entry(
        Term("flicker",
             "Mains-driven light read by a rolling shutter: rows brighten and darken in turn.",
             16, "capture", "1", "peak, as a fraction of the signal", listed=600),
        lamp.FLICKER,
        needs="two frames or more of a lit scene or flat",
        signatures=looks.always(
            looks.flicker.mains(name="flicker", parameter="amplitude", point=lamp.POINT,
                                of_sites=lamp.of_sites),
        ),
        estimator=Estimator(light.flicker, searched=True),
        examples=Examples("row spectrum", strong={"amplitude": 0.08, "frequency": 0.11},
                          cases=(Case({"amplitude": 0.02, "frequency": 0.06}, FLAT),)),
    ),
    Entry(
        Term("illumination_drift",
             "The brightness of the light moves from frame to frame.",
             18, "capture", "1", FRACTION, listed=610),
        ILLUMINATION_DRIFT,
        needs="two frames or more of a lit scene or flat, and of a second recording",
        signatures=looks.always(
            looks.patterns.frame("signal", name="frame_relative", parameter="sigma", covers=looks.SCALES),
        ),
        estimator=Estimator(light.illumination_drift),
        examples=Examples("frames", shown={"sigma": 0.02}, strong={"sigma": 0.05},
                          cases=(Case({"sigma": 0.01}, FLAT),)),
    ),
)  # fmt: skip

LAST = (
    Entry(
        Term("bookkeeping",
             "Wrong black level, white level, colour pattern or units in the description.",
             50, "bookkeeping", "DN", "rms error of the description, DN", listed=650),
        BOOKKEEPING,
        needs="darks, and a stated black level",
        signatures=lambda recorded: (
            looks.scales.scaled(recorded, name="description_scale", common=True, covers=looks.SCALES),
            looks.levels.black(recorded, name="black_level", covers=("black_level", *looks.SCALES)),
        ),
        estimator=Estimator(codes.bookkeeping),
        examples=Examples("mean", strong={"black_dn": 4.0, "white_error": 0.1},
                          cases=(Case({"black_dn": 2.0}, DARK),
                                 Case({"white_error": -0.05}, (Shot("dark"), Shot("flat", 1.2)), exact=True,
                                      note="white"))),
    ),
)  # fmt: skip
