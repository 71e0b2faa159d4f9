"""What the recordings of a folder lack for the measurements that they are made for."""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import pairwise
from pathlib import PurePath

import numpy as np

from cannoise_jax.recordings.folders.groups import Group
from cannoise_jax.recordings.folders.kinds import LIT_DN
from cannoise_jax.recordings.folders.lights import level_of
from cannoise_jax.recordings.folders.names import listed
from cannoise_jax.recordings.folders.shots import Shot, matches
from cannoise_jax.recordings.join import ALIKE_KELVIN
from cannoise_jax.recordings.recording import DARK

NO_LIGHT = (
    "no flats: without light no gain can be measured: record at least 2 frames of an even, steady light"
)


_APART_DN, _APART = 20.0, 8.0
"""DN, and times what files of one folder differ, from which on darks of two folders are no repeats."""

_FEW_LINES = 16
"""Rows or columns that no sensor has as few of."""
_SERIES = 3
"""Settings of what is lit from which on it looks like an exposure series."""


def contradictions(groups: Sequence[Group]) -> list[str]:
    """That the flats of one set are darker than all its darks, and darks of two folders far apart."""
    flats, darks = _flats_and_darks(groups)
    out = [line for g in groups if g.kind in DARK and (line := _of_two_places(g))]
    if not (flats and darks) or max(max(s.medians) for s in flats) >= min(min(s.medians) for s in darks):
        return out
    return [*out, f"{listed([s.name for s in flats])}: flats darker than every dark: are the kinds swapped?"]


def _of_two_places(group: Group) -> str:
    """That the darks of one recording lie in two folders, each alike and both far apart: headers that say
    nothing make two cameras, or two of their settings, one. Empty where they do not."""
    places: dict[str, list[Shot]] = {}
    for s in (s for s in group.shots if not s.whole):
        places.setdefault(PurePath(s.name).parent.as_posix(), []).append(s)
    own = sorted((p for p in places.values() if len(p) > 1), key=level_of)
    within = max((float(np.ptp([level_of([s]) for s in p])) for p in own), default=0.0)
    for low, high in pairwise(own):
        if level_of(high) - level_of(low) > max(_APART_DN, _APART * within):
            return (
                f"{group.kind}: {listed([s.name for s in low])} lie at {level_of(low):.0f} DN, "
                f"{listed([s.name for s in high])} at {level_of(high):.0f} DN: of two cameras or settings, "
                "which no header tells apart: convert each folder by itself, or --leave-out one"
            )
    return ""


_BIAS_S = 0.01
"""Seconds that programs write for a bias: the shortest of mechanical shutters."""


def _flats_and_darks(groups: Sequence[Group]) -> tuple[list[Shot], list[Shot]]:
    own = [(g.kind, s) for g in groups for s in g.shots if not s.whole]
    return [s for kind, s in own if kind == "flat"], [s for kind, s in own if kind in DARK]


def _dim(groups: Sequence[Group]) -> list[str]:
    """Flats no brighter than the darks of their own gain setting: others have another black level and other
    dark charge. One dark among its like that light reached says nothing of the flats."""
    by_gain: dict[tuple, list[Group]] = {}
    for g in groups:
        by_gain.setdefault((g.settings["iso"], g.settings["gain_db"]), []).append(g)
    out = []
    for own in by_gain.values():
        flats, _ = _flats_and_darks(own)
        darks = [[s for s in g.shots if not s.whole] for g in own if g.kind in DARK]
        floor = max(
            (float(np.median([max(s.medians) for s in shots])) for shots in darks if shots), default=-1.0
        )
        out += [s.name for s in flats if max(s.medians) <= floor]
    return out


def _exposed_biases(groups: Sequence[Group]) -> list[str]:
    """Biases that state an exposure as long as a dark's, or a second."""
    shortest = min((s for g in groups if g.kind == "dark" and (s := g.settings["exposure_s"])), default=1.0)
    biases = [s for g in groups if g.kind == "bias" for s in g.shots]
    return [s.name for s in biases if (s.known.get("exposure_s") or 0.0) >= min(max(shortest, _BIAS_S), 1.0)]


def _pattern(names: Sequence[str], groups: Sequence[Group]) -> str:
    """A pattern for the names that fits no other of their set."""
    pattern = os.path.commonprefix([PurePath(name).name for name in names]).rstrip("0123456789") + "*"
    others = (s.name for g in groups for s in g.shots if s.name not in names)
    return "NAME*" if pattern == "*" or any(matches(name, pattern) for name in others) else pattern


def lacks(groups: Sequence[Group]) -> list[str]:
    """What the recordings of one set lack, or what looks odd of them, a line each."""
    notes = []
    if groups and all(g.kind in DARK for g in groups):
        notes.append(NO_LIGHT)
    lights = [g for g in groups if g.kind == "scene" and not any(s.whole for s in g.shots)]
    if len(lights) >= _SERIES and {g.kind for g in groups} - {"scene"} <= set(DARK):
        notes.append(
            f"{lights[0].label} to {lights[-1].label}: taken as scenes: of an even light they are flats, "
            "which tell more: --assign 'NAME*=flat' says so"
        )
    turned = [s for g in groups for s in g.shots if not s.whole and s.frames >= 2 * min(s.shape[1:])]
    if turned := [s for s in turned if min(s.shape[1:]) <= _FEW_LINES]:
        count, height, width = turned[0].shape
        notes.append(
            f"{listed([s.name for s in turned])}: read as {count} frames of {height} x {width} pixels: an "
            "array is [T, H, W]: where the last axis is that of the frames store it first"
        )
    single = [f"{g.label} ({g.shots[0].name})" for g in groups if g.frames == 1]
    if single:
        notes.append(f"{listed(single)}: one frame, so no temporal noise: two or more show it")
    timeless = [g.label for g in groups if g.kind in ("dark", "flat") and g.settings["exposure_s"] is None]
    if timeless:
        notes.append(
            f"{listed(timeless)}: no exposure time in headers or names: what grows with it is not measured; "
            "names state it, as in dark_60s_1 or folders as in darks_60s"
        )
    if exposed := _exposed_biases(groups):
        notes.append(
            f"{listed(exposed)}: a bias has the shortest exposure that there is: where it was exposed for as "
            f"long as stated it is a dark: --assign '{_pattern(exposed, groups)}=dark' says so"
        )
    warm = [g.settings["temperature_c"] for g in groups if g.settings["temperature_c"] is not None]
    if warm and max(warm) - min(warm) > ALIKE_KELVIN:
        notes.append(f"temperatures from {min(warm):g} to {max(warm):g} C in one set: dark current differs")
    if dim := _dim(groups):
        notes.append(
            f"{listed(dim)}: flats no brighter than the darks of their gain: check that the light was on, "
            "and that none reached the darks"
        )
    gains = {g.settings["iso"] for g in groups if g.kind in DARK}
    alone = [g.label for g in groups if g.kind == "flat" and gains and g.settings["iso"] not in gains]
    if alone:
        notes.append(
            f"{listed(alone)}: no dark or bias of that gain: record some, without no gain is measured"
        )
    by_kind = [[s for g in groups if g.kind == kind for s in g.shots if not s.whole] for kind in DARK]
    if all(by_kind):
        dark, bias = map(level_of, by_kind)
        if bias > dark + max(LIT_DN, 0.1 * dark):
            notes.append(
                f"the biases ({bias:.0f} DN) lie above the darks ({dark:.0f} DN): of another offset or gain, "
                "or lit: the black level is theirs"
            )
    return notes
