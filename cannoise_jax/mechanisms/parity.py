"""Mechanisms of rows and columns that are read by turns: even and odd ones by converters of their own."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from cannoise_jax.mechanisms import looks
from cannoise_jax.mechanisms.entry import DARK, Case, Entry, Examples
from cannoise_jax.physics.core.grammar import Point, mechanism_from_grammar
from cannoise_jax.physics.core.mechanism import Context, Effect, Mechanism, Parameter
from cannoise_jax.physics.transfer.estimator import Estimator
from cannoise_jax.physics.transfer.estimators import lines
from cannoise_jax.vocabulary import FRACTION, RMS, Term


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

_OF_LINES = "EMVA 1288 release 4.0, section 8.2 (row and column nonuniformity)"


def _parted(key, values, context: Context):
    sign = 1.0 - 2.0 * (jnp.arange(context.size[0]) % 2)
    return {"field": sign[:, None] * jax.random.normal(key, (1, 1, context.size[1]))}


def _columns_apart(point: Point, **record) -> Mechanism:
    """Of columns that even and odd rows have apart: half of the difference is drawn."""
    return dataclasses.replace(
        mechanism_from_grammar(point, reference=_OF_LINES, **record), draw_maps=_parted
    )


ODD_EVEN_COLUMN_FPN = _columns_apart(
    Point("readout", "signal", "column", "frozen", interleave=2),
    id="odd_even_column_fpn",
    default=0.5,
    sentence="Even and odd rows have column circuits of their own, whose offsets differ: the stripes of even "
    "rows are others than those of odd rows.",
    needs=("dark", "burst"),
    confused_with=("column_fpn", "dsnu"),
    equation=r"y_{tij} \to y_{tij} + (-1)^i \sigma c_j",
)
ODD_EVEN_COLUMN_GAIN = _columns_apart(
    Point("photons", "mean", "column", "frozen", "multiply", interleave=2),
    id="odd_even_column_gain",
    default=0.003,
    sentence="Even and odd rows have column circuits of their own, whose gains differ: the stripes of even "
    "rows of a flat are others than those of odd rows, in proportion to the light.",
    needs=("flat",),
    confused_with=("column_gain", "prnu"),
    equation=r"y_{tij} \to y_{tij}\,(1 + (-1)^i \sigma g_j)",
)

IMPRINTS = ("site_redrawn", "row_parity_redrawn", "column_parity_redrawn")
"""Offsets of the mosaic's sites, new in every frame: what is left of it in the mean of the rows."""

ENTRIES: tuple[Entry, ...] = (
    Entry(
        Term("odd_even_row_noise",
             "Even and odd columns of a row part by a random offset, redrawn in every row and frame.",
             34, "sensor", "DN", RMS, listed=160),
        ODD_EVEN_ROW_NOISE,
        needs="two frames or more at one setting",
        signatures=looks.always(
            looks.lines.by_turns(name="row_turns_temporal", parameter="sigma_dn",
                covers=(*looks.DARK_LEVELS, *IMPRINTS)),
        ),
        estimator=Estimator(lines.odd_even_row_noise, white=True, beside=lines.beside_rows_apart),
        examples=Examples("lags", dim=True, strong={"sigma_dn": 3.0}, cases=(Case({"sigma_dn": 1.0}, DARK),)),
    ),
    Entry(
        Term("odd_even_column_fpn",
             "Columns of even and of odd rows part by a fixed offset.",
             37, "sensor", "DN", RMS, ("dsnu",), listed=380),
        ODD_EVEN_COLUMN_FPN,
        needs="darks of two frames or more",
        signatures=looks.always(
            looks.line_turns.columns("additive", name="column_turns_additive", parameter="sigma_dn",
                covers=looks.DARK_LEVELS),
        ),
        examples=Examples("spatial", dim=True, strong={"sigma_dn": 3.0}),
    ),
    Entry(
        Term("odd_even_column_gain",
             "Columns of even and of odd rows part by a fixed gain.",
             6, "sensor", "1", FRACTION, ("prnu",), listed=390),
        ODD_EVEN_COLUMN_GAIN,
        needs="flats of two frames or more",
        signatures=looks.always(
            looks.line_turns.columns("signal", name="column_turns_relative", parameter="sigma",
                covers=looks.LIGHT_LEVELS),
        ),
        examples=Examples("spatial", shown={"sigma": 0.02}, strong={"sigma": 0.05}),
    ),
)  # fmt: skip
