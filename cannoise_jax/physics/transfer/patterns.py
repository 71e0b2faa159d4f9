"""Fixed patterns in the photon transfer table, one channel at a time: DSNU1288 and PRNU1288 (EMVA 1288
release 4.0), whole and by rows, columns and pixels."""

from __future__ import annotations

import numpy as np

from cannoise_jax.physics.transfer.estimate import Estimate, NotMeasurable, Outcome, root
from cannoise_jax.physics.transfer.fit import Line, robust_mean_square
from cannoise_jax.physics.transfer.frames import FrameStatistics, black_of, line_means, pixel_variance
from cannoise_jax.physics.transfer.quantities import (
    CUT_OFF,
    DIMMER,
    RECORD_DARKS,
    RECORD_FLATS,
    Quantity,
    in_electrons,
)
from cannoise_jax.physics.transfer.quiet import (
    BELOW_A_CODE,
    hidden_in_a_code,
    pattern_below_a_code,
    unseen_offsets,
)
from cannoise_jax.physics.transfer.rails import below_rail, is_below_rail
from cannoise_jax.physics.transfer.spatial import (
    Split,
    TemporalParts,
    shading,
    spatial_split,
    temporal_mean_square,
    total_of,
)
from cannoise_jax.physics.transfer.unlit import UNLIT
from cannoise_jax.recordings.packing import site
from cannoise_jax.recordings.recording import PerChannel

_UNSTEADY = 0.01
"""Relative temporal modulation of rows above which fixed row patterns of a flat are hidden."""


def temporal_parts(s: FrameStatistics, c: int, relative: bool = False) -> TemporalParts:
    """Temporal variances of one channel of a repeated recording, for `spatial_split`. relative: of the
    signal, each frame divided by its mean above black, instead of DN."""
    rows, columns = line_means(s, c)
    square, keep = robust_mean_square(pixel_variance(s, c), s.dof)
    if relative:
        black = black_of(s.recording, c)
        level = s.frame_means[:, c] - black
        rows, columns = ((v - black) / level[:, None] for v in (rows, columns))
        square /= float(1 / np.mean(1 / level)) ** 2
    row, row_dof = temporal_mean_square(rows)
    column, column_dof = temporal_mean_square(columns)
    return TemporalParts(square, keep.sum() * s.dof, row, row_dof, column, column_dof, s.recording.count)


def _dark_split(dark: FrameStatistics, c: int) -> Split | NotMeasurable:
    if pattern_below_a_code(dark) or hidden_in_a_code(dark, max(dark.code_step, 1.0), c):
        return NotMeasurable(BELOW_A_CODE)
    _, keep = robust_mean_square(pixel_variance(dark, c), dark.dof)
    keep &= ~site(dark.clipped, c)
    if not keep.any():
        return NotMeasurable(CUT_OFF)
    return spatial_split(site(dark.mean, c), keep, temporal_parts(dark, c))


def pattern_quantities(
    name: str, c: int, line: Line | NotMeasurable, flats: list[FrameStatistics], dark: FrameStatistics | None,
    black: PerChannel,
) -> list[Quantity]:  # fmt: skip
    """DSNU1288 and PRNU1288, whole and by rows, columns and pixels."""
    out: list[Quantity] = []
    split: Split | NotMeasurable | None = None
    parts = ("total", "row", "column", "pixel")
    titles = {p: f"{{}}1288{'' if p == 'total' else f', {p}s'}" for p in parts}
    for part in parts:
        title = titles[part].format("DSNU")
        if split is None:
            split = NotMeasurable(RECORD_DARKS) if dark is None else _dark_split(dark, c)
        if isinstance(split, NotMeasurable):
            out.append(Quantity(title, "DN", name, split))
            continue
        sigma = root(getattr(split, part))
        out.append(Quantity(title, "DN", name, sigma))
        if part == "total":
            out.append(Quantity(title, "e-", name, in_electrons(sigma, line)))
    repeated = [s for s in flats if s.relative and s.variance is not None]
    within = [s for s in repeated if is_below_rail(s, c)]
    unlit = any(s.unlit is not None for s in flats)
    lacking = NotMeasurable(UNLIT if unlit else DIMMER if repeated else RECORD_FLATS)
    # EMVA 1288: at half of saturation; here the recorded flat nearest to it.
    flat = min(
        within, key=lambda s: abs(s.level[c] / (s.recording.white_level - black[c]) - 0.5), default=None
    )
    for part in parts:
        title = titles[part].format("PRNU")
        if flat is None:
            out.append(Quantity(title, "%", name, lacking))
        else:
            offsets = split if isinstance(split, Split) else None
            unseen = 0.0 if dark is None else unseen_offsets([dark])
            outcome, note = _prnu(flat, offsets, unseen, c, part, black)
            out.append(Quantity(title, "%", name, outcome, note if part == "total" else ""))
    return out


def _prnu(
    flat: FrameStatistics, dark: Split | None, unseen: float, c: int, part: str, black: PerChannel
) -> tuple[Outcome, str]:
    parts = temporal_parts(flat, c, relative=True)
    level = flat.frame_means[:, c].mean() - black[c]
    unsteady = np.sqrt(parts.row_mean) > _UNSTEADY
    if unsteady and part == "row":
        return NotMeasurable(
            "the light flickers between rows: use direct-current light, or whole mains periods"
        ), ""
    gains = (site(flat.mean, c) - black[c]) / level
    gains = gains - shading(gains)
    if unsteady:
        gains = gains - gains.mean(1, keepdims=True)
    _, keep = robust_mean_square(
        pixel_variance(flat, c) / np.maximum(site(flat.mean, c) - black[c], 1), flat.dof
    )
    split = spatial_split(gains, keep & below_rail(flat, c), parts)
    found: Estimate = getattr(split, part)
    if unsteady and part == "total":
        found = total_of(split.column, split.pixel)
    if dark is not None:
        offset: Estimate = getattr(dark, part)
        found = found.shifted(-max(offset.value, 0.0) / level**2)
    found = found.of_which(unseen / level**2)
    note = f"at {level:.0f} DN, shading taken out" + (
        "; rows left out: the light flickers" if unsteady else ""
    )
    return root(found).scaled(100.0), note
