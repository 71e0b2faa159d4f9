"""Colour order, black and white level of a set where nobody states them: proposed from its data, and said."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from cannoise_jax.recordings.folders.groups import Group, seconds
from cannoise_jax.recordings.folders.lights import level_of
from cannoise_jax.recordings.folders.sites import Sites, light_of, lines_apart, other_colours, shows_colours
from cannoise_jax.recordings.recording import DARK, PerChannel, per_channel

_DEPTHS = (255, 1023, 4095, 16383, 65535)
_SHIFTS = (4, 16, 64, 256)
"""Distances of the codes of converters of 14, 12, 10 and 8 bits that are shifted to 16. Of any other distance
no converter is common: there the codes have to reach beyond half of 16 bits."""
_HALF = 32767


GUESSED = "the highest value is"
"""Words by which a white level that nobody states is told from others."""


class Levels(NamedTuple):
    """What holds for all recordings of a set. values: fields of `Recording`. said: where each comes from.
    missing: what could not be found, each with its remedy."""

    values: dict[str, Any]
    said: tuple[str, ...]
    missing: tuple[str, ...]


def levels(groups: Sequence[Group], overrides: dict[str, Any]) -> Levels:
    """Colour order, black and white level for the groups of one set, complete recordings aside."""
    loose = [g for g in groups if not all(s.whole for s in g.shots)]
    if not loose:
        return Levels({}, (), ())
    values: dict[str, Any] = {}
    said, missing = [], []
    for name, propose in (("cfa", _cfa), ("black_level", _black), ("white_level", _white)):
        if name in overrides:
            continue
        value, words = propose(loose)
        if value is None:
            missing.append(words)
            continue
        values[name] = value
        said += [words] if words else []
    cfa, light = {**values, **overrides}.get("cfa"), _light(loose)
    if cfa is not None and light is not None and (wrong := other_colours(light.levels, cfa)):
        said.append(wrong)
    black, white = ({**values, **overrides}.get(n) for n in ("black_level", "white_level"))
    if overrides.get("black_level") is not None and min(per_channel(overrides["black_level"])) < 0:
        missing.append(
            f"the black level: {min(per_channel(overrides['black_level'])):g} DN is stated, and stored codes "
            "start at 0: state one from 0 on with --black-level"
        )
    if black is not None and white is not None and max(per_channel(black)) >= white:
        missing.append(
            f"the white level of {white:g} DN is not above the black level, {max(per_channel(black)):g} DN: "
            "state them with --white-level and --black-level"
        )
    return Levels(values, tuple(said), tuple(missing))


def _stated(groups: Sequence[Group], name: str) -> list[Any]:
    return [s.known[name] for g in groups for s in g.shots if name in s.known]


def _cfa(groups: Sequence[Group]) -> tuple[str | None, str]:
    stated = set(_stated(groups, "cfa"))
    if stated:
        return stated.pop(), ""
    light = _light(groups)
    if light is None:
        return None, "the colour order: state it with --cfa (MONO for a monochrome sensor)"
    if not shows_colours(light):
        return "MONO", "MONO: no header states colours, and the four sites of the flats are equally bright"
    if (apart := lines_apart(light.levels)) is None:
        sites = ", ".join(f"{v:.4g}" for v in light.levels)
        return (
            None,
            f"the colour order: the flats show a mosaic (its four sites: {sites}): state it with --cfa",
        )
    return "MONO", (
        f"MONO: no header states colours, and odd and even {apart.lines} of the flats differ by "
        f"{100 * apart.share:.2g} %, which no mosaic does: amplifiers of their own, as a rule"
    )


def _light(groups: Sequence[Group]) -> Sites | None:
    """Light of the flats on the four sites; None without flats."""
    lit = [s.sites for g in groups if g.kind == "flat" for s in g.shots]
    return light_of(lit, [s.sites for g in groups if g.kind in DARK for s in g.shots]) if lit else None


_RISES = 3.0
"""Codes by which darks have to rise from the shortest exposure to the longest for their charge to count."""


def _black(groups: Sequence[Group]) -> tuple[PerChannel | None, str]:
    shots = [s for g in groups for s in g.shots]
    stated = [per_channel(s.known["black_level"]) for s in shots if "black_level" in s.known]
    if stated:
        level = per_channel(np.median(stated, axis=0))
        origin = next((s.about["black_from"] for s in shots if s.about.get("black_from")), None)
        if origin is None and len(set(stated)) == 1:
            return level, ""
        return level, f"black level {_four(level)} DN: median of {origin or 'what the files state'}"
    dark = [g for g in groups if g.kind in DARK]
    if not dark:
        return None, (
            "the black level: add bias or dark frames, without which no read noise is measured either, or "
            "state it with --black-level"
        )

    def order(group: Group) -> tuple:
        exposure = group.settings["exposure_s"]
        return group.kind != "bias", exposure is None, exposure or 0.0, level_of(group.shots)

    first = min(dark, key=order)
    level = per_channel(np.median([s.medians for s in first.shots], axis=0))
    if groups[0].mode[7] in ("MONO", None) and np.ptp(level) <= 2:
        level = per_channel(float(np.median(level)))
    exposure = first.settings["exposure_s"]
    longest = max(dark, key=lambda g: g.settings["exposure_s"] or 0.0)
    rise = np.median([s.medians for s in longest.shots]) - float(np.mean(level))
    if exposure and rise >= _RISES and longest.settings["exposure_s"] > exposure:
        # Dark charge is no black level: by a straight line to no exposure.
        charge = rise * exposure / (longest.settings["exposure_s"] - exposure)
        level = per_channel(np.round(np.asarray(level) - charge))
        span = f"{seconds(exposure)} and {seconds(longest.settings['exposure_s'])}"
        return level, f"black level {_four(level)} DN: darks of {span}, by a line to none"
    of = "" if exposure is None else f" of {seconds(exposure)}"
    what = "biases" if first.kind == "bias" else f"darks{of}"
    return level, f"black level {_four(level)} DN: median of the {what}"


def _white(groups: Sequence[Group]) -> tuple[float | None, str]:
    stated = {float(v) for v in _stated(groups, "white_level")}
    if len(stated) == 1:
        return stated.pop(), ""
    if stated:
        return min(stated), f"white level {min(stated):g} DN: the lowest that the files state"
    shots = [s for g in groups for s in g.shots]
    full = [int(g.settings["full_code"]) for g in groups if "full_code" in g.settings]
    top, step = max([*full, *(s.top for s in shots)]), int(np.gcd.reduce([*full, *(s.step for s in shots)]))
    narrow = all(
        s.about.get("bits") == 8 for s in shots
    )  # dim frames of a wider word are no camera of 8 bits
    depth = next(d for d in _DEPTHS[0 if narrow else 1 :] if top <= d)
    if step in _SHIFTS or (top > _HALF and (step & (step - 1)) == 0 and step > 1):
        # Codes shifted left: the highest code of a full word.
        highest = 65536 - step
        return float(highest), f"white level {highest} DN: codes {step} apart, shifted to 16 bits"
    highest = top if step > depth else top + (depth - top) // step * step
    if all(g.kind in DARK for g in groups) and top < depth:  # hot pixels may reach the highest code
        return None, (
            f"the white level: darks alone, here of {top} DN at most, do not show it: add flats, or state it "
            "with --white-level"
        )
    apart = f", codes {step} apart" if step > 1 else ""
    return float(highest), (
        f"white level {highest} DN: {GUESSED} {top}{apart}, so of {depth.bit_length()} bits; "
        "where the sensor saturates elsewhere, state it with --white-level"
    )


def _four(level: PerChannel) -> str:
    return f"{level[0]:g}" if len(set(level)) == 1 else ", ".join(f"{v:g}" for v in level)
