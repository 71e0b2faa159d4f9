"""Numbers in names of files: exposures as people write them, and what stands before or behind a word."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Collection, Iterable
from typing import NamedTuple

from cannoise_jax.recordings.recording import LONGEST_S

_SECONDS = {"us": 1e-6, "μs": 1e-6, "usec": 1e-6, "ms": 1e-3, "msec": 1e-3, "s": 1.0, "sec": 1.0, "secs": 1.0}
_SECONDS["min"] = 60.0
_UNIT = rf"({'|'.join(sorted(_SECONDS, key=len, reverse=True))})(?![a-z])"
_COMMAS = re.compile(r"(?<![\d.,])\d+(?:,\d+)+(?![\d.])")
_SETTING = re.compile(r"(?:gain|iso|bin|binning|offset|(?<![a-z])g)[ _-]?$", re.IGNORECASE)
"""Words that the number behind them belongs to, so that a comma after it parts a list."""
_POINT = re.compile(rf"(?<=\d)p(?=\d+[ _]?{_UNIT})", re.IGNORECASE)
_EXPOSURE = re.compile(
    # Not the seconds of a time of day, as in 20h10m05s and T20-10-05s.
    r"(?<![\d.,⁄∕])(?<!\dm)(?<!t\d\d[-:._]\d\d[-:._])"
    rf"(\d+(?:\.\d+)?(?:e[-+]?\d{{1,2}})?|(?<![a-z])\.\d+)[ _]?{_UNIT}",
    re.IGNORECASE,
)
_UNSURE = re.compile(rf"\d+(?:,\d+)+[ _]?{_UNIT}|(?<!\d)\d+m\d+s(?![a-z])", re.IGNORECASE)
_FRACTION = re.compile(r"(?<![\da-z.,])(?<!\d-)(\d+)([-⁄∕])([1-9]\d*)[ _]?s(?:ecs?)?(?![a-z])", re.IGNORECASE)
# fmt: off
_SHUTTERS = frozenset((
    2, 3, 4, 5, 6, 8, 10, 13, 15, 20, 25, 30, 40, 45, 50, 60, 80, 90, 100, 125, 160, 180, 200, 250, 320, 350,
    400, 500, 640, 750, 800, 1000, 1250, 1500, 1600, 2000, 2500, 3000, 3200, 4000, 5000, 6000, 6400, 8000,
    10000, 12800, 16000, 32000,
))
# fmt: on
"""Parts of a second that shutters are set to."""
_REMEDY = "write it as 0.5s or 20ms, or state it"


class Reading(NamedTuple):
    """What a name says, None where it says nothing for certain, and what is to be said about it."""

    value: float | None = None
    doubt: str | None = None


def plain(text: str) -> str:
    """The text with one letter mu, one sign of degrees, and decimal points for commas that can be no others.

    A comma that may part thousands, or the numbers of a list, stays.
    """
    text = unicodedata.normalize("NFKC", text)
    return _POINT.sub(".", _COMMAS.sub(_with_points, text))


def _with_points(match: re.Match) -> str:
    first, *rest = match[0].split(",")
    before = match.string[: match.start()]
    if len(rest) > 1 or _SETTING.search(before):
        return match[0].replace(",", ";")
    behind_a_word = before[-1:].isalpha()
    sure = first == "0" or not (behind_a_word or len(rest[0]) == 3)
    return f"{first}.{rest[0]}" if sure else match[0]


def counted(names: Iterable[str]) -> frozenset[str]:
    """Of names as 1-60s and 2-60s the seconds: what counts files is no numerator."""
    found = (match for name in names for match in _FRACTION.finditer(plain(name)))
    return frozenset(match[3] for match in found if match[1] != "1")


def exposure_in(text: str, counters: Collection[str] = ()) -> Reading:
    """The exposure that a part of a name states, seconds. counters: see `counted`."""
    text = plain(text)
    part = _FRACTION.search(text)
    if part and part[1] == "1" and int(part[3]) > 1 and not (part[2] == "-" and part[3] in counters):
        return _fraction(part)
    match = _EXPOSURE.search(text)
    if match is None:
        unsure = _UNSURE.search(text)
        return Reading(doubt=unsure and f"{unsure[0]!r} in names is not read as an exposure: {_REMEDY}")
    value = float(match[1]) * _SECONDS[match[2].lower()]
    if value > LONGEST_S:
        return Reading(doubt=f"{match[0]!r} in names is no exposure: {_REMEDY}")
    return Reading(value)


def _fraction(part: re.Match) -> Reading:
    """1-250s is a 250th of a second, where shutters have it and no hyphen before says that hyphens part."""
    told = part[2] != "-" or (int(part[3]) in _SHUTTERS and part.string[: part.start()][-1:] != "-")
    if not told:
        return Reading(doubt=f"{part[0]!r} in names may be 1/{part[3]} s or {part[3]} s: not read: {_REMEDY}")
    return Reading(1 / int(part[3]), f"{part[0]!r} in names is read as 1/{part[3]} s")


def number_beside(word: str, text: str, least: float = 0, most: float = 1e9) -> Reading:
    """The number at a word, as in iso800 and 800iso, where it lies in a range.

    What is joined to the word goes before what _ or - part from it: in 800iso_1 the 1 counts files.
    """
    text = plain(text)
    number = r"(\d+)(?:\.0+)?"
    behind = re.search(rf"(?<![a-z])(?:{word})([ _-]?){number}(?!\d|\.\d)", text, re.IGNORECASE)
    before = re.search(rf"(?<![\d.,]){number}(?:{word})(?![a-z])", text, re.IGNORECASE)
    found = [(bool(behind[1]), behind[2])] if behind else []
    found += [(False, before[1])] if before else []
    for _, digits in sorted(found, key=lambda one: one[0]):
        if least <= float(digits) <= most:
            return Reading(float(digits))
    return Reading(doubt=behind and f"{behind[0]!r} in names may count files: not read")
