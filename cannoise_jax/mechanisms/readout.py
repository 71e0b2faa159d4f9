"""Mechanisms of the readout: offsets and interference that rows, columns and frames share, in DN."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from cannoise_jax.mechanisms import imprints, looks
from cannoise_jax.mechanisms.entry import DARK, Case, Entry, Examples
from cannoise_jax.physics.core.grammar import Point, mechanism_from_grammar
from cannoise_jax.physics.core.mechanism import Context, Effect, Mechanism, Parameter, Scaling
from cannoise_jax.physics.transfer import maps as measured
from cannoise_jax.physics.transfer.estimator import Estimator
from cannoise_jax.physics.transfer.estimators import codes, lines, spectra
from cannoise_jax.vocabulary import FRACTION, RMS, Term

_EMVA_LINES = "EMVA 1288 release 4.0, section 8.2 (row and column nonuniformity)"
_ELD = "Wei et al., Physics-based Noise Modeling for Extreme Low-light Photography, TPAMI 2021, section 3"


def _step_maps(key, values, context: Context):
    # Two taps: the left half of the frame reads half a step low, the right half as much high.
    width = context.size[1]
    side = np.where(np.arange(width) * 2 // width % 2 == 0, -0.5, 0.5)
    return {"field": jnp.asarray(side, jnp.float32).reshape(1, 1, width)}


AMPLIFIER_MISMATCH = dataclasses.replace(
    mechanism_from_grammar(
        Point("readout", "signal", "block", "frozen"),
        id="amplifier_mismatch",
        strength="step_dn",
        parameters=(Parameter("step_dn", "DN", 1.0, -1e4, 1e4, "right minus left half"),),
        equation=r"y_{ij} \to y_{ij} + \Delta\,(k_{ij} - \frac{1}{2})",
        sentence="Two amplifiers read one half each, and their black levels differ: a step down the middle.",
        reference="Janesick, Scientific Charge-Coupled Devices, SPIE Press 2001, chapter 6 (multiple "
        "amplifiers)",
        needs=("dark", "pair_independent"),
        confused_with=("dsnu", "column_fpn", "reference_error"),
        scaling=Scaling(gain=1.0),
    ),
    draw_maps=_step_maps,
)


def _switch(noise, values, maps, context: Context):
    above = context.iso >= values["iso_switch"]
    gain = jnp.where(above, values["gain_ratio"], 1.0)
    read = jnp.where(above, values["read_ratio"], 1.0)
    return noise._replace(gain_dn_per_e=noise.gain_dn_per_e * gain, read_noise_e=noise.read_noise_e * read)


def _switch_effect(values, maps, context: Context):
    above = context.iso >= values["iso_switch"]
    gain = jnp.where(above, values["gain_ratio"], 1.0)
    total = jnp.where(above, values["read_ratio"], 1.0) * gain
    shot = context.gain_dn_per_e * context.mean_dn
    read = (context.gain_dn_per_e * context.read_noise_e) ** 2
    return Effect(variance=((gain - 1) * shot + (total**2 - 1) * read)[0])


DUAL_GAIN = Mechanism(
    id="dual_gain",
    point=Point("readout", "signal", "frame", "frozen", "multiply"),
    parameters=(
        Parameter("iso_switch", "ISO", 800.0, 1.0, 1e7, "first ISO of the high conversion gain"),
        Parameter("gain_ratio", "1", 1.0, 0.1, 10.0, "system gain above the switch over the table's"),
        Parameter("read_ratio", "1", 0.42, 0.01, 10.0, "read noise in e- above the switch over the table's"),
    ),
    equation=r"s \to s\,r,\quad K \to K\,g \quad \mathrm{for\ ISO} \geq \mathrm{ISO}_s",
    sentence="From one ISO on the pixel switches to a smaller capacitor: more volts per electron, so less "
    "read noise.",
    reference="Feng et al., Learnability Enhancement for Low-light Raw Denoising, TPAMI 2023 (Sony A7S2 "
    "table)",
    needs=("iso", "dark"),
    confused_with=("read_noise_error", "gain_error"),
    amplitude=lambda values, context: jnp.abs(values["gain_ratio"] / values["read_ratio"] - 1),
    baseline=_switch,
    effect=_switch_effect,
)


ENTRIES: tuple[Entry, ...] = (
    Entry(
        Term("row_noise",
             "One random offset per row, white from row to row, redrawn in every frame.",
             29, "sensor", "DN", RMS, ("row_pink_noise",), listed=150),
        mechanism_from_grammar(
            Point("readout", "signal", "row", "redrawn"), id="row_noise", default=0.5,
            sentence="Every row is read at its own instant, and what the supply does at that instant shifts "
            "the whole row.",
            reference=_ELD, needs=("dark", "pair"),
            confused_with=("row_pink_noise", "row_fpn", "flicker", "banding", "pink_noise"),
            equation=r"y_{tij} \to y_{tij} + r_{ti},\quad r_{ti} \sim \mathcal{N}(0,\sigma^2)",
        ),
        needs="two frames or more at one setting",
        signatures=looks.either_side(
            looks.lines.redrawn("row", "additive", name="row_additive_temporal", parameter="sigma_dn",
                covers=looks.DARK_LEVELS),
        ),
        estimator=Estimator(lines.row_noise, white=True, gives_way_to=("row_pink_noise",),
                            placed=lines.placed_rows),
        examples=Examples("row spectrum", dim=True, strong={"sigma_dn": 3.0},
                          cases=(Case({"sigma_dn": 1.0}, DARK),
                          Case({"sigma_dn": 0.1}, DARK, note="near zero"))),
    ),
    Entry(
        Term("column_noise",
             "One random offset per column, white, redrawn in every frame.",
             30, "sensor", "DN", RMS, listed=170),
        mechanism_from_grammar(
            Point("readout", "signal", "column", "redrawn"), id="column_noise", default=0.5,
            sentence="Every column has its own amplifier or converter, whose offset jitters from frame "
            "to frame.",
            reference=_ELD, needs=("dark", "pair"), confused_with=("column_fpn", "column_gain", "smear"),
            equation=r"y_{tij} \to y_{tij} + c_{tj},\quad c_{tj} \sim \mathcal{N}(0,\sigma^2)",
        ),
        needs="two frames or more at one setting",
        signatures=looks.either_side(
            looks.lines.redrawn("column", "additive", name="column_additive_temporal", parameter="sigma_dn",
                covers=looks.DARK_LEVELS),
        ),
        estimator=Estimator(lines.column_noise, white=True),
        examples=Examples("column jitter", dim=True, strong={"sigma_dn": 3.0},
                          cases=(Case({"sigma_dn": 1.0}, DARK),)),
    ),
    Entry(
        Term("row_fpn",
             "One fixed offset per row.",
             37, "sensor", "DN", RMS, ("dsnu",), listed=180),
        mechanism_from_grammar(
            Point("readout", "signal", "row", "frozen"), id="row_fpn", default=0.5,
            sentence="Some rows are always a little brighter or darker: a fixed pattern that a dark "
            "average removes.",
            reference=_EMVA_LINES, needs=("dark", "burst"), confused_with=("row_noise", "dsnu"),
            equation=r"y_{tij} \to y_{tij} + \sigma r_i",
        ),
        needs="darks of two frames or more",
        signatures=looks.either_side(
            looks.line_maps.frozen("row", "additive", name="row_additive_static", parameter="sigma_dn",
                covers=looks.DARK_LEVELS),
            looks.line_maps.frozen("row", "codes", name="row_additive_static_behind_gain",
                parameter="sigma_dn", covers=looks.DARK_LEVELS),
        ),
        estimator=Estimator(lines.row_fpn, white=True, frozen=True, maps=measured.row_pattern),
        examples=Examples("rows", dim=True, strong={"sigma_dn": 3.0}, cases=(Case({"sigma_dn": 1.0}, DARK),)),
    ),
    Entry(
        Term("column_fpn",
             "One fixed offset per column.",
             37, "sensor", "DN", RMS, ("dsnu",), listed=190),
        mechanism_from_grammar(
            Point("readout", "signal", "column", "frozen"), id="column_fpn", default=0.5,
            sentence="Column amplifiers differ in offset: fixed vertical stripes that a dark average "
            "removes.",
            reference=_EMVA_LINES, needs=("dark", "burst"),
            confused_with=("column_noise", "column_gain", "dsnu"),
            equation=r"y_{tij} \to y_{tij} + \sigma c_j",
        ),
        needs="darks of two frames or more",
        signatures=looks.either_side(
            looks.line_maps.frozen("column", "additive", name="column_additive_static", parameter="sigma_dn",
                covers=looks.DARK_LEVELS),
            looks.line_maps.frozen("column", "codes", name="column_additive_static_behind_gain",
                parameter="sigma_dn", covers=looks.DARK_LEVELS),
        ),
        estimator=Estimator(lines.column_fpn, white=True, frozen=True, maps=measured.column_pattern),
        examples=Examples("columns", dim=True, strong={"sigma_dn": 3.0},
                          cases=(Case({"sigma_dn": 1.0}, DARK),)),
    ),
    Entry(
        Term("pink_noise",
             "1/f noise along the raster scan.",
             32, "sensor", "DN", RMS, listed=200),
        mechanism_from_grammar(
            Point("readout", "signal", "raster", "redrawn", spectrum="power_law"),
            id="pink_noise", default=0.5,
            sentence="The output amplifier wanders slowly while the pixels are read one after another: soft "
            "horizontal clouds.",
            reference="Rauscher, Teledyne H2RG noise generator, PASP 127, 1144 (2015)",
            needs=("dark", "pair"), confused_with=("row_pink_noise", "row_noise", "offset_drift"),
            equation=r"y_n \to y_n + p_n,\quad S_p(f) \propto f^{-\alpha},\ n = iW + j",
        ),
        needs="two frames or more at one setting",
        signatures=looks.either_side(
            looks.spectra.slope("raster", name="raster_slope", parameter="sigma_dn",
                covers=looks.DARK_LEVELS),
        ),
        estimator=Estimator(spectra.pink_noise, white=True),
        examples=Examples("raster spectrum", dim=True, strong={"sigma_dn": 4.0, "exponent": 1.2},
                          cases=(Case({"sigma_dn": 2.0, "exponent": 1.0}, DARK),)),
    ),
    Entry(
        Term("row_pink_noise",
             "An offset constant along each row and 1/f from row to row, redrawn per frame.",
             31, "sensor", "DN", RMS, listed=210),
        mechanism_from_grammar(
            Point("readout", "signal", "row", "redrawn", spectrum="power_law"),
            id="row_pink_noise", default=0.5,
            sentence="Row offsets wander slowly from row to row: soft horizontal bands, new in every frame.",
            reference=_ELD, needs=("dark", "pair"), confused_with=("row_noise", "pink_noise", "flicker"),
            equation=r"y_{tij} \to y_{tij} + r_{ti},\quad S_r(f) \propto f^{-\alpha}",
        ),
        needs="two frames or more at one setting",
        signatures=looks.either_side(
            looks.spectra.slope("row", name="row_slope", parameter="sigma_dn", covers=looks.DARK_LEVELS),
        ),
        estimator=Estimator(spectra.row_pink_noise, white=True, against=spectra.reaches_no_further),
        examples=Examples("row spectrum", dim=True, strong={"sigma_dn": 4.0, "exponent": 0.8},
                          cases=(Case({"sigma_dn": 2.0, "exponent": 1.0}, DARK),)),
    ),
    Entry(
        Term("banding",
             "A sinusoid of fixed frequency across the frame: interference pick-up.",
             33, "sensor", "DN", "peak, DN", listed=220),
        mechanism_from_grammar(
            Point("readout", "signal", "raster", "redrawn", spectrum="sinusoid"), id="banding", default=0.5,
            sentence="A clock, supply or radio couples into the readout: a regular pattern of stripes, "
            "slanted or straight.",
            reference="EMVA 1288 release 4.0, section 8.3 (spectrogram)",
            needs=("dark", "pair"), confused_with=("flicker", "row_pink_noise", "demosaicing"),
            equation=r"y_n \to y_n + A\cos(2\pi f n + \phi_t),\ n = iW + j",
        ),
        needs="two frames or more at one setting",
        signatures=looks.always(
            looks.waves.interference("redrawn", name="wave_redrawn", parameter="amplitude_dn",
                lines=imprints.ROWS_AND_COLUMNS, alike=imprints.WAVES),
            # A supply brings its harmonics along.
            looks.waves.interference("redrawn", name="wave_redrawn_2", parameter="amplitude_dn",
                lines=imprints.ROWS_AND_COLUMNS, alike=imprints.WAVES, after="wave_redrawn"),
            looks.waves.interference("redrawn", name="wave_redrawn_3", parameter="amplitude_dn",
                lines=imprints.ROWS_AND_COLUMNS, alike=imprints.WAVES, after="wave_redrawn_2"),
            looks.waves.interference("frozen", name="wave_frozen", parameter="amplitude_dn"),
        ),
        estimator=Estimator(spectra.banding, white=True, searched=True, beside=spectra.beside_rows),
        examples=Examples("raster spectrum", shown={"amplitude_dn": 1.0, "frequency": 0.0823}, dim=True,
                          strong={"amplitude_dn": 6.0, "frequency": 0.13},
                          cases=(Case({"amplitude_dn": 1.0, "frequency": 0.12345}, DARK),)),
    ),
    Entry(
        Term("offset_drift",
             "The black level moves from frame to frame.",
             35, "sensor", "DN", RMS, listed=230),
        mechanism_from_grammar(
            Point("readout", "signal", "frame", "redrawn"), id="offset_drift", default=0.2,
            sentence="The black level is set anew for every frame and never quite the same.",
            reference="Feng et al., Learnability Enhancement for Low-light Raw Denoising, TPAMI 2023 "
            "(dark shading)",
            needs=("dark", "burst"), confused_with=("illumination_drift", "temperature_drift"),
            equation=r"y_{tij} \to y_{tij} + o_t,\quad o_t \sim \mathcal{N}(0,\sigma^2)",
        ),
        needs="two recordings of two frames or more, best darks",
        signatures=looks.always(
            looks.patterns.frame("additive", name="frame_additive", parameter="sigma_dn",
                covers=looks.COVERS_NOTHING),
        ),
        estimator=Estimator(lines.offset_drift),
        examples=Examples("frames", shown={"sigma_dn": 0.5}, dim=True, strong={"sigma_dn": 3.0},
                          cases=(Case({"sigma_dn": 0.3}, DARK),)),
    ),
    Entry(
        Term("channel_offset",
             "Each colour channel has its own black-level error.",
             36, "sensor", "DN", RMS, ("dsnu", "bookkeeping"), listed=240),
        mechanism_from_grammar(
            Point("readout", "signal", "channel", "frozen"), id="channel_offset", default=0.5,
            sentence="The black level differs between the colour channels: shadows take on a tint.",
            reference=_ELD + " (colour bias)", needs=("dark",),
            confused_with=("bookkeeping", "dark_current", "nonlinearity"),
            equation=r"y_{tij} \to y_{tij} + \sigma d_{c(i,j)}",
        ),
        needs="darks, and a stated black level",
        signatures=lambda recorded: (
            looks.channel_levels.black_of_channels(recorded, name="black_channels", parameter="sigma_dn",
                covers=("black_channels",)),
        ),
        estimator=Estimator(codes.channel_offset, reported="(the measured black level is in the baseline)"),
        examples=Examples("sites", dim=True, strong={"sigma_dn": 3.0},
                          cases=(Case({"sigma_dn": 1.0}, DARK),)),
    ),
    Entry(
        Term("amplifier_mismatch",
             "Regions read by different amplifiers differ by a step in offset.",
             38, "sensor", "DN", "step between adjoining regions, DN", ("dsnu",), listed=250),
        AMPLIFIER_MISMATCH,
        needs="darks of two frames or more",
        signatures=looks.always(
            looks.means.halves(name="step", parameter="step_dn", covers=("taps",)),
            looks.taps.regions(name="taps", parameter="step_dn", covers=("step",),
                before=(*looks.AREAS, *looks.MAPS)),
        ),
        estimator=Estimator(codes.amplifier_mismatch, white=True, frozen=True),
        examples=Examples("columns", dim=True, strong={"step_dn": 5.0},
                          cases=(Case({"step_dn": 1.0}, DARK),)),
    ),
    Entry(
        Term("amplifier_drift",
             "The offsets of regions read by different amplifiers move from frame to frame, each by itself.",
             38, "sensor", "DN", RMS, listed=460),
        mechanism_from_grammar(
            Point("readout", "signal", "block", "redrawn"), id="amplifier_drift", default=0.5,
            sentence="Each amplifier sets its own black level anew for every frame: regions step against "
            "each other, by other amounts in the next frame.",
            reference="Janesick, Scientific Charge-Coupled Devices, SPIE Press 2001, chapter 6 (multiple "
            "amplifiers)",
            needs=("dark", "pair"), confused_with=("amplifier_mismatch", "offset_drift", "row_pink_noise"),
            equation=r"y_{tij} \to y_{tij} + a_{t,k(i,j)},\quad a_{tk} \sim \mathcal{N}(0,\sigma^2)",
        ),
        needs="two frames or more at one setting",
        signatures=looks.always(
            looks.moving_taps.regions(name="taps_redrawn", parameter="sigma_dn", covers=looks.DARK_LEVELS),
        ),
        examples=Examples("columns", dim=True, strong={"sigma_dn": 3.0}),
    ),
    Entry(
        Term("amplifier_gain",
             "Regions read by different amplifiers differ in gain.",
             38, "sensor", "1", FRACTION, ("prnu",), listed=470),
        mechanism_from_grammar(
            Point("readout", "signal", "block", "frozen", "multiply"), id="amplifier_gain", default=0.005,
            sentence="Amplifiers are never quite alike: a flat shows steps where one region ends and the "
            "next begins, in proportion to the light.",
            reference="Janesick, Scientific Charge-Coupled Devices, SPIE Press 2001, chapter 6 (multiple "
            "amplifiers)",
            needs=("flat",), confused_with=("column_gain", "prnu", "amplifier_mismatch", "lens_shading"),
            equation=r"y_{tij} \to y_{tij}\,(1 + g_{k(i,j)})",
        ),
        needs="flats of two frames or more",
        signatures=looks.always(
            looks.tap_gain.gains(name="tap_gains", parameter="sigma", covers=looks.LIGHT_LEVELS,
                before=("column_relative_static", "row_relative_static")),
        ),
        examples=Examples("columns", shown={"sigma": 0.02}, strong={"sigma": 0.1}),
    ),
    Entry(
        Term("dual_gain",
             "The conversion gain switches at an ISO or at a signal level.",
             7, "sensor", "1", "relative step of the gain at the switch", listed=410),
        DUAL_GAIN,
        needs="flats and darks at five ISO values or more",
        signatures=lambda recorded: (
            looks.gain_curve.signal_step(recorded, name="signal_step", covers=imprints.STEP,
                lifted_by=imprints.STEP),
            looks.gain_curve.iso_step(recorded, name="iso_step", covers=("iso_step",)),
        ),
        examples=Examples("variance", shown={"iso_switch": 50.0}, dim=True,
                          strong={"iso_switch": 50.0, "gain_ratio": 1.3, "read_ratio": 0.5}),
    ),
)  # fmt: skip
