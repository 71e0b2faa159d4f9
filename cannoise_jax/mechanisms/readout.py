"""Mechanisms of the readout: offsets and interference that rows, columns and frames share, in DN."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from cannoise_jax.physics.core import scores
from cannoise_jax.physics.core.grammar import Point, mechanism_from_grammar
from cannoise_jax.physics.core.mechanism import Context, Effect, Mechanism, Parameter, Scaling

_EMVA_LINES = "EMVA 1288 release 4.0, section 8.2 (row and column nonuniformity)"
_ELD = "Wei et al., Physics-based Noise Modeling for Extreme Low-light Photography, TPAMI 2021, section 3"


def _offsets(
    id, over, time, sentence, reference, needs, confused, equation, default=0.5, likelihood=None, **point
):
    place = Point("readout", "signal", over, time, **point)
    return mechanism_from_grammar(
        place, id=id, default=default, sentence=sentence, equation=equation, reference=reference, needs=needs,
        confused_with=confused, likelihood=likelihood,
    )  # fmt: skip


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
        parameters=(Parameter("step_dn", "DN", 1.0, -1e4, 1e4, "identity", "right minus left half"),),
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


def _switch_score(z, values, maps, context: Context):
    return scores.variance_score(z, 1.0 + 0 * context.mean_dn)


DUAL_GAIN = Mechanism(
    id="dual_gain",
    stage="readout",
    acts_on="signal",
    point=Point("readout", "signal", "whole", "frozen", "multiply"),
    parameters=(
        Parameter("iso_switch", "ISO", 800.0, 1.0, 1e7, "log", "first ISO of the high conversion gain"),
        Parameter("gain_ratio", "1", 1.0, 0.1, 10.0, "log", "system gain above the switch over the table's"),
        Parameter(
            "read_ratio", "1", 0.42, 0.01, 10.0, "log", "read noise in e- above the switch over the table's"
        ),
    ),
    equation=r"s \to s\,r,\quad K \to K\,g \quad \mathrm{for\ ISO} \geq \mathrm{ISO}_s",
    sentence="From one ISO on the pixel switches to a smaller capacitor: more volts per electron, so less "
    "read "
    "noise.",
    reference="Feng et al., Learnability Enhancement for Low-light Raw Denoising, TPAMI 2023 (Sony A7S2 "
    "table)",
    needs=("iso", "dark"),
    confused_with=("read_noise_error", "gain_error"),
    likelihood="exact",
    amplitude=lambda values, context: jnp.abs(values["gain_ratio"] / values["read_ratio"] - 1),
    baseline=_switch,
    effect=_switch_effect,
    score=_switch_score,
)


MECHANISMS: tuple[Mechanism, ...] = (
    _offsets(
        "row_noise", "row", "redrawn",
        "Every row is read at its own instant, and what the supply does at that instant shifts the whole "
        "row.",
        _ELD, ("dark", "pair"), ("row_pink_noise", "row_fpn", "flicker", "banding", "pink_noise"),
        r"y_{tij} \to y_{tij} + r_{ti},\quad r_{ti} \sim \mathcal{N}(0,\sigma^2)",
    ),
    _offsets(
        "column_noise", "column", "redrawn",
        "Every column has its own amplifier or converter, whose offset jitters from frame to frame.",
        _ELD, ("dark", "pair"), ("column_fpn", "column_gain", "smear"),
        r"y_{tij} \to y_{tij} + c_{tj},\quad c_{tj} \sim \mathcal{N}(0,\sigma^2)",
    ),
    _offsets(
        "row_fpn", "row", "frozen",
        "Some rows are always a little brighter or darker: a fixed pattern that a dark average removes.",
        _EMVA_LINES, ("dark", "burst"), ("row_noise", "dsnu"),
        r"y_{tij} \to y_{tij} + \sigma r_i",
    ),
    _offsets(
        "column_fpn", "column", "frozen",
        "Column amplifiers differ in offset: fixed vertical stripes that a dark average removes.",
        _EMVA_LINES, ("dark", "burst"), ("column_noise", "column_gain", "dsnu"),
        r"y_{tij} \to y_{tij} + \sigma c_j",
    ),
    _offsets(
        "pink_noise", "raster", "redrawn",
        "The output amplifier wanders slowly while the pixels are read one after another: soft horizontal "
        "clouds.",
        "Rauscher, Teledyne H2RG noise generator, PASP 127, 1144 (2015)",
        ("dark", "pair"), ("row_pink_noise", "row_noise", "offset_drift"),
        r"y_n \to y_n + p_n,\quad S_p(f) \propto f^{-\alpha},\ n = iW + j",
        likelihood="none", spectrum="power_law",
    ),
    _offsets(
        "row_pink_noise", "row", "redrawn",
        "Row offsets wander slowly from row to row: soft horizontal bands, new in every frame.",
        _ELD, ("dark", "pair"), ("row_noise", "pink_noise", "flicker"),
        r"y_{tij} \to y_{tij} + r_{ti},\quad S_r(f) \propto f^{-\alpha}",
        spectrum="power_law",
    ),
    _offsets(
        "banding", "raster", "redrawn",
        "A clock, supply or radio couples into the readout: a regular pattern of stripes, slanted or "
        "straight.",
        "EMVA 1288 release 4.0, section 8.3 (spectrogram)",
        ("dark", "pair"), ("flicker", "row_pink_noise", "demosaicing"),
        r"y_n \to y_n + A\cos(2\pi f n + \phi_t),\ n = iW + j",
        likelihood="none", spectrum="sinusoid",
    ),
    _offsets(
        "offset_drift", "whole", "redrawn",
        "The black level is set anew for every frame and never quite the same.",
        "Feng et al., Learnability Enhancement for Low-light Raw Denoising, TPAMI 2023 (dark shading)",
        ("dark", "burst"), ("illumination_drift", "temperature_drift"),
        r"y_{tij} \to y_{tij} + o_t,\quad o_t \sim \mathcal{N}(0,\sigma^2)", default=0.2,
    ),
    _offsets(
        "channel_offset", "channel", "frozen",
        "The black level differs between the colour channels: shadows take on a tint.",
        _ELD + " (colour bias)", ("dark",), ("bookkeeping", "dark_current", "nonlinearity"),
        r"y_{tij} \to y_{tij} + \sigma d_{c(i,j)}",
    ),
    AMPLIFIER_MISMATCH,
    DUAL_GAIN,
)  # fmt: skip
