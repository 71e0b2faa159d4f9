"""Frames of one kind and exposure by the light that they were taken under.

A photon-transfer series may change the lamp instead of the exposure. Its frames agree in all that headers
state, and are no repeats of each other: temporal noise from all of them together would be that of the lamp.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from cannoise_jax.recordings.folders.shots import Shot

JUMP = 0.1
"""Levels above black that lie further apart than this share are of two lights. Lamps flicker by less, and a
sky that changes so much from one frame to the next gives no repeats."""
_STAIRS = 3.0
"""Times the spread of the levels of one light by which those of the next have to lie apart."""
DRIFT = 3.0
"""Times the dimmest level, up to which frames that all differ are of a light that drifts, as a sky at dusk:
scaled to one level they still show their noise."""


def level_of(shots: Sequence[Shot]) -> float:
    """Median level of the shots, DN, mean over the mosaic's sites."""
    return float(np.median([np.mean(s.medians) if s.pages is None else _level(s) for s in shots]))


def by_light(shots: Sequence[Shot], black: float) -> list[list[Shot]]:
    """The shots parted where their sorted levels jump, dimmest first; each part in the order given. A file
    whose pages are of several lights is parted likewise, into shots of some of its pages.

    black: level of the darks, DN. Where no part would have two frames, and the brightest is not far above the
    dimmest, the light drifts from frame to frame: all stay together.
    """
    single = [one for shot in shots for one in _pages(shot, black)]
    levels = [_level(one) - black for one in single]
    order = sorted(range(len(single)), key=levels.__getitem__)
    parts = [order[:1]]
    for dim, bright in pairwise(order):
        if _jumps(levels[dim], levels[bright], single[bright]):
            parts.append([])
        parts[-1].append(bright)
    parts = [finer for part in parts for finer in _steps(part, levels, single[part[0]].step)]
    drifts = levels[order[-1]] < DRIFT * levels[order[0]]
    if drifts and not any(sum(single[i].frames for i in part) > 1 for part in parts):
        return [list(shots)]
    return [_together([single[i] for i in sorted(part)]) for part in parts]


def _steps(part: list[int], levels: Sequence[float], step: float) -> list[list[int]]:
    """Numbers of shots, by level, parted further where they are a staircase of close steps: three lights or
    more, most of them of two shots or more taken one after the other, apart by several times what shots of
    one light differ."""
    gaps = np.diff([levels[n] for n in part])
    order = np.argsort(-gaps)
    for cuts in range(2, len(part) // 2 + 1):
        apart, within = gaps[order[cuts - 1]], gaps[order[cuts]] if cuts < len(gaps) else 0.0
        if apart <= _STAIRS * max(within, step):
            continue
        stairs = [list(p) for p in np.split(np.array(part), np.sort(order[:cuts]) + 1)]
        in_turn = all(max(stair) - min(stair) == len(stair) - 1 for stair in stairs)
        if in_turn and np.median([len(stair) for stair in stairs]) >= 2:
            return stairs
    return [part]


def _jumps(dim: float, bright: float, shot: Shot) -> bool:
    return bright - dim > max(JUMP * bright, 2 * shot.step)  # medians are whole codes


def _level(shot: Shot) -> float:
    return level_of([shot]) if shot.pages is None else float(shot.levels[shot.pages[0]] or 0.0)


def _pages(shot: Shot, black: float) -> list[Shot]:
    """Each page of a stack by itself where their levels jump, without those that hold no noise; else the
    shot."""
    known = {n: level - black for n, level in enumerate(shot.levels) if level is not None}
    order = sorted(known.values())
    if not any(_jumps(dim, bright, shot) for dim, bright in pairwise(order)):
        return [shot]
    return [shot._replace(pages=(n,)) for n in known]


def _together(shots: Sequence[Shot]) -> list[Shot]:
    """Pages of one file as one shot again."""
    out: dict[str, Shot] = {}
    for shot in shots:
        first = out.get(shot.name)
        if first is None or first.pages is None or shot.pages is None:
            out[shot.name] = shot
        else:
            out[shot.name] = first._replace(pages=(*first.pages, *shot.pages))
    return list(out.values())
