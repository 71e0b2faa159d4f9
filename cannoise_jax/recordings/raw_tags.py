"""What the tags of camera raw files state: directories of a TIFF, the noise profile of a DNG, Exif."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import exifread
import numpy as np
import tifffile

from cannoise_jax.recordings.metadata import quiet
from cannoise_jax.recordings.recording import COLDEST_C, HOTTEST_C, BadInput, PerChannel, per_channel
from cannoise_jax.recordings.stated_values import MOST_NLF
from cannoise_jax.recordings.tiff_chain import check_chain

CFA_PATTERN = 33422
_NOISE_PROFILE, CFA_PLANE_COLOUR, ACTIVE_AREA, MASKED_AREAS = 51041, 50710, 50829, 50830
BLACK_REPEAT, BLACK, BLACK_DELTAS = 50713, 50714, (50715, 50716)
_UNIQUE_CAMERA, EXPOSURE, ISO = 50708, 33434, (34855, 34867)
_MOST_DIRECTORIES = 1000
_CFA_IMAGE = 32803  # PhotometricInterpretation of a mosaic
_log = logging.getLogger(__name__)


class Directory(NamedTuple):
    """One image directory of a file: its tags by number, and whether it holds the mosaic."""

    tags: dict[int, Any]
    is_mosaic: bool
    end: int  # offset behind its last strip


def directories_of(path: str | Path) -> list[Directory]:
    """The image directories of a TIFF-like file, the mosaic's own first; none for other files."""

    def below(pages: Any) -> Iterator[Any]:
        for page in pages:
            yield page
            yield from below(page.pages or ())

    if not Path(path).is_file():
        raise BadInput(f"{path}: no such file")
    check_chain(path)
    try:
        with quiet("tifffile"), tifffile.TiffFile(path) as file:
            found = [
                Directory(
                    {tag.code: tag.value for tag in page.tags},
                    page.photometric == _CFA_IMAGE,
                    max(map(sum, zip(page.dataoffsets, page.databytecounts, strict=False)), default=0),
                )
                for page in islice(below(file.pages), _MOST_DIRECTORIES)
                if isinstance(page, tifffile.TiffPage)
            ]
    except Exception:  # not a TIFF, or one that only LibRaw understands
        return []
    return sorted(found, key=lambda d: not d.is_mosaic)


def tag_of(tags: list[Directory], code: int) -> Any:
    """The value of a tag in the first directory that has it; None where none does."""
    return next((d.tags[code] for d in tags if code in d.tags), None)


def first_number(tags: list[Directory], *codes: int) -> float | None:
    """A number that a tag states in any directory: writers put Exif's tags into the first one, too."""
    for code in codes:
        value = tag_of(tags, code)
        if value is None:
            continue
        values = np.ravel(value).astype(np.float64)
        number = values[0] / values[1] if len(values) == 2 and isinstance(value, tuple) else values[0]
        if np.isfinite(number) and number > 0:
            return float(number)
    return None


def camera_name(tags: list[Directory]) -> str | None:
    """The name that a DNG gives its camera."""
    unique = tag_of(tags, _UNIQUE_CAMERA)
    return str(unique).strip(" \0") or None if unique else None


def noise_profile(
    path: str | Path, tags: list[Directory], cfa: str
) -> tuple[PerChannel | None, PerChannel | None]:
    """NoiseProfile: one (S, O) for all, or one per colour plane, in mosaic order; None where not given."""
    profile = tag_of(tags, _NOISE_PROFILE)
    if profile is None:
        return None, None
    values = np.ravel(profile).astype(np.float64)
    if values.size % 2:
        _log.warning("%s: NoiseProfile holds %d numbers, not pairs: left out", path, values.size)
        return None, None
    pairs = values.reshape(-1, 2)
    if not (np.isfinite(pairs).all() and (pairs[:, 0] >= 0).all() and (np.abs(pairs) <= MOST_NLF).all()):
        _log.warning("%s: NoiseProfile holds a negative, undefined or endless noise: left out", path)
        return None, None
    if len(pairs) == 1:
        return per_channel(pairs[0, 0]), per_channel(pairs[0, 1])
    if len(pairs) != 3 or cfa == "MONO":
        _log.warning("%s: NoiseProfile holds %d pairs, not one a colour: left out", path, len(pairs))
        return None, None
    order = ["RGB".index(colour) for colour in cfa]
    return per_channel(pairs[order, 0]), per_channel(pairs[order, 1])


def exif_of(path: str | Path) -> dict[str, Any]:
    """Camera name and sensor temperature (°C) where Exif or the maker's notes hold them."""
    try:
        with quiet("exifread"), open(path, "rb") as file:
            tags = exifread.process_file(file, details=True)
    except Exception:
        return {}
    make, model = (str(tags.get(f"Image {name}", "")).strip(" \0") for name in ("Make", "Model"))
    camera = model if model.lower().startswith(make.lower()) else f"{make} {model}"
    known: dict[str, Any] = {"camera": camera.strip() or None}
    for name, value in tags.items():
        if name.endswith(("CameraTemperature", "SensorTemperature")):
            number = str(value).split()[0] if str(value) else ""
            plain = number.removeprefix("-").replace(".", "", 1).isdigit()
            if plain and COLDEST_C <= float(number) <= HOTTEST_C:  # some makers count in a unit of their own
                known["temperature_c"] = float(number)
    return known
