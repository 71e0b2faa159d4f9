"""Regions of equal size read by amplifiers of their own, whose offsets are new in every frame.

Which regions there are is chosen among `LAYOUTS` by what their offsets explain. Steps are told from smooth
fields, and whole regions from smaller parts, by sums over cells that cut every region into parts.
"""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from typing import NamedTuple, cast

import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.signatures.added import placed, strength
from cannoise_jax.signatures.answers import response
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.group_sums import Groups, LineSums, by_own_noise, group_pixels, grouped
from cannoise_jax.signatures.groups import whitened
from cannoise_jax.signatures.handed import Found, Many
from cannoise_jax.signatures.line_sums import component_score
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    CONTRASTS,
    NO_CLOSED_FORM,
    NO_LAW,
    NO_PATTERN,
    Axes,
    Signature,
)
from cannoise_jax.signatures.taps import legendre, regions_of

Layout = tuple[int, int]
LAYOUTS: tuple[Layout, ...] = (
    (1, 2), (2, 1), (1, 3), (3, 1), (2, 2), (1, 4), (4, 1), (1, 6), (2, 4), (1, 8), (1, 16),
)  # fmt: skip
"""Regions along rows and along columns."""
CELLS: Layout = (24, 48)
"""Every layout, and a finer one within it, is a union of these cells."""
_WITHIN = 0.2
"""Share of what the offsets of regions explain, from which on parts of regions that explain as much beside
them are no noise: a step at a random row, a fall or a wave of large areas leaves more within any regions."""
_POINT = Point("readout", "signal", "block", "redrawn")


class Moving(NamedTuple):
    """Variance of the offsets, DN^2, and the regions along rows and along columns."""

    variance: float
    layout: Layout


@lru_cache(maxsize=32)
def cell_groups(size: tuple[int, int], layout: Layout) -> Groups:
    """The pixels of every cell, or region, of a layout."""
    rows, columns = regions_of(size, layout)
    return grouped(rows * layout[1] + columns)


def _in_cells(field: Fields) -> LineSums:
    """Scores [n, cells] and information [cells] of one offset a cell."""
    groups = cell_groups(field.mean.shape, CELLS)
    r = response(field, "additive").astype(np.float32)
    information = groups.sums(r.astype(np.float64) ** 2)
    score = np.array([groups.sums(v * r) for v in field.contrasts])
    score, more = by_own_noise(score, group_pixels(field.contrasts, r, groups), groups.sums(r > 0))
    return LineSums(score, information * more)


