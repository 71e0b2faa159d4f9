"""FITS files of raw camera frames: one image, a cube of frames, or the amplifiers of one sensor.

16-bit unsigned values are stored as signed ones with BZERO = 32768 (FITS standard 4.0, Sec. 4.4.2.5). Other
types are taken where every value is a whole number that 16 bits hold; values that are fractional, negative,
rescaled or marked as calibrated are no raw frames and are refused. Rows are kept as stored, except where
ROWORDER says that the file runs bottom up: BAYERPAT counts from the top row. Of a frame with overscan
(BIASSEC) the data section is kept, and the black level is the median of the overscan.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
import warnings
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyUserWarning, AstropyWarning

from cannoise_jax.recordings.fits_cards import plain_cards
from cannoise_jax.recordings.fits_chain import MOST_UNITS, check_headers
from cannoise_jax.recordings.fits_header import about_of, known_of, section
from cannoise_jax.recordings.fits_mosaic import assembled
from cannoise_jax.recordings.fits_words import reading_fits
from cannoise_jax.recordings.lazy import LazyArray
from cannoise_jax.recordings.metadata import check_overrides, make_recording
from cannoise_jax.recordings.opened import Opened, check_claim, check_pixels, stated, whole_numbers
from cannoise_jax.recordings.packing import to_shifted_cfa
from cannoise_jax.recordings.recording import BadInput, PerChannel, Recording, per_channel

SUFFIXES = (".fits", ".fit", ".fts", ".fz", ".fits.gz", ".fit.gz", ".fts.gz")
_COUNTS = ("", "adu", "adus", "dn", "count", "counts", "ct")
_log = logging.getLogger(__name__)
_PLANES = 0.1
"""Three planes whose medians differ by more than this share are colours, not frames."""


def read_fits(path: str | Path, **overrides: Any) -> Recording:
    """A recording from the image of a FITS file; frames stay on disk until they are indexed.

    Keywords: see `fits_header`. FITS knows no black level: it is that of the overscan, or must be given.
    Text or an impossible number for ISO, exposure or temperature counts as not stated.
    overrides: see `metadata.OVERRIDES`. Raises BadInput.
    """
    check_overrides(overrides)
    opened = open_fits(path)
    known, words = stated(opened.known), opened.about.get("image_type")
    if opened.about.get("combined"):
        raise BadInput(
            f"{path}: an average or sum of frames, no raw frame ({opened.about['combined']}): give the raw "
            "frames"
        )
    if words and "kind" not in known and overrides.get("kind") is None:
        _log.warning("%s: IMAGETYP %r is unknown: taken for a scene (bin/convert --kind)", path, words)
    if opened.about.get("doubt"):
        _log.warning("%s: %s", path, opened.about["doubt"])
    return make_recording(path, opened.frames, {"kind": "scene", **known}, overrides)


def open_fits(path: str | Path) -> Opened:
    """The frames and keywords of a FITS file. Raises BadInput."""
    if not Path(path).is_file():
        raise BadInput(f"{path}: no such file")
    with reading_fits(path):
        check_headers(path)
    with reading_fits(path), _opened(path) as file:
        units = list(itertools.islice(file, MOST_UNITS + 1))
        if len(units) > MOST_UNITS:  # what `check_headers` let pass must not be followed for ever either
            raise BadInput(f"{path}: not a readable FITS file: its parts lead back to one another: damaged")
        numbers = [n for n, hdu in enumerate(units) if hdu.is_image and hdu.shape]
        if not numbers:
            raise BadInput(f"{path}: holds no image")
        for n in numbers:
            check_claim(path, file[n].shape, abs(int(file[n].header["BITPIX"])) // 8)
            _check_raw(path, file[n].header)
        if len(numbers) > 1:
            return assembled(path, file, numbers)
        number = numbers[0]
        hdu = file[number]
        header = hdu.header.copy()
        if number:  # the camera is often named in the primary header alone
            header = fits.Header(list({**plain_cards(file[0].header), **plain_cards(header)}.values()))
        shape = hdu.shape if len(hdu.shape) == 3 else (1, *hdu.shape)
        if len(shape) != 3:
            raise BadInput(f"{path}: image has shape {hdu.shape}: expected one mosaic or a cube of them")
        three = _check_colours(path, hdu, header)
        native = (header["BITPIX"], header.get("BZERO", 0)) in ((8, 0), (16, 32768))
        if not native:
            whole_numbers(path, np.asarray(hdu.data))
    with reading_fits(path, "not a readable FITS header"):  # cards are parsed when they are looked at
        upside_down = str(header.get("ROWORDER", "")).strip().upper() == "BOTTOM-UP"
        known, about = known_of(header), about_of(header, shape[0])
        about["doubt"] = "; ".join(filter(None, (about["doubt"], _outside(header, shape), three))) or None
        kept, black = _sections(path, number, header, shape)
    if known["cfa"] is not None:
        rows = shape[1] - kept[0].stop if upside_down else kept[0].start
        known["cfa"] = to_shifted_cfa(known["cfa"], rows, kept[1].start)
    shape = (shape[0], kept[0].stop - kept[0].start, kept[1].stop - kept[1].start)
    if black is not None:
        known["black_level"], about["black_from"] = black, "overscan"
    if header["BITPIX"] == 8:
        about["bits"] = 8
    read = partial(_read, str(path), number, len(hdu.shape), upside_down, kept)
    return Opened(LazyArray(read, shape, np.dtype(np.uint16)), known, about)


@contextlib.contextmanager
def _opened(path: str | Path) -> Iterator[fits.HDUList]:
    with warnings.catch_warnings():
        warnings.simplefilter("error", AstropyUserWarning)
        warnings.simplefilter("ignore", fits.verify.VerifyWarning)
        # `check_headers` has seen that all pixels are there: only the padding behind them may be missing.
        warnings.filterwarnings("ignore", message="File may have been truncated", category=AstropyUserWarning)
        # Names with accents are against the standard, and harmless.
        warnings.filterwarnings("ignore", message=".*non-ASCII characters", category=AstropyUserWarning)
        with fits.open(path, memmap=False) as file:
            yield file


def _check_raw(path: str | Path, header: fits.Header) -> None:
    scale, zero = (header.get(name, value) for name, value in (("BSCALE", 1), ("BZERO", 0)))
    for name, value in (("BSCALE", scale), ("BZERO", zero)):
        if not isinstance(value, (int, float)) or not math.isfinite(value):
            raise BadInput(
                f"{path}: {name} of its header is {value!r}, no number: mend it, or give the raw frames"
            )
    steps = str(header.get("CALSTAT", "")).strip()
    unit = str(header.get("BUNIT", "")).strip()
    if steps or unit.lower() not in _COUNTS:
        marked = f"CALSTAT {steps}" if steps else f"BUNIT {unit}"
        raise BadInput(f"{path}: calibrated values ({marked}): give the raw frames of the camera")
    if scale != 1:
        raise BadInput(f"{path}: rescaled values (BSCALE {scale:g}, BZERO {zero:g}): give the raw frames")
    if zero and int(header["BITPIX"]) < 0:
        raise BadInput(
            f"{path}: floating-point values with BZERO {zero:g}, which belongs to integers: whether it is in "
            "the values already nobody can tell: give the raw frames, or take BZERO out of the header"
        )


def _check_colours(path: str | Path, hdu: Any, header: fits.Header) -> str | None:
    """Raises BadInput for three planes, or three values a pixel, that are the colours of one picture; a doubt
    where only the header could tell three planes from three frames, and does not."""
    check_pixels(path, tuple(hdu.shape))
    if len(hdu.shape) != 3 or hdu.shape[0] != 3:
        return None
    words = [str(header.get(name, "")).upper() for name in ("CTYPE3", "COLORSPC", "COLORTYP", "CSPACE")]
    planes = [np.asarray(hdu.section[n]) for n in range(3)]
    levels = [float(np.median(plane)) for plane in planes]
    if np.ptp(planes[0]) and all(np.array_equal(planes[0], plane) for plane in planes[1:]):
        raise BadInput(
            f"{path}: image has shape {hdu.shape}: three planes of the same pixels are a grey picture saved "
            "in colours: give the raw mosaics"
        )
    apart = max(levels) - min(levels) > _PLANES * max(max(levels), 1.0)
    if any("RGB" in w or "COLOR" in w for w in words) or (apart and "BAYERPAT" not in header):
        raise BadInput(
            f"{path}: image has shape {hdu.shape}: three planes of medians "
            f"{', '.join(f'{v:g}' for v in levels)} are the colours of a developed picture: "
            "give the raw mosaics, or three frames as three files"
        )
    said = words[0].strip() or "BAYERPAT" in header
    return None if said else "three planes are read as three frames: of a colour picture they would be none"


def _sections(
    path: str | Path, number: int, header: fits.Header, shape: tuple[int, ...]
) -> tuple[tuple[slice, slice], PerChannel | None]:
    """Rows and columns to keep, and the black level of the overscan where BIASSEC names one."""
    whole = slice(0, shape[1]), slice(0, shape[2])
    bias, data = section(header.get("BIASSEC")), section(header.get("TRIMSEC") or header.get("DATASEC"))
    if bias is None or not _within(bias, shape):
        return (whole if data is None or not _within(data, shape) else (data[0], data[1])), None
    if data is None or not _within(data, shape):
        raise BadInput(
            f"{path}: has overscan (BIASSEC {header['BIASSEC']}) and no TRIMSEC or DATASEC that names the "
            "picture: crop the overscan, or add TRIMSEC to the header"
        )
    with reading_fits(path, "cannot read the overscan"), _opened(path) as file:
        image = np.asarray(file[number].section[0] if len(file[number].shape) == 3 else file[number].data)
        pixels = image[bias[0], bias[1]]
    if not pixels.size or (data[0].stop - data[0].start) < 1:
        return whole, None
    return (data[0], data[1]), per_channel(float(np.median(pixels)))


def _outside(header: fits.Header, shape: tuple[int, ...]) -> str | None:
    """What a header says of overscan and picture that this frame does not have, as after binning."""
    stated = {name: header[name] for name in ("BIASSEC", "TRIMSEC", "DATASEC") if header.get(name)}
    parts = {name: section(text) for name, text in stated.items()}
    wrong = [f"{n} {stated[n]}" for n, part in parts.items() if part is None or not _within(part, shape)]
    return f"{', '.join(wrong)}: no part of {shape[1]} x {shape[2]} pixels: not used" if wrong else None


def _within(part: tuple[slice, slice, bool, bool], shape: tuple[int, ...]) -> bool:
    return part[0].stop <= shape[-2] and part[1].stop <= shape[-1]


def _read(
    path: str, number: int, axes: int, upside_down: bool, kept: tuple[slice, slice], index: Any
) -> np.ndarray:
    first, *rest = index if isinstance(index, tuple) else (index,)
    with reading_fits(path, "cannot read the image"), _opened(path) as file, warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropyWarning)
        frames = file[number].section[first] if axes == 3 else file[number].section[:, :][None][first]
    frames = np.asarray(frames)
    frames = frames if frames.dtype == np.uint16 else frames.astype(np.uint16)
    frames = frames[..., kept[0], kept[1]]
    return (frames[..., ::-1, :] if upside_down else frames)[(..., *_after_first(frames, rest))]


def _after_first(frames: np.ndarray, rest: list[Any]) -> tuple[Any, ...]:
    return (*rest, *[slice(None)] * (2 - len(rest)))
