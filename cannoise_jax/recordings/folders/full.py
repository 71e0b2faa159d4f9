"""Files that are left out because all their pixels are full: they show where the codes of others end."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from cannoise_jax.recordings.folders.groups import Group
from cannoise_jax.recordings.folders.shots import Shot
from cannoise_jax.recordings.recording import LIT


def with_full_codes(groups: Sequence[Group], full: Sequence[Shot], kinds: Mapping[str, str]) -> list[Group]:
    """The groups with the code at which those of their own gain are full. full: shots of which every pixel
    is; kinds: of these, by name. Only what was lit counts: a dark that is full is a fault."""
    lit = [s for s in full if kinds.get(s.name) in LIT]
    out = []
    for group in groups:
        tops = [s.top for s in lit if _gain(s) == _gain(group.shots[0])]
        more = {"full_code": float(max(tops))} if tops and not group.shots[0].whole else {}
        out.append(dataclasses.replace(group, settings={**group.settings, **more}))
    return out


def _gain(shot: Shot) -> tuple:
    """What a full code depends on."""
    about, known = shot.about, shot.known
    gains = known.get("iso"), about.get("gain_setting"), about.get("settings")
    return known.get("camera"), shot.shape[1:], *gains, about.get("bits")
