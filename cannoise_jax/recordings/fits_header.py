"""What the keywords of FITS headers say, in the dialects of the programs that write raw camera frames.

Gains: an ISO is an ISO. GAIN of astronomy cameras is a setting: of ZWO and Player One in 0.1 dB, which
becomes `gain_db` and, on the scale that everything else uses, an ISO of 100 x 10^(dB / 20). Of other makers
the scale is unknown: such a setting keeps recordings apart and claims no ratio. A GAIN with a fraction is
e-/DN.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from datetime import datetime, timedelta
from typing import Any

from cannoise_jax.recordings.fits_cards import EXPOSURES, exposures_in, number_in, text_in
from cannoise_jax.recordings.fits_readout import (
    NOT_STATED,
    binning_of,
    combined_of,
    doubted_count,
    em_gain_of,
    pedestal_doubt,
    settings_of,
)
from cannoise_jax.recordings.kind_words import kinds_in, one_of
from cannoise_jax.recordings.packing import to_shifted_cfa
from cannoise_jax.recordings.recording import COLDEST_C, HOTTEST_C, iso_of_gain

_TENTH_DB = re.compile(r"\b(zwo|asi\d|player ?one)", re.IGNORECASE)
_MONO = re.compile(r"\b(ASI\d+MM|QHY\d+M\b|\w+M-PRO MONO)|\bmono(chrome)?\b", re.IGNORECASE)
_KINDS = (("bias", "bias"), ("zero", "bias"), ("offset", "bias"), ("dark", "dark"), ("flat", "flat"))
_SCENES = ("light", "object", "scene", "science", "snap", "tricolor", "image")
_ISO = ("ISO", "ISOSPEED", "ISO-SPEE")
_EGAIN = ("EGAIN", "E-GAIN")
_TEMPERATURES = ("CCD-TEMP", "CCDTEMP", "TEMPERAT", "DET-TEMP", "SENSTEMP", "CAM-TEMP", "TEMP")
"""The last is of Andor."""


def kind_of(image_type: str) -> str | None:
    """The kind that the words of IMAGETYP name, None where they name none that is known."""
    words = image_type.strip().lower()
    if words in ("ob", "sci"):
        return "scene"
    if (kind := one_of(kinds_in(image_type))) is not None:
        return kind
    return next((kind for word, kind in (*_KINDS, *((s, "scene") for s in _SCENES)) if word in words), None)


def _image_type(header: Mapping[str, Any]) -> str:
    """What a header says that the frame shows. FRAME of INDI is a kind, of Andor the time of the frame."""
    frame = text_in(header, "FRAME")
    kind = "" if re.search(r"\d{4}", frame) or not re.search("[A-Za-z]{2}", frame) else frame
    return text_in(header, "IMAGETYP") or kind or text_in(header, "OBSTYPE")


def _camera(header: Mapping[str, Any]) -> str | None:
    return text_in(header, "INSTRUME", "CAMERA", "DETNAM", "HEAD") or None


_NO_COLOURS = ("", "MONO", "NONE", "MONOCHROME", "GRAY", "GREY", "GRAYSCALE", "GREYSCALE")


def known_of(header: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a recording that a header states."""
    pattern = text_in(header, "BAYERPAT", "COLORTYP").upper()
    shift = _whole(header, "YBAYROFF"), _whole(header, "XBAYROFF")
    camera = _camera(header)
    # What is neither a cell of 2x2 nor a word for none is handed on, to be refused by what it says.
    cfa = None if pattern in _NO_COLOURS else pattern
    if cfa is not None and len(cfa) == 4:
        cfa = to_shifted_cfa(cfa, *shift)
    if cfa is None and (
        header.get("COLORCCD") in (0, False) or pattern == "MONO" or _MONO.search(camera or "")
    ):
        cfa = "MONO"
    decibels = gain_db(header, camera)
    iso = number_in(header, _ISO, 1)
    image_type = _image_type(header)
    return {
        "cfa": cfa,
        "white_level": number_in(header, ("SATURATE", "SATLEVEL"), 1),
        "camera": camera,
        "kind": kind_of(image_type) if image_type else None,
        "iso": iso_of_gain(decibels) if iso is None and decibels is not None else iso,
        "gain_db": decibels if iso is None else None,
        "egain": _egain(header, decibels is not None or iso is not None),
        "em_gain": em_gain_of(header),
        "exposure_s": next(iter(exposures_in(header).values()), None),
        "temperature_c": _celsius(number_in(header, _TEMPERATURES, COLDEST_C)),
    }


