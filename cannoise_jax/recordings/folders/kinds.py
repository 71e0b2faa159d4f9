"""The kind of every file of a folder: as headers, names and the caller say, and where values contradict."""

from __future__ import annotations

from collections.abc import Sequence

from cannoise_jax.recordings.folders.groups import Group
from cannoise_jax.recordings.folders.lights import level_of
from cannoise_jax.recordings.folders.names import listed
from cannoise_jax.recordings.folders.shots import Shot, matches
from cannoise_jax.recordings.recording import DARK

_LONGEST_BIAS_S = 1.0
"""Biases are taken at the shortest exposure; mechanical shutters reach some tenths of a second."""
_LIT_TIMES, LIT_DN = 2.0, 100.0
"""Darks of one exposure and temperature that are so many times, and so much, brighter than others were lit.
Dark current doubles within some 6 K; temperatures further apart than a few are settings of their own."""
TAKEN_AS_LIGHTS = "taken as lights"


def kinds_of(
    shots: Sequence[Shot], assign: Sequence[tuple[str, str]], override: str | None
) -> tuple[dict[str, str], list[str], list[str]]:
    """The kind of every shot, with notes on what was decided and problems where nothing decides."""
    kinds: dict[str, str] = {}
    unknown: dict[str, list[str]] = {}
    taken: dict[str, list[str]] = {}
    clashes: dict[str, list[str]] = {}
    for shot in shots:
        given = next((kind for pattern, kind in assign if matches(shot.name, pattern)), override)
        if given or shot.whole:
            kinds[shot.name] = given or shot.said or "scene"
            continue
        header, words = shot.said, shot.about.get("image_type")
        if header is None and shot.named is None:
            what = f"IMAGETYP {words!r} is unknown" if words else "neither header nor name says the kind"
            unknown.setdefault(what, []).append(shot.name)
            continue
        if header is None and words:
            taken.setdefault(f"IMAGETYP {words!r} is unknown: {shot.named} by name", []).append(shot.name)
        elif header == "scene" and shot.named not in (None, "scene"):
            taken.setdefault(f"{_stated(header, words)}, {shot.named} by name", []).append(shot.name)
            header = None
        elif {header, shot.named} == {"bias", "dark"} and not shot.known.get("exposure_s"):
            taken.setdefault("bias or dark of no exposure: bias", []).append(shot.name)
            header = "bias"
        elif header and shot.named not in (None, header) and shot.named != "scene":
            clashes.setdefault(f"{_stated(header, words)} but named {shot.named}", []).append(shot.name)
            continue
        kinds[shot.name] = header or shot.named or "scene"
    remedy = "put them in folders named bias, darks, flats or lights, or state --assign 'NAME*=KIND'"
    several = sum(what.startswith("IMAGETYP") for what in unknown) > 1
    if any(kind != "scene" for kind in kinds.values()) and not several:
        # Beside files that say what they are the others are what calibration frames are made for; words of
        # several kinds are not.
        for what, names in unknown.items():
            kinds |= dict.fromkeys(names, "scene")
            taken[f"{what}: {TAKEN_AS_LIGHTS}; --assign 'NAME*=KIND' says otherwise"] = names
        unknown = {}
    notes = [f"{listed(names)}: {what}" for what, names in taken.items()]
    problems = [f"{listed(names)}: {what}: {remedy}" for what, names in unknown.items()]
    problems += [
        f"{listed(n)}: {what}: rename, or state --assign 'NAME*=KIND'" for what, n in clashes.items()
    ]
    return kinds, notes, problems


def _stated(kind: str, words: str | None) -> str:
    """What a file says of its kind: a header in words of its own, a side-car by ours."""
    return f"its side-car says {kind}" if words is None else f"headed {words!r}"


def of_other_kinds(groups: Sequence[Group], stated: set[str]) -> list[str]:
    """Files that their values or exposures say are of another kind than they are called; stated: names of
    those whose kind the caller states."""
    out = []
    for group in (g for g in groups if g.kind in DARK):
        own = [s for s in group.shots if not s.whole and s.name not in stated]
        if group.kind == "bias":
            times = {s.name: s.known.get("exposure_s") or 0.0 for s in own}
            long = [n for n, t in times.items() if min(times.values()) <= _LONGEST_BIAS_S < t]
            if long:
                longest = max(times.values())
                out.append(f"{listed(long)}: a bias of {longest:g} s beside others of hardly any, a dark?")
        levels = {s.name: level_of([s]) for s in own}
        low = min(levels.values(), default=0.0)
        bright = [n for n, level in levels.items() if level > max(_LIT_TIMES * low, low + LIT_DN)]
        if bright:
            most = max(levels.values())
            out.append(f"{listed(bright)}: {group.kind} of {most:.0f} DN beside others of {low:.0f} DN, lit?")
    return [f"{words} Rename, state --assign 'NAME*=KIND', or leave out with --leave-out" for words in out]
