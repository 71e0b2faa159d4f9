"""Mechanisms of columns that are read by turns: even and odd ones by converters of their own."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from cannoise_jax.mechanisms import looks
from cannoise_jax.mechanisms.entry import DARK, Case, Entry, Examples
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import Context, Effect, Mechanism, Parameter
from cannoise_jax.physics.transfer.estimator import Estimator
from cannoise_jax.physics.transfer.estimators import lines
from cannoise_jax.vocabulary import RMS, Term


def _by_turns(key, x, values, maps, context: Context):
    sign = 1.0 - 2.0 * (jnp.arange(x.shape[-1]) % 2)
    # A group is never so large that it starts beyond the rows that are drawn.
    group = (jnp.arange(x.shape[1]) + values["before"]) // values["rows"]
    drawn = jax.random.normal(key, (*x.shape[:2], 1))
    return x + values["sigma_dn"] * drawn[:, jnp.clip(group, 0, x.shape[1] - 1).astype(int)] * sign


def _effect(values, maps, context: Context):
    power = values["sigma_dn"] ** 2
    next_row = power * (1 - 1 / values["rows"])  # of the pairs of rows, so many are of one group
    lags = {(0, 1): -power, (0, 2): power, (1, 0): next_row, (1, 1): -next_row}
    return Effect(variance=power, lags=lags)


ODD_EVEN_ROW_NOISE = Mechanism(
    id="odd_even_row_noise",
    point=Point("readout", "signal", "row", "redrawn", interleave=2),
    parameters=(
        Parameter("sigma_dn", "DN", 0.5, 0.0, 1e4, "rms, half the difference of even and odd columns"),
        Parameter("rows", "rows", 1.0, 1.0, 64.0, "rows that are read together and part alike", 1.0),
        Parameter("before", "rows", 0.0, 0.0, 63.0, "rows of the first group before the frame", 0.0),
    ),
    equation=r"y_{tij} \to y_{tij} + (-1)^j d_{tg},\ g = \lfloor (i+b)/n \rfloor,\quad d_{tg} \sim"
    r" \mathcal{N}(0,\sigma^2)",
    sentence="Even and odd columns of a row are sampled by circuits of their own, which jitter apart: the "
    "row breaks into a comb, another one in every row and frame.",
    reference="Rauscher, Teledyne H1RG, H2RG, and H4RG Noise Generator, PASP 127, 1144 (2015) (alternating "
    "column noise)",
    needs=("dark", "pair"),
    confused_with=("row_noise", "banding"),
    amplitude=lambda values, context: values["sigma_dn"],
    sample=_by_turns,
    effect=_effect,
)

IMPRINTS = ("site_redrawn", "row_parity_redrawn", "column_parity_redrawn")
"""Offsets of the mosaic's sites, new in every frame: what is left of it in the mean of the rows."""

ENTRIES: tuple[Entry, ...] = (
    Entry(
        Term("odd_even_row_noise",
             "Even and odd columns of a row part by a random offset, redrawn in every row and frame.",
             34, "sensor", "DN", RMS, listed=16),
        ODD_EVEN_ROW_NOISE,
        needs="two frames or more at one setting",
        signatures=looks.always(
            looks.lines.by_turns(name="row_turns_temporal", parameter="sigma_dn",
                covers=(*looks.DARK_LEVELS, *IMPRINTS)),
        ),
        estimator=Estimator(lines.odd_even_row_noise, white=True, beside=lines.beside_rows_apart),
        examples=Examples("lags", dim=True, strong={"sigma_dn": 3.0}, cases=(Case({"sigma_dn": 1.0}, DARK),)),
    ),
)  # fmt: skip
