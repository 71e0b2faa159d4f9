"""What the names of files and folders say where headers are silent: kind, exposure, gain, temperature."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import PurePath
from typing import Any

from cannoise_jax.recordings.kind_words import kinds_in, one_of

_MOST_NAMED = 3
_AVERAGES = ("master", "superbias", "superdark", "superflat", "stacked", "integration", "averaged")
_SECONDS = {"us": 1e-6, "µs": 1e-6, "usec": 1e-6, "ms": 1e-3, "msec": 1e-3, "s": 1.0, "sec": 1.0, "secs": 1.0}
_SECONDS["min"] = 60.0
_EXPOSURE = re.compile(
    r"(?<![\d.])(\d+(?:\.\d+)?)[ _]?(us|µs|usec|ms|msec|secs?|s|min)(?![a-z])", re.IGNORECASE
)
_ISO = re.compile(r"(?<![a-z])iso[ _-]?(\d+)(?!\d)", re.IGNORECASE)
_GAIN = re.compile(r"(?<![a-z])gain[ _-]?(\d+)(?![\d.])|(?<![a-z\d])g([1-9]\d*)(?![\da-z.])", re.IGNORECASE)
_CELSIUS = re.compile(r"(?<![\d.])([+-]?\d+(?:\.\d+)?) ?(?:°c|degc|c)(?![a-z\d])", re.IGNORECASE)
_BINNING = re.compile(r"(?<![a-z])bin(?:ning)?[ _-]?(\d)(?:x(\d))?", re.IGNORECASE)


def named_kind(path: PurePath) -> str | None:
    """The kind that the file's name says, or else its nearest folder: dark flats are darks."""
    for part in (path.stem, *reversed(path.parent.parts)):
        said = kinds_in(part)
        if said:
            return one_of(said)
    return None


def named_average(path: PurePath) -> str | None:
    """The word in the file's own name that says it is an average of frames."""
    lower = path.stem.lower()
    return next((word for word in _AVERAGES if re.search(rf"(?<![a-z]){word}", lower)), None)


def named_settings(path: PurePath) -> dict[str, Any]:
    """exposure_s, iso, temperature_c and gain (in the camera's own unit), as far as names say them."""
    out: dict[str, Any] = {}
    for part in (path.stem, *reversed(path.parent.parts)):
        exposure, iso, gain = _EXPOSURE.search(part), _ISO.search(part), _GAIN.search(part)
        celsius, binning = _CELSIUS.search(part), _BINNING.search(part)
        if exposure:
            out.setdefault("exposure_s", float(exposure[1]) * _SECONDS[exposure[2].lower()])
        if iso and float(iso[1]) > 0:
            out.setdefault("iso", float(iso[1]))
        if gain:
            out.setdefault("gain_setting", float(gain[1] or gain[2]))
        if celsius and -100 <= float(celsius[1]) <= 100:
            out.setdefault("temperature_c", float(celsius[1]))
        if binning and (binning[1], binning[2] or binning[1]) != ("1", "1"):
            out.setdefault("binning", (float(binning[1]), float(binning[2] or binning[1])))
    return out


def listed(names: Sequence[str]) -> str:
    """The first names, and how many more there are."""
    more = len(names) - _MOST_NAMED
    return ", ".join(names[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")