def about_of(header: Mapping[str, Any], planes: int = 1) -> dict[str, Any]:
    """What a header states beside the fields of a recording, see `opened.Opened`; planes: of the image, which
    a header may count without meaning an average of as many."""
    camera = _camera(header)
    scaled = gain_db(header, camera) is not None or number_in(header, _ISO, 1) is not None
    gain = number_in(header, ("GAIN",), 0)
    if number_in(header, _EGAIN, 1e-6) is None and _egain(header, scaled) is not None:
        gain = None
    image_type = _image_type(header)
    words = next((w for w in ("master", "stacked", "combined", "super") if w in image_type.lower()), None)
    origin = tuple(number_in(header, (f"{a}ORGSUBF",), 0) or 0.0 for a in "XY")
    name = text_in(header, "FILTER")
    return {
        "doubt": _doubt(header, planes),
        "image_type": image_type or None,
        "object": text_in(header, "OBJECT") or None,
        "filter": name if name.lower() not in NOT_STATED else None,
        "binning": binning_of(header),
        "origin": None if origin == (0, 0) else origin,
        "offset": number_in(header, ("OFFSET", "BLKLEVEL"), 0),
        "mode": text_in(header, "READOUTM", "RDMODE") or None,
        "gain_setting": None if scaled else gain,
        "taken_s": taken_s(header),
        "set_temperature_c": _celsius(number_in(header, ("SET-TEMP",), COLDEST_C)),
        "settings": settings_of(header),
        "combined": combined_of(header, planes) or (f"IMAGETYP {image_type}" if words else None),
    }


def taken_s(header: Mapping[str, Any]) -> float | None:
    """When the exposure began, in seconds of an epoch of no matter, where the header states date and time."""
    date, time = text_in(header, "DATE-OBS", "DATE-BEG", "FRAME"), text_in(header, "TIME-OBS", "UT")
    try:
        taken = datetime.fromisoformat(date if "T" in date or not time else f"{date}T{time}")
        universal = taken.replace(tzinfo=None) - (taken.utcoffset() or timedelta())
    except (ValueError, OverflowError):
        return None
    return (universal - datetime(1970, 1, 1)).total_seconds()


def _doubt(header: Mapping[str, Any], planes: int) -> str | None:
    """What a header says that cannot be meant, or that may mean that the frame is no raw one."""
    said = (_doubted_exposure(header), _doubted_temperature(header), doubted_count(header, planes))
    return "; ".join(filter(None, (*said, pedestal_doubt(header)))) or None


def _doubted_exposure(header: Mapping[str, Any]) -> str | None:
    stated = {name: header[name] for name in EXPOSURES if text_in(header, name)}
    good = exposures_in(header)
    if stated and not good:
        return ", ".join(f"{name} {value!r}" for name, value in stated.items()) + ": no time: not used"
    longest = max(good.values(), default=0.0)
    # Some programs round to whole seconds: of long exposures that is little, of short ones another exposure.
    if good and longest - min(good.values()) > min(max(1.0, 0.01 * longest), 0.1 * longest):
        words = [f"{name} {value:g} s" for name, value in good.items()]
        return f"{' and '.join(words)} contradict: {words[0]} is used"
    return None


def _doubted_temperature(header: Mapping[str, Any]) -> str | None:
    for name in (*_TEMPERATURES, "SET-TEMP"):
        celsius = number_in(header, (name,), COLDEST_C)
        if celsius is not None and _celsius(celsius) is None:
            return f"{name} {celsius:g}: no temperature of a sensor in C: not used"
    return None


def _celsius(value: float | None) -> float | None:
    """A temperature that a sensor may have: programs also write kelvin."""
    return value if value is not None and value <= HOTTEST_C else None


def gain_db(header: Mapping[str, Any], camera: str | None) -> float | None:
    """GAIN in dB, for cameras that count it in 0.1 dB."""
    tenths = number_in(header, ("GAIN",), 0)
    if tenths is None or not _TENTH_DB.search(f"{camera} {text_in(header, 'SWCREATE')}" if camera else ""):
        return None
    return tenths / 10


def _egain(header: Mapping[str, Any], scaled: bool) -> float | None:
    """e-/DN as stated. GAIN is that where it has a fraction and no scale of its own."""
    gain = number_in(header, ("GAIN",), 0)
    fraction = gain if gain is not None and not scaled and gain != round(gain) else None
    return number_in(header, _EGAIN, 1e-6) or fraction


def section(text: Any) -> tuple[slice, slice, bool, bool] | None:
    """Rows and columns of `[x1:x2,y1:y2]`, counted from 1 and inclusive, and whether y and x run down."""
    found = re.fullmatch(r"\s*\[\s*(\d+):(\d+)\s*,\s*(\d+):(\d+)\s*\]\s*", str(text or ""))
    if not found:
        return None
    x1, x2, y1, y2 = map(int, found.groups())
    if min(x1, x2, y1, y2) < 1:
        return None
    return slice(min(y1, y2) - 1, max(y1, y2)), slice(min(x1, x2) - 1, max(x1, x2)), y2 < y1, x2 < x1


def _whole(header: Mapping[str, Any], name: str) -> int:
    value = number_in(header, (name,), -math.inf)
    return 0 if value is None else int(value)
