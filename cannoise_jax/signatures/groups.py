"""Offsets shared by groups of pixels that no listed mechanism shares: tiles, diagonals, the sites of a
colour.

Points of the grammar without a name: what is found here is reported as unknown, with its axis.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import Literal

import numpy as np

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.places import PlaceName
from cannoise_jax.signatures.added import placed, strength
from cannoise_jax.signatures.answers import response, stays
from cannoise_jax.signatures.fields import Fields, channel_index, map_contrasts
from cannoise_jax.signatures.group_sums import (
    Groups,
    SharedSums,
    by_own_noise,
    group_pixels,
    grouped,
    held_variance,
    shared_sums,
)
from cannoise_jax.signatures.handed import Found
from cannoise_jax.signatures.line_sums import alone, component_score
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    CONTRASTS,
    NO_CLOSED_FORM,
    NO_LAW,
    NO_PATTERN,
    NOT_SIMULATED,
    STATIC,
    Axes,
    Scales,
    Signature,
)


@lru_cache(maxsize=16)
def layout(name: str, size: tuple[int, int]) -> Groups:
    """The groups of a layout."""
    return grouped(_numbers(name, size))


def _numbers(name: str, size: tuple[int, int]) -> np.ndarray:
    """Number of the group of every pixel."""
    rows, columns = np.indices(size)
    if name == "site":
        return channel_index(size)
    if name.endswith("parity"):
        return rows % 2 if name == "row_parity" else columns % 2
    if name == "diagonal":
        return rows - columns + size[1] - 1
    if name == "antidiagonal":
        return rows + columns
    side = int(name.removeprefix("tile_"))
    return rows // side * -(-size[1] // side) + columns // side


def _sums(field: Fields, values: np.ndarray, groups: Groups, scaling: str, own: bool = False):
    """Scores [n, groups] and information [groups] of one offset per group, the frame's own taken out, and the
    share of a degree of freedom that this leaves to each group."""
    r = response(field, scaling).astype(np.float32)
    information = groups.sums(r.astype(np.float64) ** 2)
    total = max(float(information.sum()), 1e-30)
    score = np.array([groups.sums(v * r) for v in values])
    score = score - score.sum(1, keepdims=True) / total * information
    left = 1 - information / total
    if own:
        score, more = by_own_noise(score, group_pixels(values, r, groups), groups.sums(r > 0))
        information = information * more
    return score, information, left


def _shared(fields: tuple[Fields, ...], groups: Groups) -> SharedSums | None:
    """Sums of a pattern that stays. The smooth mean of a flat takes large tiles away, so only darks and
    scenes show it."""
    return shared_sums(tuple(f for f in fields if f.kind != "flat"), groups, "additive")


def _left(sums: SharedSums) -> np.ndarray:
    """Share of a degree of freedom that each group keeps beside the mean."""
    return 1 - sums.information / max(float(sums.information.sum()), 1e-30)


def group_score(
    fields: tuple[Fields, ...], *, name: str, time: str, scaling: str = "additive"
) -> Score[float] | None:
    """White offsets of groups of pixels, new in every frame, or of darks and scenes and staying; relative:
    factors of their light, new in every frame."""
    powers, informations, freedoms = [], [], []
    groups = layout(name, fields[0].mean.shape)
    if time == "redrawn":
        shown = [f for f in fields if len(f.contrasts) and (f.lit or scaling == "additive")]
        sums = [_sums(f, f.contrasts, groups, scaling, own=True) for f in shown]
    else:
        sums = [(s.score[None], s.information, _left(s)) for s in [_shared(fields, groups)] if s]
    for score, information, left in sums:
        powers.append((score**2).sum(0) / np.maximum(information, 1e-30))
        informations.append(information)
        freedoms.append(len(score) * left)
    if not powers or np.sum(np.concatenate(freedoms)) < 2:  # such as one tile that covers the frame
        return None
    channel = name == "site" or name.endswith("parity")
    where = {"axis": "channel", "channel": name} if channel else {"axis": "block", "layout": name}
    return component_score(
        np.concatenate(powers),
        np.concatenate(informations),
        np.concatenate(freedoms),
        scaling=scaling,
        where=where,
    )


def group_absorb(
    fields: tuple[Fields, ...], score: Score[float], *, name: str, time: str, scaling: str = "additive"
) -> tuple[Fields, ...]:
    """Whitens what was drawn anew; takes the whitening part of a pattern that stays out of all fields."""
    groups = layout(name, fields[0].mean.shape)
    if time == "redrawn":
        if name.startswith(("tile", "diagonal", "antidiagonal")):
            return tuple(whitened(f, groups, score.payload) for f in fields)
        return tuple(
            _apart(f, groups, score.payload, scaling) if f.lit or scaling == "additive" else f for f in fields
        )
    sums = _shared(fields, groups)
    if sums is None:
        return fields
    u, i = sums.score, sums.information
    spread = (u * (1 - 1 / np.sqrt(1 + score.payload * i)) / np.maximum(i, 1e-30))[groups.of]
    return tuple(
        f
        if f.static is None or f.kind == "flat"
        else f._replace(
            static=(f.static - np.sqrt(f.frames) * spread * stays(f, "pixel", "additive")).astype(np.float32)
        )
        for f in fields
    )


def whitened(field: Fields, groups: Groups, variance: float) -> Fields:
    """Offsets of groups move the mean of the frame as well: that part is whitened with the rest. The modelled
    noise holds them too."""
    if len(field.contrasts):
        held = held_variance(group_pixels(field.contrasts, field.weight.astype(np.float32), groups))
        field = alone(field, held[groups.of], variance, "additive")
    r = field.weight.astype(np.float32)
    information = groups.sums(r.astype(np.float64) ** 2)
    shrink = (1 - 1 / np.sqrt(1 + variance * information)) / np.maximum(information, 1e-30)

    def function(x: np.ndarray) -> np.ndarray:
        removed = [(groups.sums(v * r) * shrink)[groups.of] * r for v in x]
        return (x - np.array(removed)).astype(np.float32) if len(x) else x

    return map_contrasts(field, function)


def _apart(field: Fields, groups: Groups, variance: float, scaling: str) -> Fields:
    """What a few groups, such as the sites of a colour, differ by projected out: they are too few for one
    variance to fit each. What that adds to the mean of the frame is whitened, the rest of it is the frame's
    own. The modelled noise is without these offsets."""
    r = response(field, scaling).astype(np.float32)
    information = groups.sums(r.astype(np.float64) ** 2)
    total = max(float(information.sum()), 1e-30)
    kept = 1 / np.sqrt(1 + variance * float(np.sum(information**2)) / total)

    def function(x: np.ndarray) -> np.ndarray:
        scores = [groups.sums(v * r) for v in x]
        removed = [
            (s / np.maximum(information, 1e-30) - kept * s.sum() / total)[groups.of] * r for s in scores
        ]
        return (x - np.array(removed)).astype(np.float32) if len(x) else x

    return map_contrasts(field, function)


def shared(
    name: str,
    layout_name: str,
    time: Literal["redrawn", "frozen"],
    *,
    scaling: Scales = "additive",
    parameter: str | None = None,
    covers: tuple[str, ...],
) -> Signature:
    """Offsets (or factors of the light) shared by the pixels of each group of a layout."""
    over: PlaceName = "block" if "tile" in layout_name else "channel"
    over = "diagonal" if layout_name == "diagonal" else over
    over = "antidiagonal" if layout_name == "antidiagonal" else over

    def point(found: Found) -> Point:
        if scaling != "additive":
            return Point("photons", "mean", "channel", time, "multiply")
        if over == "block":
            side = int(layout_name.removeprefix("tile_"))
            blocks = (-(-found.size[0] // side), -(-found.size[1] // side))
            return Point("readout", "signal", "block", time, blocks=blocks)
        return Point("readout", "signal", over, time)  # type: ignore[arg-type]

    reads = CONTRASTS if time == "redrawn" else STATIC
    return Signature(
        name=name,
        kin=layout_name,
        axes=Axes("readout" if scaling == "additive" else "photons", over, time, scaling, "white"),
        reads=reads | (frozenset({"signal"}) if scaling == "signal" else frozenset()),
        score=partial(group_score, name=layout_name, time=time, scaling=scaling),
        absorb=partial(group_absorb, name=layout_name, time=time, scaling=scaling),
        covers=covers,
        predict=NO_LAW,
        pattern=NO_PATTERN,
        simulate=strength(parameter) if parameter else NOT_SIMULATED,
        place=placed(point),
        detectable=BY_SHIFT,
        least=NO_CLOSED_FORM,
        drawn_once=time == "frozen",
    )
