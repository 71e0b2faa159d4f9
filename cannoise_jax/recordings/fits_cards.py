"""Values of the cards of FITS headers: text and numbers as programs write them, and exposures in seconds."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

from cannoise_jax.recordings.folders.numerals import plain

EXPOSURES = {"EXPTIME": "s", "EXPOSURE": "s", "EXP_TIME": "s", "EXPOINUS": "us"}
"""Keywords of exposures, with the unit where neither value nor comment has one. The last is of ASICAP."""
_SECONDS = (
    (1e-9, "ns|nanosec(?:ond)?s?"),
    (1e-6, "us|usecs?|microsec(?:ond)?s?"),
    (1e-3, "ms|msecs?|millisec(?:ond)?s?"),
    (1.0, "s|secs?|seconds?"),
    (60.0, "min|mins|minutes?"),
    (3600.0, "h|hours?"),
)
_UNIT = "|".join(units for _, units in _SECONDS)
# The FITS standard 4.0, Sec. 4.3.2, has the unit in brackets before the comment; others write it in words.
_COMMENTED = re.compile(rf"[\[(]\s*({_UNIT})\s*[\])]|\bin\s+({_UNIT})\b|^\s*({_UNIT})\s*$", re.IGNORECASE)
_WITH_UNIT = re.compile(rf"\s*(.*\d\.?)\s*({_UNIT})\s*", re.IGNORECASE)


def plain_cards(header: Any) -> dict[str, tuple[str, Any, str]]:
    """Keyword, value and comment of every card that states something, by keyword."""
    names = dict.fromkeys(name for name in header if name not in ("", "COMMENT", "HISTORY", "END"))
    return {name: (name, header[name], header.comments[name]) for name in names}


def text_in(header: Mapping[str, Any], *names: str) -> str:
    """The first of these keywords that holds text."""
    return next((t for name in names if (t := str(header.get(name, "") or "").strip())), "")


def number_in(header: Mapping[str, Any], names: tuple[str, ...], least: float) -> float | None:
    """The first of these keywords that holds a number from `least` up; programs also write 'n/a' or -1."""
    found = (_number(header.get(name), least) for name in names)
    return next((number for number in found if number is not None), None)


def exposures_in(header: Mapping[str, Any]) -> dict[str, float]:
    """The exposures that a header states, seconds, by keyword; the unit is in the value, else in the comment
    of the card, else seconds."""
    found = {}
    for name, unit in EXPOSURES.items():
        value = header.get(name)
        comment = str(header.comments[name]) if value is not None and hasattr(header, "comments") else ""
        if stated := _COMMENTED.search(comment):
            unit = next(filter(None, stated.groups()))
        if isinstance(value, str) and (with_unit := _WITH_UNIT.fullmatch(value)):
            value, unit = with_unit.groups()
        number = _number(value, 0)
        if number is not None:
            found[name] = number * _seconds(unit)
    return found


def _seconds(unit: str) -> float:
    return next(factor for factor, units in _SECONDS if re.fullmatch(units, unit, re.IGNORECASE))


def _number(value: Any, least: float) -> float | None:
    """A number from `least` up, in text with a comma or a point as people write them."""
    if isinstance(value, bool) or value is None:
        return None
    try:
        number = float(plain(value) if isinstance(value, str) else value)
    except (TypeError, ValueError):
        return None
    return number if least <= number < math.inf else None
