"""What the names of files and folders say where headers are silent: kind, exposure, gain, temperature."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from pathlib import PurePath
from typing import Any, NamedTuple

from cannoise_jax.recordings.folders.numerals import Reading, exposure_in, number_beside, plain
from cannoise_jax.recordings.kind_words import kinds_in, one_of

_MOST_NAMED = 3
_AVERAGES = re.compile(r"(?<![a-z])(master|superbias|superdark|superflat|stacked|integrated|averaged)")
_COMBINED = re.compile(
    r"(?<![^\W\d_])(avg|average|mean|median)(?![^\W_])(?![ _-]*(?:\d|level|adu|dn|value|count))"
)
"""Words for averages beside that of a kind, as whole words: no level ("flat_mean_20000") and no street."""
_INTEGRATION = re.compile(r"^(?:drizzle_)?(integration)\d*$|(?<!time)(?<![ _-]t)(?<!^t)[ _-](integration)$")
"""As stacking programs call what they write; elsewhere integration is a word for exposure."""
_SHORT_GAIN = re.compile(r"(?<![a-z\d])g([1-9]\d*)(?![\da-z.])", re.IGNORECASE)
_DECIBELS = re.compile(r"(?<![a-z])gain[ _-]?(\d+(?:\.\d+)?) ?db(?![a-z])", re.IGNORECASE)
_ISO = 25, 5_000_000
"""Least and highest ISO of cameras: less counts files."""
_CELSIUS = re.compile(r"(?<![\d.,])([+-]?\d+(?:\.\d+)?) ?(?:°c|degc|c)(?![a-z\d])", re.IGNORECASE)
_BINNING = re.compile(r"(?<![a-z])bin(?:ning)?[ _-]?(\d)(?:x(\d))?", re.IGNORECASE)


_OF_FRAMES = {"field", "frame", "frames", "sky", "dome", "sequence", "test", "current", "level"}
"""Words beside that of a kind, where an object is called after what frames show."""


def named_kind(path: PurePath, target: str | None = None) -> str | None:
    """The kind that the file's name says, or else its nearest folder: dark flats are darks. target: what the
    frame is of, as its header has it, whose name says no kind: the Dark Shark is a nebula."""
    words = re.findall(r"[^\W_]+", target or "")
    other = any(not kinds_in(w) and w.lower() not in _OF_FRAMES and not w.isdigit() for w in words)
    name = r"[\W_]*".join(map(re.escape, words)) if kinds_in(target or "") and other else None
    for part in (path.stem, *reversed(path.parent.parts)):
        said = kinds_in(part if name is None else re.sub(name, " ", part, flags=re.IGNORECASE))
        if said:
            return one_of(said)
    return None


def counted_up(name: str) -> tuple[list[str | int], str]:
    """What names are sorted by so that their numbers count up: frame 2 before frame 10."""
    parts = re.split(r"(\d+)", name)
    return [int(part) if n % 2 else part for n, part in enumerate(parts)], name


def named_average(path: PurePath) -> str | None:
    """The word in the file's own name that says it is an average of frames."""
    lower = path.stem.lower()
    found = _AVERAGES.search(lower) or _INTEGRATION.search(lower)
    if not found and kinds_in(path.stem) - {"scene"}:
        found = _COMBINED.search(lower)
    return next(filter(None, found.groups()), None) if found else None


class NamedSettings(NamedTuple):
    """What names say: exposure_s, iso, temperature_c, gain_db, or gain_setting (in the camera's own unit),
    binning; and what is to be said of them, by field, whether it was read or not."""

    values: dict[str, Any]
    doubts: dict[str, str]


def named_settings(path: PurePath, counters: Collection[str] = ()) -> NamedSettings:
    """The settings that the name says, or else the nearest folder. counters: see `numerals.counted`."""
    values: dict[str, Any] = {}
    doubts: dict[str, str] = {}
    for part in (path.stem, *reversed(path.parent.parts)):
        text = plain(part)
        decibels = _DECIBELS.search(text)
        gain = {"gain_db": Reading(float(decibels[1]))} if decibels else {"gain_setting": _gain(part)}
        readings = {
            "exposure_s": exposure_in(part, counters),
            "iso": number_beside("iso", part, *_ISO),
            **gain,
        }
        for field, (value, doubt) in readings.items():
            if field not in values and field not in doubts:
                values |= {} if value is None else {field: value}
                doubts |= {} if doubt is None else {field: doubt}
        celsius, binning = _CELSIUS.search(text), _BINNING.search(text)
        if celsius and -100 <= float(celsius[1]) <= 100:
            values.setdefault("temperature_c", float(celsius[1]))
        if binning and (binning[1], binning[2] or binning[1]) != ("1", "1"):
            values.setdefault("binning", (float(binning[1]), float(binning[2] or binning[1])))
    return NamedSettings(values, doubts)


def _gain(part: str) -> Reading:
    in_full, short = number_beside("gain", part), _SHORT_GAIN.search(part)
    return in_full if in_full != Reading() or not short else Reading(float(short[1]))


def listed(names: Sequence[str]) -> str:
    """The first names, and how many more there are."""
    more = len(names) - _MOST_NAMED
    return ", ".join(names[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")
