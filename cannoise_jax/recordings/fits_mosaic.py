"""Several amplifiers of one sensor, each an image of its own in a FITS file, put where DETSEC has them."""

from __future__ import annotations

import warnings
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyWarning

from cannoise_jax.recordings.fits_cards import plain_cards
from cannoise_jax.recordings.fits_header import about_of, known_of, section
from cannoise_jax.recordings.fits_words import reading_fits
from cannoise_jax.recordings.lazy import LazyArray, read_stack
from cannoise_jax.recordings.opened import MOST_PIXELS, Opened, whole_numbers
from cannoise_jax.recordings.recording import BadInput, per_channel


class _Part(NamedTuple):
    number: int
    data: tuple[slice, slice]
    place: tuple[slice, slice]
    flips: tuple[bool, bool]


def assembled(path: str | Path, file: fits.HDUList, numbers: list[int]) -> Opened:
    """One frame of all images, each at its DETSEC without its overscan, whose median is the black level.

    Raises BadInput where an image states no DETSEC, or where they overlap or leave gaps.
    """
    names = [str(file[n].header.get("EXTNAME", n)).strip() for n in numbers]
    silent = [
        name for n, name in zip(numbers, names, strict=True) if section(file[n].header.get("DETSEC")) is None
    ]
    if silent:
        raise BadInput(
            f"{path}: holds {len(numbers)} images ({', '.join(names)}) and no DETSEC that says where they "
            "lie on the sensor: give one image a file"
        )
    parts = [_part(path, n, file[n]) for n in numbers]
    top, left = (min(p.place[axis].start for p in parts) for axis in (0, 1))
    height, width = (max(p.place[axis].stop for p in parts) - start for axis, start in ((0, top), (1, left)))
    if height * width > MOST_PIXELS or sum(_area(p.place) for p in parts) != height * width:
        raise BadInput(
            f"{path}: the DETSEC of its {len(parts)} images overlap or leave gaps: give one image a file"
        )
    parts = [p._replace(place=(_moved(p.place[0], top), _moved(p.place[1], left))) for p in parts]
    whole = _frame(file, parts, (height, width))
    whole_numbers(path, whole)
    cards = plain_cards(file[0].header) | plain_cards(file[numbers[0]].header)
    header = fits.Header([card for name, card in cards.items() if name not in _SKIPPED])
    known, about = known_of(header), about_of(header)
    about["doubt"] = (
        "; ".join(filter(None, (about["doubt"], _unlike([file[n].header for n in numbers])))) or None
    )
    overscans = [o for n in numbers if (o := _overscan(file[n])) is not None]
    if len(overscans) == len(numbers):
        known["black_level"] = per_channel(float(np.median(overscans)))
        about["black_from"] = (
            f"overscan of {len(numbers)} amplifiers, {min(overscans):g} to {max(overscans):g} DN"
        )
    shape = (1, height, width)
    read = partial(read_stack, partial(read_assembled, str(path), tuple(parts), (height, width)), shape)
    return Opened(LazyArray(read, shape, np.dtype(np.uint16)), known, about)


def _unlike(headers: list[fits.Header]) -> str | None:
    """That amplifiers state gains that are far apart: one gain is measured of all of them."""
    known = [known_of(h)["egain"] for h in headers]
    stated: list[float] = [e for e in known if e is not None]
    if not stated or max(stated) < _APART * min(stated):
        return None
    gains = ", ".join(f"{e:g}" for e in stated)
    return (
        f"its amplifiers state gains of {gains} e-/DN: what is measured of all together is a mean of theirs"
    )


_APART = 1.1
"""Times a gain another one is, from which on their mean is none of either: those of one sensor differ by some
per cent."""
_SKIPPED = ("BIASSEC", "TRIMSEC", "DATASEC", "DETSEC")


def read_assembled(path: str, parts: tuple[_Part, ...], size: tuple[int, int], number: int) -> np.ndarray:
    """The one frame of a file of amplifiers."""
    with reading_fits(path, "cannot read the images"), warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropyWarning)
        with fits.open(path, memmap=False) as file:
            return _frame(file, list(parts), size).astype(np.uint16)


def _part(path: str | Path, number: int, hdu: Any) -> _Part:
    if len(hdu.shape) != 2:
        raise BadInput(f"{path}: image {number} has shape {hdu.shape}: expected one amplifier's mosaic")
    place = section(hdu.header["DETSEC"])
    data = section(hdu.header.get("DATASEC") or hdu.header.get("TRIMSEC"))
    assert place is not None
    kept = (data[0], data[1]) if data else (slice(0, hdu.shape[0]), slice(0, hdu.shape[1]))
    size = [s.stop - s.start for s in kept]
    if (
        size != [s.stop - s.start for s in place[:2]]
        or kept[0].stop > hdu.shape[0]
        or kept[1].stop > hdu.shape[1]
    ):
        raise BadInput(
            f"{path}: image {number}: DATASEC has {size[0]} x {size[1]} pixels, DETSEC "
            f"{hdu.header['DETSEC']} others: binned or damaged: give one image a file"
        )
    flips = (place[2] != bool(data and data[2]), place[3] != bool(data and data[3]))
    return _Part(number, kept, place[:2], flips)


def _frame(file: fits.HDUList, parts: list[_Part], size: tuple[int, int]) -> np.ndarray:
    images = [np.asarray(file[p.number].data)[p.data] for p in parts]
    out = np.zeros(size, np.result_type(*images))
    for part, image in zip(parts, images, strict=True):
        out[part.place] = image[:: -1 if part.flips[0] else 1, :: -1 if part.flips[1] else 1]
    return out


def _overscan(hdu: Any) -> float | None:
    bias = section(hdu.header.get("BIASSEC"))
    if bias is None:
        return None
    pixels = np.asarray(hdu.data)[bias[0], bias[1]]
    return float(np.median(pixels)) if pixels.size else None


def _area(place: tuple[slice, slice]) -> int:
    return (place[0].stop - place[0].start) * (place[1].stop - place[1].start)


def _moved(part: slice, by: int) -> slice:
    return slice(part.start - by, part.stop - by)
