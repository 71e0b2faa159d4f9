"""From what a file says about itself to a checked `Recording`: one set of rules for every format.

A reader hands over the frames and what it knows, under the field names of `Recording`; the caller's overrides
win over the file. What is required and missing, or cannot be true, is refused in one line.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cannoise_jax.recordings import plausible
from cannoise_jax.recordings.recording import (
    COLDEST_C,
    HOTTEST_C,
    KINDS,
    MOST_DB,
    REFERENCES,
    BadInput,
    Frames,
    Recording,
    printable,
)
from cannoise_jax.recordings.stated_values import (
    LONGEST,
    camera_of,
    channels_of,
    check_exposes,
    check_sites,
    code_step_of,
    count_of,
    exposure_of,
    number_of,
    one_of,
    optional_channels,
    optional_number,
    pattern_of,
)

OVERRIDES = (
    "camera",
    "kind",
    "cfa",
    "black_level",
    "white_level",
    "iso",
    "exposure_s",
    "temperature_c",
    "shot",
    "read",
    "code_step",
)
"""What a caller may set in place of the file: the keyword arguments of every reader."""

_NO_FIELDS = ("frames", "clean", "path", "sources")
FIELDS = tuple(f.name for f in dataclasses.fields(Recording) if f.name not in _NO_FIELDS)
"""What a file may state beside its pixels."""

_NUMBERS = tuple(f for f in FIELDS if f not in ("cfa", "camera", "kind", "reference"))
_FLAGS = {"cfa": "--cfa", "black_level": "--black-level", "white_level": "--white-level"}
_OWN_WORDS = (TypeError, AttributeError, IndexError, ArithmeticError)
"""What parsers raise where they did not expect such bytes: its words are about their code."""
_CHUNK_BYTES = 64 << 20
_HIGHEST = 2.0**20
"""DN, sixteen times what stored codes reach: a wrong level is a mistake that can be found, not a reason to
refuse the frames; beyond that it is damage."""
_BRIGHTEST = 2.0**20
"""Of a noise-free image, in white levels: what lies beyond is damage."""
_log = logging.getLogger(__name__)


def make_recording(
    path: str | Path,
    frames: Frames,
    known: Mapping[str, Any],
    overrides: Mapping[str, Any],
    *,
    scan: bool = True,
) -> Recording:
    """A checked recording from a file's frames and metadata.

    known: fields of `Recording` that the file states (None: not stated). overrides: fields that the caller
    states (None: keep the file's), see `OVERRIDES`. The camera is named after the folder unless it is
    stated.
    Values above the white level are saturation: counted, and logged as one warning; so are a `clean` and a
    `code_step` that do not fit the frames (see `plausible`). scan: False leaves out what takes reading
    pixels, for views that check what they read.
    Raises BadInput for everything that cannot be used, TypeError for an override that does not exist.
    """
    check_overrides(overrides)
    stated = {**known, **{k: v for k, v in overrides.items() if v is not None}}
    stated = {k: v for k, v in stated.items() if v is not None}
    _check_frames(path, frames)
    _check_stated(path, stated)
    check_sites(path, known.get("cfa"))
    check_exposes(path, stated.get("kind"), overrides.get("exposure_s"))
    cfa = pattern_of(path, stated["cfa"])
    if cfa != "MONO" and (frames.shape[1] % 2 or frames.shape[2] % 2):
        raise BadInput(
            f"{path}: {frames.shape[1]} x {frames.shape[2]} pixels is an odd size for a {cfa} mosaic: "
            "crop one row or column"
        )
    black = channels_of(path, "black_level", stated["black_level"])
    white = number_of(path, "white_level", stated["white_level"])
    if min(black) < 0 and overrides.get("black_level") is not None:
        raise BadInput(f"{path}: black level {min(black):g} DN: stored codes start at 0: state one from 0 on")
    if white > _HIGHEST or min(black) < -_HIGHEST:
        raise BadInput(
            f"{path}: black level {min(black):g}, white level {white:g}: far beyond codes of 16 bits: "
            "set them with --black-level and --white-level"
        )
    if max(black) >= white:
        raise BadInput(
            f"{path}: black level {max(black):g} is not below white level {white:g}: "
            "set them with --black-level and --white-level"
        )
    recording = Recording(
        frames=frames,
        cfa=cfa,
        black_level=black,
        white_level=white,
        camera=camera_of(path, stated.get("camera"))
        or folder_name(Path(path).absolute().parent)
        or Recording.camera,
        kind=one_of(path, stated, "kind", KINDS) or "scene",
        clean=_checked_clean(path, frames, stated.get("clean"), scan),
        iso=optional_number(path, stated, "iso", least=0),
        gain_db=optional_number(path, stated, "gain_db", least=-MOST_DB, most=MOST_DB),
        egain=optional_number(path, stated, "egain", least=1e-6),
        em_gain=optional_number(path, stated, "em_gain", least=0),
        full_code=optional_number(path, stated, "full_code", least=0),
        exposure_s=exposure_of(path, stated),
        temperature_c=optional_number(path, stated, "temperature_c", least=COLDEST_C, most=HOTTEST_C),
        shot=optional_channels(path, stated, "shot", least=0),
        read=optional_channels(path, stated, "read"),
        code_step=code_step_of(path, stated),
        reference=one_of(path, stated, "reference", REFERENCES),
        reference_frames=count_of(path, stated, "reference_frames"),
        path=str(path),
    )
    if scan:
        warn_saturation(path, count_above(recording.frames, white), recording.frames.shape, white)
        plausible.check_units_of_clean(recording)
        plausible.warn_of_code_step(recording)
        plausible.warn_of_lights(recording)
    return recording


def folder_name(folder: Path) -> str:
    """The name of a folder as one of a camera: what no line can show of it is a question mark."""
    return printable(folder.absolute().name)[:LONGEST]


def checked(recording: Recording) -> Recording:
    """A recording that was put together in Python, held to the rules for files; pixels are not read.

    One black level, and one `shot` or `read`, become four, and a colour order in small letters a plain one.
    Raises BadInput.
    """
    known = {name: getattr(recording, name) for name in (*FIELDS, "clean")}
    check_fields(recording)
    sound = make_recording(recording.path or recording.camera, recording.frames, known, {}, scan=False)
    plain = {name: getattr(sound, name) for name in ("cfa", "black_level", "shot", "read")}
    same = all(getattr(recording, name) == value for name, value in plain.items())
    return recording if same else dataclasses.replace(recording, **plain)


def check_fields(recording: Recording) -> None:
    """Raises BadInput where a recording that was put together in Python has no arrays, or frames of another
    shape, texts for numbers, or no kind."""
    place = recording.path or recording.camera
    for name in ("frames", "clean"):
        value = getattr(recording, name)
        if not (value is None and name == "clean" or hasattr(value, "shape") and hasattr(value, "dtype")):
            raise BadInput(f"{place}: {name} is a {type(value).__name__}: give an array")
    _check_shape(place, recording.frames)
    for name in _NUMBERS:
        value = getattr(recording, name)
        if any(isinstance(v, str | bytes) for v in (value if isinstance(value, tuple | list) else (value,))):
            raise BadInput(f"{place}: {name} is {value!r}, a text: give a number")
    if recording.kind is None:
        raise BadInput(f"{place}: kind is missing: use one of {', '.join(KINDS)}")


def check_overrides(overrides: Mapping[str, Any]) -> None:
    """Raises TypeError for a name that is not among `OVERRIDES`."""
    unknown = sorted(set(overrides) - set(OVERRIDES))
    if unknown:
        raise TypeError(f"unknown override {', '.join(unknown)}: use {', '.join(OVERRIDES)}")


def chunks(frames: Frames, most_bytes: int = _CHUNK_BYTES) -> Iterator[np.ndarray]:
    """The frames in order, as many at a time as fit `most_bytes` (at least one)."""
    item = max(1, int(np.prod(frames.shape[1:])) * frames.dtype.itemsize)
    step = max(1, most_bytes // item)
    for start in range(0, frames.shape[0], step):
        yield np.asarray(frames[start : start + step])


def count_above(frames: Frames, white: float) -> int:
    """How many stored values exceed the white level; reads nothing where the dtype cannot exceed it."""
    if white >= np.iinfo(frames.dtype).max:
        return 0
    return sum(int(np.count_nonzero(part > white)) for part in chunks(frames))


def warn_saturation(path: str | Path, above: int, shape: tuple[int, ...], white: float) -> None:
    """Logs one warning when values lie above the white level."""
    if above:
        share = 100 * above / math.prod(shape)
        _log.warning("%s: %d values (%.3g %%) above white level %g: saturated", path, above, share, white)


@contextlib.contextmanager
def quiet(library: str) -> Iterator[None]:
    """Silences a library that logs what its caller reports in its own words."""
    log = logging.getLogger(library)
    level = log.level
    log.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        log.setLevel(level)


@contextlib.contextmanager
def reading(path: str | Path, failure: str) -> Iterator[None]:
    """Turns whatever a parser raises over broken bytes into BadInput in one line: path, failure, reason."""
    try:
        yield
    except BadInput:
        raise
    except UnicodeDecodeError as error:
        raise BadInput(f"{path}: {failure}: no text in UTF-8: save it as that") from error
    except Exception as error:
        if isinstance(error, MemoryError):
            raise BadInput(
                f"{path}: not enough memory to read it: give fewer frames, or smaller ones"
            ) from error
        if isinstance(error, _OWN_WORDS) or "invalid literal" in str(error):
            raise BadInput(f"{path}: {failure}: damaged: copy it again, or save it anew") from error
        texts = [a.decode("utf-8", "replace") if isinstance(a, bytes) else a for a in error.args]
        reason = " ".join(" ".join(t for t in texts if isinstance(t, str)).split()) or type(error).__name__
        reason = reason if len(reason) <= LONGEST else f"{reason[:LONGEST]}..."
        of_system = isinstance(error, OSError) and error.errno
        remedy = "make it readable" if of_system else "copy it again, or save it anew"
        remedy = "it was moved or removed meanwhile" if isinstance(error, FileNotFoundError) else remedy
        raise BadInput(f"{path}: {failure}: {reason}: {remedy}") from error


def _check_shape(path: str | Path, frames: Frames) -> None:
    if len(frames.shape) != 3:
        raise BadInput(f"{path}: frames have shape {tuple(frames.shape)}: expected [frames, rows, columns]")


def _check_frames(path: str | Path, frames: Frames) -> None:
    _check_shape(path, frames)
    if frames.dtype != np.uint16:
        raise BadInput(f"{path}: frames are {frames.dtype}: expected the sensor's own values as uint16")
    if frames.shape[0] == 0:
        raise BadInput(f"{path}: holds no frames: record at least one")
    if 0 in frames.shape:
        raise BadInput(f"{path}: frames of {frames.shape[1]} x {frames.shape[2]} pixels are empty")


def _checked_clean(path: str | Path, frames: Frames, clean: Any, scan: bool) -> Any:
    if clean is None:
        return None
    shape = tuple(clean.shape)
    if shape not in (tuple(frames.shape), tuple(frames.shape[1:])):
        raise BadInput(
            f"{path}: clean has shape {shape}: expected one image a frame, or one for all {frames.shape}"
        )
    if clean.dtype.kind not in "fiu":
        raise BadInput(f"{path}: clean is {clean.dtype}: expected float32, (DN - black) / (white - black)")
    bad = sum(int(np.count_nonzero(~(np.abs(part) < _BRIGHTEST))) for part in chunks(clean)) if scan else 0
    if bad:
        values = "1 value that is" if bad == 1 else f"{bad} values that are"
        raise BadInput(
            f"{path}: clean holds {values} NaN, infinite or beyond {_BRIGHTEST:g} times the "
            "white level: mend or leave out the reference"
        )
    return clean


def _check_stated(path: str | Path, stated: Mapping[str, Any]) -> None:
    """Raises BadInput that names all that neither the file nor the caller states, of what is required."""
    missing = [name for name in _FLAGS if name not in stated]
    if missing:
        many = len(missing) > 1
        flags = f"{_and([_FLAGS[name] for name in missing])} ({_and([f'{n}=' for n in missing])} in Python)"
        raise BadInput(
            f"{path}: {_and(missing)} {'are' if many else 'is'} missing: set {'them' if many else 'it'} with "
            f"{flags}"
        )


def _and(words: Sequence[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
