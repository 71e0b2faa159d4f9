"""What headers of FITS files say of the readout: settings, binning, and how many frames were made one.

Cameras and programs have words of their own for what changes gain and noise. What they count in is seldom
known and never needed: frames whose words differ are not of one setting.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from cannoise_jax.recordings.fits_cards import number_in, text_in

NOT_STATED = ("", "none", "unknown", "n/a", "na", "-")
EM_GAIN = ("EMREALGN", "EMGAIN", "EM-GAIN", "EM_GAIN", "EM GAIN")
"""By how much charge is multiplied before it is read; Andor writes the real one and that asked for."""
_GAIN = (
    *("GAINMODE", "GAIN_MOD", "GAINMOD", "CONVGAIN", "CGMODE", "PREAMP", "CAMGAIN", "CCDGAIN"),
    *(*EM_GAIN, "EMMODE", "CNTCVTMD"),
)
_RATE = (
    *("READTIME", "READRATE", "READSPD", "READSPEE", "READSPEED", "RDSPEED", "RDRATE", "ROSPEED", "CCDSPEED"),
    *("PIXRATE", "HSSPEED", "VSSPEED", "HSHIFT", "VSHIFT", "VCLKAMP", "ESO DET READ SPEED"),
)
_MODE = (
    *("READMODE", "RDOUTMOD", "READMD_S", "ROMODE", "SAMPMODE", "MULTISAM", "NREADS", "FOWLER", "LNRS"),
    *("OUTPTAMP", "ADCHANNE", "BLCLAMP", "ESHTMODE", "ESO DET READ CURNAME", "ESO DET MODE NAME"),
)
_BLACK = ("PEDESTAL", "BRIGHTNS", "BLACKLVL", "BLACKLEV")
_PLACE = ("STARTX", "STARTY", "SUBRECT")
_UNIT = (
    *("SERNO", "SERIAL", "SERIALNO", "SERNUM", "CAMSERNO", "CAMSER", "CAMSERIA", "CCDSERN", "DETSER"),
    *("CAM-SN", "CAMID", "CAM-ID", "CAMERAID"),
)
SETTINGS = (*_GAIN, *_RATE, *_MODE, *_BLACK, *_PLACE, *_UNIT)
"""Words of gain, rate and mode of the readout, of the black level, of the part of the sensor that is read,
and of the camera itself; those of Andor, SBIG, MaxIm, ESO and the infrared cameras of Keck and Gemini among
them. CBLACK of MaxIm is none: it is the black of its screen."""
_COMBINED = (
    *("NCOMBINE", "STACKCNT", "SNAPSHOT", "NFRAMES", "NUMFRAME", "NSTACK", "NUMSTACK", "NAVG", "NAVERAGE"),
    *("COADDS", "COADD", "NCOADD", "NCOADDS", "NUMACC", "NDIT", "ESO DET NDIT"),
    *("BIAS_CNT", "DARK_CNT", "FLAT_CNT", "LIGH_CNT"),
)
"""How many frames were averaged or added, in the camera (COADDS, NDIT, NUMACC of Andor) or after."""
_COUNTED = ("NIMAGES", "NUMEXPOS", "NEXP")
"""The same of some programs; of others how many frames a series has, of which the file is one."""
_ALONG = (
    *(("XBINNING", "YBINNING"), ("CCDXBIN", "CCDYBIN"), ("HBIN", "VBIN"), ("XBIN", "YBIN"), ("BINX", "BINY")),
    *(("CAM-BINX", "CAM-BINY"), ("ESO DET WIN1 BINX", "ESO DET WIN1 BINY")),
)
_BOTH = re.compile(r"([1-9]\d?)(?:\s*[xX*,:\s]\s*([1-9]\d?))?")

Settings = tuple[tuple[str, str], ...]
"""Words of a header and what they say, in the order of `SETTINGS`."""


def settings_of(header: Mapping[str, Any]) -> Settings:
    """What a header says of the readout, numbers written in one way. A pedestal that is not stated is 0; a
    GAIN in words is a mode, and one that is a number is elsewhere."""
    found = {name: _said(header.get(name)) for name in SETTINGS}
    if number_in(header, ("GAIN",), float("-inf")) is None:
        found["GAIN"] = _said(header.get("GAIN"))
    found["PEDESTAL"] = found["PEDESTAL"] or "0"
    return tuple((name, said) for name, said in found.items() if said.lower() not in NOT_STATED)


def em_gain_of(header: Mapping[str, Any]) -> float | None:
    """By how much a header says that charge was multiplied; None where it does not, or another output was
    read."""
    if "conventional" in text_in(header, "OUTPTAMP").lower():
        return None
    return number_in(header, EM_GAIN, 0)


def unlike(here: Settings | None, there: Settings | None) -> list[tuple[str, str, str]]:
    """The words of which two records differ, with what either says."""
    first, other = dict(here or ()), dict(there or ())
    words = [word for word in dict.fromkeys((*first, *other)) if first.get(word) != other.get(word)]
    return [(word, first.get(word, "not stated"), other.get(word, "not stated")) for word in words]


def _said(value: Any) -> str:
    """A value as text that is equal where it means the same: 1, 1.0 and '1.00'; 'Low' and 'LOW '."""
    text = " ".join(str("" if value is None else value).split()).upper()
    try:
        number = float(text)
    except ValueError:
        return text
    return text if text.isdecimal() and len(text) > 9 else f"{number:.9g}"


def binning_of(header: Mapping[str, Any]) -> tuple[float, float] | None:
    """Columns and rows that were read as one; None where it is one of each, or nothing is stated."""
    for names in _ALONG:
        along = [number_in(header, (name,), 1) for name in names]
        # Of one alone: sensors are binned alike along both.
        across, down = along[0] or along[1] or 1.0, along[1] or along[0] or 1.0
        if (across, down) != (1, 1):
            return across, down
    for name in ("CCDSUM", "BINNING"):
        found = _BOTH.fullmatch(text_in(header, name))
        if found and (both := (float(found[1]), float(found[2] or found[1]))) != (1, 1):
            return both
    return None


def combined_of(header: Mapping[str, Any], planes: int) -> str | None:
    """That a frame is an average or a sum of several, by the word that says so; None where nothing does.
    planes: of the image, which a header may count without meaning an average of as many."""
    count = _counted(header, _COMBINED, planes)
    return None if count is None else f"{count[1]:g} frames by {count[0]}"


def doubted_count(header: Mapping[str, Any], planes: int) -> str | None:
    """The same where the word may also count the frames of a series."""
    count = _counted(header, _COUNTED, planes)
    if count is None or combined_of(header, planes):
        return None
    return f"{count[0]} {count[1]:g}: where a frame is the average or sum of as many, give the raw frames"


def _counted(header: Mapping[str, Any], names: tuple[str, ...], planes: int) -> tuple[str, float] | None:
    counts = ((name, number_in(header, (name,), 1.5)) for name in names)
    return next(((name, n) for name, n in counts if n is not None and n != planes), None)


def pedestal_doubt(header: Mapping[str, Any]) -> str | None:
    """That something was taken from the pixels already: by the convention of SBIG and MaxIm PEDESTAL is to be
    added for values that begin at zero, -100 of a frame that a dark was subtracted from, 0 of a raw one."""
    pedestal = number_in(header, ("PEDESTAL",), float("-inf"))
    if not pedestal:
        return None
    return (
        f"PEDESTAL {pedestal:g}: so programs mark frames that a dark was subtracted from: they have the "
        "noise of both, a read noise of up to 1.4 times the sensor's: give the frames as they were read out"
    )
