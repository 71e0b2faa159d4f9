"""Mechanisms that act on the light and on the response of the pixels to it, in proportion to the signal."""

from __future__ import annotations

from cannoise_jax.physics.grammar import Point, mechanism_from_grammar
from cannoise_jax.physics.mechanism import Mechanism

PRNU = mechanism_from_grammar(
    Point("photons", "mean", "pixel", "frozen", "multiply"),
    id="prnu",
    default=0.01,
    equation=r"\mu_{ij} \to \mu_{ij}\,(1+\sigma p_{ij})",
    sentence="Pixels differ a little in sensitivity, always by the same factor: a fixed pattern that a flat "
    "field removes.",
    reference="EMVA 1288 release 4.0, section 4.2 (PRNU1288)",
    needs=("flat", "pair_independent"),
    confused_with=("dsnu", "column_gain", "nonlinearity", "reference_error"),
)

MECHANISMS: tuple[Mechanism, ...] = (PRNU,)
