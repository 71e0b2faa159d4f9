"""FITS files of raw camera frames: one image, or a cube of frames, of unsigned 8 or 16 bit values.

16-bit unsigned values are stored as signed ones with BZERO = 32768 (FITS standard 4.0, Sec. 4.4.2.5). Values
that are floating point, signed, rescaled or marked as calibrated are no raw frames and are refused. Rows are
kept as stored, except where ROWORDER says that the file runs bottom up: BAYERPAT counts from the top row.
"""

from __future__ import annotations

import math
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyUserWarning

from cannoise_jax.recordings.lazy import LazyArray
from cannoise_jax.recordings.metadata import check_overrides, make_recording, reading
from cannoise_jax.recordings.packing import to_shifted_cfa
from cannoise_jax.recordings.recording import BadInput, Recording

SUFFIXES = (".fits", ".fit", ".fts", ".fz")
_ABSOLUTE_ZERO_C = -273.15
_COUNTS = ("", "adu", "dn", "count", "counts", "ct")
_KINDS = (("bias", "bias"), ("zero", "bias"), ("dark", "dark"), ("flat", "flat"))


def read_fits(path: str | Path, **overrides: Any) -> Recording:
    """A recording from the first image of a FITS file; frames stay on disk until they are indexed.

    Keywords used: BAYERPAT (XBAYROFF, YBAYROFF, ROWORDER), EXPTIME or EXPOSURE, ISO or else GAIN as the
    camera counts it, CCD-TEMP, INSTRUME, IMAGETYP, SATURATE. FITS knows no black level: it must be given.
    Text or an impossible number for ISO, exposure or temperature counts as not stated.
    overrides: see `metadata.OVERRIDES`. Raises BadInput.
    """
    check_overrides(overrides)
    if not Path(path).is_file():
        raise BadInput(f"{path}: no such file")
    with reading(path, "not a readable FITS file"), _opened(path) as file:
        number = next((n for n, hdu in enumerate(file) if hdu.is_image and hdu.shape), None)
        if number is None:
            raise BadInput(f"{path}: holds no image")
        hdu = file[number]
        header = hdu.header.copy()
        _check_raw(path, header)
        shape = hdu.shape if len(hdu.shape) == 3 else (1, *hdu.shape)
        if len(shape) != 3 or str(header.get("CTYPE3", "")).strip().upper() == "RGB":
            raise BadInput(f"{path}: image has shape {hdu.shape}: expected one mosaic or a cube of them")
        upside_down = str(header.get("ROWORDER", "")).strip().upper() == "BOTTOM-UP"
        known = _known(header)
    read = partial(_read, str(path), number, len(hdu.shape), upside_down)
    return make_recording(path, LazyArray(read, shape, np.dtype(np.uint16)), known, overrides)


def _opened(path: str | Path) -> fits.HDUList:
    with warnings.catch_warnings():
        warnings.simplefilter("error", AstropyUserWarning)
        return fits.open(path, memmap=False)


def _check_raw(path: str | Path, header: fits.Header) -> None:
    bits, zero, scale = header["BITPIX"], header.get("BZERO", 0), header.get("BSCALE", 1)
    steps = str(header.get("CALSTAT", "")).strip()
    unit = str(header.get("BUNIT", "")).strip()
    if bits < 0:
        raise BadInput(f"{path}: floating-point values (BITPIX {bits}): give the raw frames of the camera")
    if steps or unit.lower() not in _COUNTS:
        marked = f"CALSTAT {steps}" if steps else f"BUNIT {unit}"
        raise BadInput(f"{path}: calibrated values ({marked}): give the raw frames of the camera")
    if scale != 1 or (bits, zero) not in ((8, 0), (16, 32768)):
        raise BadInput(
            f"{path}: signed or rescaled values (BITPIX {bits}, BZERO {zero:g}, BSCALE {scale:g}): "
            "raw frames have unsigned 8 or 16 bits"
        )


def _read(path: str, number: int, axes: int, upside_down: bool, index: Any) -> np.ndarray:
    first, *rest = index if isinstance(index, tuple) else (index,)
    with reading(path, "cannot read the image"), _opened(path) as file:
        frames = file[number].section[first] if axes == 3 else file[number].section[:, :][None][first]
    frames = np.asarray(frames, np.uint16)
    return (frames[..., ::-1, :] if upside_down else frames)[(..., *_after_first(frames, rest))]


def _after_first(frames: np.ndarray, rest: list[Any]) -> tuple[Any, ...]:
    return (*rest, *[slice(None)] * (2 - len(rest)))


def _known(header: fits.Header) -> dict[str, Any]:
    pattern = str(header.get("BAYERPAT", header.get("COLORTYP", ""))).strip().upper()
    shift = int(header.get("YBAYROFF", 0)), int(header.get("XBAYROFF", 0))
    image_type = str(header.get("IMAGETYP", "")).lower()
    return {
        "cfa": to_shifted_cfa(pattern, *shift) if len(pattern) == 4 else None,
        "white_level": header.get("SATURATE"),
        "camera": str(header.get("INSTRUME", "")).strip() or None,
        "kind": next((kind for word, kind in _KINDS if word in image_type), "scene"),
        "iso": _number(header, ("ISO", "ISOSPEED", "GAIN"), 0),
        "exposure_s": _number(header, ("EXPTIME", "EXPOSURE"), 0),
        "temperature_c": _number(header, ("CCD-TEMP",), _ABSOLUTE_ZERO_C),
    }


def _number(header: fits.Header, names: tuple[str, ...], least: float) -> float | None:
    """The first of these keywords that holds a number from `least` up; programs also write 'n/a' or -1."""
    for name in names:
        try:
            value = float(header.get(name, math.nan))
        except (TypeError, ValueError):
            continue
        if least <= value < math.inf:
            return value
    return None