def _in_regions(cells: LineSums, layout: Layout) -> tuple[LineSums, np.ndarray]:
    """Sums of the regions of a layout beside the mean of the frame, and what share of a degree of freedom
    that leaves to each."""
    down, across = (CELLS[k] // layout[k] for k in (0, 1))

    def union(values: np.ndarray) -> np.ndarray:
        parts = values.reshape(*values.shape[:-1], layout[0], down, layout[1], across)
        return parts.sum((-3, -1)).reshape(*values.shape[:-1], -1)

    score, information = union(cells.score), union(cells.information)
    share = information / max(float(information.sum()), 1e-30)
    return LineSums(score - score.sum(1, keepdims=True) * share, information), 1 - share


def _shown(cells: LineSums, layout: Layout) -> bool:
    """Whether every region has pixels that tell of it."""
    information = _in_regions(cells, layout)[0].information
    return bool(np.all(information > 1e-3 * information.mean()))


def _chi2(sums: LineSums) -> float:
    return float(np.sum(sums.score**2 / np.maximum(sums.information, 1e-30)))


@lru_cache(maxsize=8)
def _smooth(layout: Layout) -> Float[np.ndarray, "k c"]:
    """As many smooth shapes over the cells as a layout has regions."""
    return legendre(CELLS, layout).reshape(-1, CELLS[0] * CELLS[1])


def _as_smooth(cells: LineSums, layout: Layout) -> float:
    """Chi-square of as many smooth shapes as the layout has regions, beside the mean of the frame."""
    shapes = _smooth(layout)
    u = cells.score @ shapes.T
    known = np.linalg.pinv(shapes * cells.information @ shapes.T)
    mean = cells.score.sum(1) ** 2 / max(float(cells.information.sum()), 1e-30)
    return float(np.sum((u @ known) * u) - mean.sum())


def _whole(cells: list[LineSums], layout: Layout) -> bool:
    """Whether the offsets are those of whole regions: they explain more than as many smooth shapes do, and
    parts of the regions explain little beside them."""
    regions = [_in_regions(c, layout)[0] for c in cells]
    explained = sum(_chi2(s) for s in regions)
    if explained < sum(_as_smooth(c, layout) for c in cells):
        return False
    number, frames = layout[0] * layout[1], sum(len(c.score) for c in cells)
    down, across = (k * (2 if n % (2 * k) == 0 else 3) for k, n in zip(layout, CELLS, strict=True))
    finer = sum(_chi2(_in_regions(c, (down, across))[0]) for c in cells)
    within = finer - explained - (down * across - number) * frames
    return within < _WITHIN * max(explained - (number - 1) * frames, 0.0)


def _score(cells: list[LineSums], layout: Layout) -> Score[Moving]:
    sums = [_in_regions(c, layout) for c in cells]
    found = component_score(
        np.concatenate([(s.score**2).sum(0) / np.maximum(s.information, 1e-30) for s, _ in sums]),
        np.concatenate([s.information for s, _ in sums]),
        np.concatenate([len(s.score) * left for s, left in sums]),
        scaling="additive",
        where={"axis": "block", "regions": list(layout)},
    )
    return cast(Score[Moving], found.replace(payload=Moving(found.payload, layout)))


def moving_score(fields: Many, *, layout: Layout | None = None) -> Score[Moving] | None:
    """One random offset of every region, new in every frame. The layout is told by what it explains, and is
    as given where the finding is looked for again."""
    if any(side < 2 * cells for side, cells in zip(fields[0].mean.shape, CELLS, strict=True)):
        return None
    cells = [_in_cells(f) for f in fields if len(f.contrasts)]
    layouts = [one for one in ([layout] if layout else LAYOUTS) if all(_shown(c, one) for c in cells)]
    if not cells or not layouts:
        return None
    best = max((_score(cells, one) for one in layouts), key=lambda s: s.gain)
    if layout is not None:
        return best
    if best.gain > 0 and not _whole(cells, best.payload.layout):
        best = best.replace(log_p=0.0, gain=0.0, amplitude=0.0, payload=best.payload._replace(variance=0.0))
    # Each layout has its chance.
    log_p = min(best.log_p + float(np.log(len(LAYOUTS))), 0.0)
    return best.replace(log_p=log_p, penalty=best.penalty + float(np.log(len(LAYOUTS))))


def moving_absorb(fields: Many, score: Score[Moving]) -> Many:
    """Whitens the offset of every region."""
    variance, layout = score.payload
    groups = cell_groups(fields[0].mean.shape, layout)
    return tuple(whitened(f, groups, variance) for f in fields)


def regions(*, name: str, parameter: str, covers: tuple[str, ...]) -> Signature:
    """Offsets of regions of equal size, new in every frame. parameter: the mechanism's strength."""

    def at(found: Found) -> Point:
        return dataclasses.replace(_POINT, blocks=found.score.payload.layout)

    return Signature(
        name=name,
        axes=Axes("readout", "amplifier", "redrawn", "additive", "white"),
        reads=CONTRASTS,
        score=moving_score,
        again=lambda fields, found: moving_score(fields, layout=found.payload.layout),
        absorb=moving_absorb,
        covers=covers,
        predict=NO_LAW,
        pattern=NO_PATTERN,
        simulate=lambda found: strength(parameter)(found)._replace(point=at(found)),
        place=placed(at),
        detectable=BY_SHIFT,
        least=NO_CLOSED_FORM,
    )
