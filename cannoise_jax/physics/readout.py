"""Mechanisms of the readout: offsets and interference that rows, columns and frames share, in DN."""

from __future__ import annotations

from cannoise_jax.physics.grammar import Point, mechanism_from_grammar
from cannoise_jax.physics.mechanism import Mechanism

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


MECHANISMS: tuple[Mechanism, ...] = (
    _offsets(
        "row_noise", "row", "redrawn",
        "Every row is read at its own instant, and what the supply does at that instant shifts the whole "
        "row.",
        _ELD, ("dark", "pair"), ("row_pink_noise", "row_fpn", "flicker", "banding", "pink_noise"),
        r"y_{tij} \to y_{tij} + r_{ti},\quad r_{ti} \sim \mathcal N(0,\sigma^2)",
    ),
    _offsets(
        "column_noise", "column", "redrawn",
        "Every column has its own amplifier or converter, whose offset jitters from frame to frame.",
        _ELD, ("dark", "pair"), ("column_fpn", "column_gain", "smear"),
        r"y_{tij} \to y_{tij} + c_{tj},\quad c_{tj} \sim \mathcal N(0,\sigma^2)",
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
        r"y_{tij} \to y_{tij} + o_t,\quad o_t \sim \mathcal N(0,\sigma^2)", default=0.2,
    ),
    _offsets(
        "channel_offset", "channel", "frozen",
        "The black level differs between the colour channels: shadows take on a tint.",
        _ELD + " (colour bias)", ("dark",), ("bookkeeping", "dark_current", "nonlinearity"),
        r"y_{tij} \to y_{tij} + \sigma d_{c(i,j)}",
    ),
)  # fmt: skip
