"""Fixed patterns in the photon transfer table, one channel at a time: DSNU1288 and PRNU1288 (EMVA 1288
release 4.0), whole and by rows, columns and pixels."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.estimate import NotMeasurable, Outcome, root
from cannoise_jax.physics.transfer.estimators.dark_map import DarkMap
from cannoise_jax.physics.transfer.estimators.light_alone import LightAlone, light_alone
from cannoise_jax.physics.transfer.fit import Line, robust_mean_square
from cannoise_jax.physics.transfer.frames import FrameStatistics, of_variance
from cannoise_jax.physics.transfer.full_well import below_full, full_signal
from cannoise_jax.physics.transfer.quantities import (
    CUT_OFF,
    DIMMER,
    RECORD_DARKS,
    RECORD_FLATS,
    Quantity,
    in_electrons,
)
from cannoise_jax.physics.transfer.quiet import (
    PATTERN_BELOW_A_CODE,
    hidden_in_a_code,
    pattern_below_a_code,
    step_of,
    unseen_offsets,
)
from cannoise_jax.physics.transfer.rails import below_rail, is_below_rail
from cannoise_jax.physics.transfer.response import Response, response_of
from cannoise_jax.physics.transfer.spatial import (
    SHADING_DEGREES,
    Split,
    TemporalParts,
    spatial_split,
    temporal_mean_square,
    total_of,
)
from cannoise_jax.physics.transfer.unlit import UNLIT
from cannoise_jax.physics.transfer.views import (
    black_of,
    line_means,
    not_stuck,
    pixel_variance,
    quiet_mean_square,
    quiet_pixels,
)
from cannoise_jax.recordings.packing import ALL, site
from cannoise_jax.recordings.recording import PerChannel

_OTHER = 1.2
"""Times the pattern without hot and loud pixels from which that of all is said beside it."""
_UNSTEADY = 0.01
"""Relative temporal modulation of rows by the light above which fixed row patterns of a flat are hidden."""


def temporal_parts(s: FrameStatistics, c: int, relative: bool = False, degree: int = 0) -> TemporalParts:
    """Temporal variances of one channel of a repeated recording, for `spatial_split`. relative: of the
    signal above black, instead of DN. degree: of shading that moves, and is taken out.

    Where the light drifts the average of the frames has more of the bright ones, and less shot noise than
    those have by themselves.
    """
    rows, columns = line_means(s, c)
    square, keep = quiet_mean_square(s, c)
    if relative:
        black = black_of(s.recording, c)
        level = s.frame_means[:, c] - black
        less_noise = float(median(site(of_variance(s), c)))
        rows, columns = ((v - black) / level[:, None] * less_noise**0.5 for v in (rows, columns))
        square /= less_noise * float(level.mean()) ** 2
    row, row_dof = temporal_mean_square(rows, degree=degree)
    column, column_dof = temporal_mean_square(columns, degree=degree)
    return TemporalParts(square, keep.sum() * s.dof, row, row_dof, column, column_dof, s.recording.count)


def _dark_split(dark: FrameStatistics, c: int) -> Split | NotMeasurable:
    if pattern_below_a_code(dark) or hidden_in_a_code(dark, step_of(dark), c):
        return NotMeasurable(PATTERN_BELOW_A_CODE)
    keep = quiet_pixels(dark, c) & ~site(dark.clipped, c)
    if not keep.any():
        return NotMeasurable(CUT_OFF)
    # Row noise that even and odd columns do not share is a pattern of pixels to those that look at all.
    return spatial_split(site(dark.mean, c), keep, temporal_parts(dark, c), turns=2 if c == ALL else 1)


def _left_out(dark: FrameStatistics, sigma: float, c: int) -> str:
    """What the pattern of all pixels is, where hot and loud ones that are left out make another of it."""
    pixels = np.ones(site(dark.mean, c).shape, bool) if dark.dead is None else ~site(dark.dead, c)
    noise = float(pixel_variance(dark, c)[pixels].mean()) / dark.recording.count
    whole = float(np.sqrt(max(site(dark.mean, c)[pixels].var() - noise, 0.0)))
    if whole <= _OTHER * sigma:
        return ""
    return f"without pixels that are hot, stuck or far noisier; {whole:.3g} DN with them, as EMVA 1288 has it"


def _odd_left_out(response: Response, flat: FrameStatistics, noise: float, sigma: float, c: int) -> str:
    """What the spread of the sensitivities of all pixels is, where a few that answer light oddly make another
    of it. noise: relative variance that the average of frames still holds."""
    lit = site(not_stuck(flat) if flat.unlit is None else not_stuck(flat) & ~flat.unlit, c)
    whole = float(np.sqrt(max(response.pattern[lit].var() - noise, 0.0) / response.square))
    if whole <= _OTHER * sigma:
        return ""
    return f"; without pixels that answer light oddly; {100 * whole:.2g} % with them, as EMVA 1288 has it"


def pattern_quantities(
    name: str, c: int, line: Line | NotMeasurable, statistics: Sequence[FrameStatistics],
    dark: FrameStatistics | None, black: PerChannel,
) -> list[Quantity]:  # fmt: skip
    """DSNU1288 and PRNU1288, whole and by rows, columns and pixels."""
    out: list[Quantity] = []
    split = NotMeasurable(RECORD_DARKS) if dark is None else _dark_split(dark, c)
    parts = ("total", "row", "column", "pixel")
    titles = {p: f"{{}}1288{'' if p == 'total' else f', {p}s'}" for p in parts}
    for part in parts:
        title = titles[part].format("DSNU")
        if isinstance(split, NotMeasurable):
            out.append(Quantity(title, "DN", name, split))
            continue
        sigma = root(getattr(split, part))
        note = _left_out(dark, sigma.value, c) if part == "total" and dark is not None else ""
        out.append(Quantity(title, "DN", name, sigma, note))
        if part == "total":
            out.append(Quantity(title, "e-", name, in_electrons(sigma, line)))
    flats = [s for s in statistics if s.recording.kind == "flat"]
    repeated = [s for s in flats if s.relative and s.variance is not None]
    full = full_signal(flats, c)
    within = [s for s in repeated if is_below_rail(s, c) and below_full(s, full, black[c], c)]
    unlit = any(s.unlit is not None for s in flats)
    lacking = NotMeasurable(UNLIT if unlit else DIMMER if repeated else RECORD_FLATS)
    # EMVA 1288: at half of saturation; here the recorded flat nearest to it.
    flat = min(
        within,
        key=lambda s: abs(s.level[c] / (min(s.recording.white_level, full) - black[c]) - 0.5),
        default=None,
    )
    unseen = 0.0 if dark is None else unseen_offsets([dark])
    alone = lacking if flat is None else light_alone(statistics, flat, c)
    found = alone if isinstance(alone, NotMeasurable) else _prnu(alone, unseen, c, black)
    for part in parts:
        title = titles[part].format("PRNU")
        if isinstance(found, NotMeasurable):
            out.append(Quantity(title, "%", name, found))
        else:
            outcome, note = found[part]
            out.append(Quantity(title, "%", name, outcome, note if part == "total" else ""))
    return out


def _prnu(alone: LightAlone, unseen: float, c: int, black: PerChannel) -> dict[str, tuple[Outcome, str]]:
    """The relative sensitivities by parts, with a note. unseen: variance of unseen offsets, DN^2."""
    flat, dark = alone.flat, alone.dark
    parts = temporal_parts(flat, c, relative=True)
    level = flat.frame_means[:, c].mean() - black[c]
    signal = site(flat.mean, c) - black[c]
    unsteady = _modulation(parts, signal.shape, dark, c, level) > _UNSTEADY
    # As of the pattern: light that turns is none of it.
    parts = temporal_parts(flat, c, relative=True, degree=SHADING_DEGREES[0])
    _, keep = robust_mean_square(pixel_variance(flat, c) / np.maximum(signal, 1), flat.dof)
    keep &= below_rail(flat, c)
    if dark is not None:
        signal, keep = signal - site(dark.offsets, c), keep & site(dark.keep, c)
        unseen = max(unseen, dark.rounding(c))
        parts = _beside_dark(parts, dark, c, level)
    response = response_of(signal / level, keep)
    gains = response.pattern
    if unsteady:
        gains = gains - gains.mean(1, keepdims=True)
    split = spatial_split(gains, response.keep, parts)
    found = split._asdict()
    if unsteady:
        found["total"] = total_of(split.column, split.pixel)
    sigmas = {
        part: root(estimate.of_which(unseen / level**2)).scaled(100.0 / np.sqrt(response.square))
        for part, estimate in found.items()
    }
    note = f"at {level:.0f} DN, shading taken out" + ("; " if alone.note else "") + alone.note
    note += "; rows left out: the light flickers" if unsteady else ""
    note += _odd_left_out(response, flat, parts.pixel / parts.frames, sigmas["total"].value / 100, c)
    out: dict[str, tuple[Outcome, str]] = {part: (sigma, note) for part, sigma in sigmas.items()}
    if unsteady:
        lacking = "the light flickers between rows: use direct-current light, or whole mains periods"
        out["row"] = NotMeasurable(lacking), ""
    return out


def _modulation(
    parts: TemporalParts, size: tuple[int, ...], dark: DarkMap | None, c: int, level: float
) -> float:
    """What the light adds to the temporal spread of the rows of a flat, relative: beside the noise of its
    pixels and the row noise of the darks."""
    darks = () if dark is None else dark.darks
    rows = max((_beyond_pixels(temporal_parts(s, c), size) for s, _ in darks), default=0.0) / level**2
    return float(np.sqrt(max(_beyond_pixels(parts, size) - rows, 0.0)))


def _beyond_pixels(parts: TemporalParts, size: tuple[int, ...]) -> float:
    """Temporal variance of row means beyond what the noise of their pixels leaves, be it shared by neighbours
    too: then columns show it alike."""
    rows, columns = size
    return parts.row_mean - max(parts.pixel / columns, parts.column_mean * rows / columns)


def _beside_dark(parts: TemporalParts, dark: DarkMap, c: int, level: float) -> TemporalParts:
    """The temporal variances of a flat with those that the average of the dark holds, and what rounding adds
    to it."""
    row, column = parts.row_mean, parts.column_mean
    pixel = parts.pixel + dark.rounding(c) / level**2 * parts.frames
    for s, weight in dark.darks:
        own, share = temporal_parts(s, c), weight**2 / level**2 * parts.frames / s.recording.count
        pixel += share * own.pixel
        row += share * own.row_mean
        column += share * own.column_mean
    return dataclasses.replace(parts, pixel=pixel, row_mean=row, column_mean=column)
