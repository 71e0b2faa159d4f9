"""Mechanisms of the pixel: charge that is not light, charge that leaks, and pixels that differ."""

from __future__ import annotations

from cannoise_jax.physics.grammar import Point, mechanism_from_grammar
from cannoise_jax.physics.mechanism import Mechanism

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

MECHANISMS: tuple[Mechanism, ...] = (DSNU,)
