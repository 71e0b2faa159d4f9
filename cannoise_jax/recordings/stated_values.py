"""What a file or a caller states beside the pixels: each value checked, or refused in one line."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cannoise_jax.recordings.recording import (
    CFA_PATTERNS,
    LEAST,
    LIT,
    LONGEST_S,
    MOST,
    SHORTEST_S,
    BadInput,
    PerChannel,
    Recording,
    per_channel,
)

LONGEST, _MOST_COUNTED = 200, 10**9
"""Characters of a camera's name; frames that one may say were averaged."""
_X_TRANS_ROWS = {
    row[k:] + row[:k] for row in ("GGRGGB", "GGBGGR", "RBGBRG", "BRGRBG") for k in range(len(row))
}
"""What a row of an X-Trans mosaic shows, from any site on: its name in headers of a single row."""
MOST_NLF = 1.0
"""Of shot and read, normalised: at full scale their noise spans the whole range."""


def text_of(path: str | Path, name: str, value: Any) -> str:
    """A stated name or word. Raises BadInput for lists, tables, and text that no line can show."""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    if value is None:
        return ""
    text = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
    if (isinstance(text, int) and not isinstance(text, bool)) or (
        isinstance(text, float) and math.isfinite(text)
    ):
        text = str(text)
    if not (isinstance(text, str) and text.isprintable() and len(text) <= LONGEST):
        raise BadInput(f"{path}: {name} {_quoted(value)}: expected text of at most {LONGEST} characters")
    return text


def _quoted(value: Any) -> str:
    """The value for a message, in one line and not at length."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


def camera_of(path: str | Path, value: Any) -> str:
    """The stated name; nothing for what a `Recording` says where nobody named it."""
    name = "" if value is None else text_of(path, "camera", value)
    return "" if name == Recording.camera else name


def pattern_of(path: str | Path, value: Any) -> str:
    """The mosaic pattern that a file states. Raises BadInput for any other."""
    check_sites(path, value)
    cfa = text_of(path, "cfa", value).strip().upper()
    if cfa not in CFA_PATTERNS:
        known = ", ".join(CFA_PATTERNS)
        raise BadInput(f"{path}: unknown CFA {_quoted(cfa)}: use --cfa with one of {known}")
    return cfa


def check_sites(path: str | Path, value: Any) -> None:
    """Raises BadInput for what a file states of its colours where no order of 2x2 sites can be right,
    whatever the caller says."""
    text = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
    cfa = text.strip().upper() if isinstance(text, str) else ""
    if "TRANS" in cfa or len(cfa) == 36 or cfa in _X_TRANS_ROWS:
        raise BadInput(f"{path}: an X-Trans mosaic (6x6 sites): only mosaics of 2x2 and monochrome are read")


def one_of(path: str | Path, stated: Mapping[str, Any], name: str, allowed: tuple[str, ...]) -> Any:
    """A stated text that has to be one of those allowed; None where none is stated."""
    if name not in stated:
        return None
    text = text_of(path, name, stated[name])
    if text not in allowed:
        raise BadInput(f"{path}: unknown {name} {_quoted(text)}: use one of {', '.join(allowed)}")
    return text


def channels_of(path: str | Path, name: str, value: Any) -> PerChannel:
    """One or four finite numbers, of the mosaic's sites. Raises BadInput for anything else."""
    try:
        values = per_channel(_no_truths(value))
    except (TypeError, ValueError, OverflowError) as error:
        raise BadInput(f"{path}: {name} {_quoted(value)}: expected 1 or 4 numbers in mosaic order") from error
    if not all(map(math.isfinite, values)):
        raise BadInput(f"{path}: {name} is not finite: {', '.join(f'{v:g}' for v in values)}")
    for value in values:
        _check_not_tiny(path, name, value)
    return values


def optional_channels(
    path: str | Path, stated: Mapping[str, Any], name: str, least: float = -math.inf
) -> PerChannel | None:
    """The same, from `least` on and of noise within the range; None where none are stated."""
    if name not in stated:
        return None
    values = channels_of(path, name, stated[name])
    said = ", ".join(f"{v:g}" for v in values)
    if min(values) < least:
        raise BadInput(f"{path}: {name} is {said}: expected at least {least:g}")
    if max(map(abs, values)) > MOST_NLF:
        raise BadInput(
            f"{path}: {name} is {said}: noise wider than the whole range: write it normalised, as divided by "
            "(white - black), or leave it out"
        )
    return values


def _no_truths(value: Any) -> np.ndarray:
    """The value as an array. Raises TypeError for truths, which count as 0 and 1 elsewhere."""
    array = np.asarray(value)
    if array.dtype.kind == "b":
        raise TypeError("a truth, no number")
    return array


def number_of(path: str | Path, name: str, value: Any) -> float:
    """A finite number. Raises BadInput for anything else; arrays of one are numbers, as HDF5 has them."""
    try:
        if isinstance(value, (list, tuple)):
            raise TypeError("a list, no number")
        number = float(_no_truths(value).reshape(()))
    except (TypeError, ValueError, OverflowError) as error:
        raise BadInput(f"{path}: {name} {_quoted(value)}: expected one number") from error
    if not math.isfinite(number):
        raise BadInput(f"{path}: {name} is not finite: {number}")
    _check_not_tiny(path, name, number)
    return number


def _check_not_tiny(path: str | Path, name: str, number: float) -> None:
    if 0 < abs(number) < LEAST:
        raise BadInput(f"{path}: {name} is {number:g}: too small to be meant: write 0")


def optional_number(
    path: str | Path, stated: Mapping[str, Any], name: str, least: float = -math.inf, most: float = MOST
) -> float | None:
    """The same from `least` to `most`; None where none is stated."""
    if name not in stated:
        return None
    number = number_of(path, name, stated[name])
    if number < least:
        raise BadInput(f"{path}: {name} is {number:g}: expected at least {least:g}")
    if number > most:
        raise BadInput(f"{path}: {name} is {number:g}: expected at most {most:g}")
    return number


def exposure_of(path: str | Path, stated: Mapping[str, Any]) -> float | None:
    """Seconds, 0 (of biases) or what a camera can expose for; None where none is stated."""
    seconds = optional_number(path, stated, "exposure_s", least=0, most=LONGEST_S)
    if seconds is not None and 0 < seconds < SHORTEST_S:
        raise BadInput(f"{path}: exposure_s is {seconds:g}: expected at least {SHORTEST_S:g}, or 0 of a bias")
    return seconds


def check_exposes(path: str | Path, kind: Any, seconds: Any) -> None:
    """Raises BadInput where a caller states that light fell on a sensor for no time."""
    if isinstance(kind, str) and kind in LIT and seconds == 0:  # files state anything
        raise BadInput(f"{path}: --exposure 0 of a {kind}: light needs time: state it, or --kind bias")


def code_step_of(path: str | Path, stated: Mapping[str, Any]) -> float | None:
    """Spacing of the codes, DN; 0: they are on no lattice, None: not stated."""
    step = optional_number(path, stated, "code_step", least=0, most=65536)
    if step is not None and 0 < step < 1:
        raise BadInput(
            f"{path}: code_step is {step:g}: stored codes are whole numbers, so 1 or more; 0: none"
        )
    return step


def count_of(path: str | Path, stated: Mapping[str, Any], name: str) -> int | None:
    """A whole number from 1; None where none is stated."""
    number = optional_number(path, stated, name, least=1)
    if number is not None and number > _MOST_COUNTED:
        raise BadInput(f"{path}: {name} is {number:g}: expected at most {_MOST_COUNTED}")
    return None if number is None else round(number)
