"""SIDD raw folders (Abdelhamed et al. 2018): one folder per scene instance, MAT data and MAT metadata.

`NNNN_SSS_CC_IIIII_EEEEE_TTTT_B/` names instance, scene, camera, ISO, 1 / exposure, illuminant and brightness.
Images are MATLAB v7.3 files (HDF5, dataset `x`, float32, normalised to [0, 1] and clipped), which HDF5 hands
over transposed. Metadata is a MATLAB v5 struct: what `imfinfo` told about the DNG. Frames are put back on the
camera's codes, x (white - black) + black, where that gives whole numbers; else they are x * 65535 rounded,
with `code_step` 0: no claims about codes. The noise-free image is the mean of a burst of 150 frames.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import scipy.io

from cannoise_jax.recordings.hdf5 import check_matlab, check_returns
from cannoise_jax.recordings.lazy import LazyArray, read_stack
from cannoise_jax.recordings.metadata import check_overrides, make_recording, reading
from cannoise_jax.recordings.opened import check_plain
from cannoise_jax.recordings.recording import (
    BadInput,
    CaptureSet,
    PerChannel,
    Recording,
    mosaic_map,
    per_channel,
)

CAMERAS = ("GP", "IP", "S6", "N6", "G4")
"""Google Pixel, iPhone 7, Samsung Galaxy S6 Edge, Motorola Nexus 6, LG G4."""

# Colour order of the images in MATLAB's orientation, as published with the data set.
_CFA = {"GP": "BGGR", "IP": "RGGB", "S6": "GRBG", "N6": "BGGR", "G4": "BGGR"}
_INSTANCE = re.compile(r"(\d{4})_(\d{3})_([A-Z0-9]{2})_(\d{5})_(\d{5})_\d{4}_[LNH]")
_NOISE_PROFILE, _CFA_PATTERN = 51041, 33422
_BURST_FRAMES = 150
_log = logging.getLogger(__name__)


class _Scale(NamedTuple):
    black: PerChannel
    white: float
    whole: bool  # whether values must come out as whole numbers


_STORED = _Scale((0.0, 0.0, 0.0, 0.0), 65535.0, False)


def is_instance(folder: Path) -> bool:
    """Whether a folder is one scene instance of SIDD, by its name."""
    return folder.is_dir() and _INSTANCE.fullmatch(folder.name) is not None


def scene_id(recording: Recording) -> str:
    """Three digits of the scene, "001" to "010": what train and test sets are split by. Raises BadInput."""
    match = _INSTANCE.fullmatch(Path(recording.path or "").name)
    if match is None:
        raise BadInput(f"{recording.path}: not a SIDD folder: its name tells no scene")
    return match[2]


def load_sidd(root: str | Path) -> tuple[CaptureSet, ...]:
    """All instances below a folder, one capture set a camera, in the order of `CAMERAS`. Raises BadInput."""
    folders = sorted(path for path in Path(root).glob("**/") if is_instance(path))
    if not folders:
        raise BadInput(f"{root}: holds no SIDD folders (NNNN_SSS_CC_IIIII_EEEEE_TTTT_B)")
    recordings = [read_sidd(folder) for folder in folders]
    named = sorted({r.camera for r in recordings}, key=lambda c: (*CAMERAS, c).index(c))
    return tuple(
        CaptureSet(camera, tuple(r for r in recordings if r.camera == camera), str(root)) for camera in named
    )


def read_sidd(folder: str | Path, **overrides: Any) -> Recording:
    """A recording from one scene instance: its frames in order, each with its noise-free image as `clean`.

    Pixels are read, transposed and checked when they are indexed. overrides: see `metadata.OVERRIDES`.
    Raises BadInput.
    """
    check_overrides(overrides)
    folder = Path(folder)
    match = _INSTANCE.fullmatch(folder.name)
    if match is None or not folder.is_dir():
        raise BadInput(f"{folder}: not a SIDD folder (NNNN_SSS_CC_IIIII_EEEEE_TTTT_B)")
    noisy = _files(folder, "NOISY")
    if not noisy:
        raise BadInput(f"{folder}: holds no {match[1]}_NOISY_RAW_*.MAT")
    truth = _files(folder, "GT")
    if truth and len(truth) != len(noisy):
        raise BadInput(f"{folder}: holds {len(noisy)} noisy images but {len(truth)} noise-free ones")
    for path in (*noisy, *truth):
        with reading(path, "not a readable MATLAB v7.3 image"):
            check_returns(path)
    about = _metadata(folder)
    cfa = overrides.get("cfa") or _colour_order(folder, about, match[3])
    shot, read = _noise_profile(about, cfa)
    frames, levels = _frames(noisy, about)
    known = {
        "cfa": cfa,
        "camera": match[3],
        "iso": _first(about, "ISOSpeedRatings") or int(match[4]),
        "exposure_s": _first(about, "ExposureTime") or 1 / max(1, int(match[5])),
        "shot": shot,
        "read": read,
        "clean": _images(truth, frames.shape[1:], None) if truth else None,
        "reference": "burst_mean" if truth else None,
        "reference_frames": _BURST_FRAMES if truth else None,
        **levels,
    }
    return make_recording(folder, frames, known, overrides, scan=False)


def _images(paths: tuple[str, ...], size: tuple[int, ...], scale: _Scale | None) -> LazyArray:
    """MAT images stacked on a first axis in MATLAB's orientation, `[T, H, W]`; read whole when indexed.

    Normalised float32 as stored, or uint16 by `scale`.
    """
    shape = (len(paths), *size)
    read = partial(_read_image, paths=paths, size=size, scale=scale)
    return LazyArray(partial(read_stack, read, shape), shape, np.dtype(np.uint16 if scale else np.float32))


def _read_image(
    number: int, *, paths: tuple[str, ...], size: tuple[int, ...], scale: _Scale | None
) -> np.ndarray:
    values = _read_mat(paths[number])
    if values.shape != size:
        found, others = ("{} x {}".format(*shape) for shape in (values.shape, size))
        raise BadInput(f"{paths[number]}: {found} pixels, the other images {others}")
    if scale is None:
        return values
    codes = _codes(values, scale)
    if codes is None:
        raise BadInput(f"{paths[number]}: values are not the codes of the metadata's black and white level")
    return codes


def _read_mat(path: str) -> np.ndarray:
    with reading(path, "not a readable MATLAB v7.3 image"), h5py.File(path, "r") as file:
        name = "x" if "x" in file else next(iter(file))
        values = np.asarray(file[name], np.float32)
    if values.ndim != 2:
        raise BadInput(f"{path}: image has shape {values.shape}: expected rows x columns")
    if not np.isfinite(values).all():
        raise BadInput(f"{path}: holds {np.count_nonzero(~np.isfinite(values))} NaN or infinite values")
    if values.min() < 0 or values.max() > 1:
        raise BadInput(f"{path}: values from {values.min():g} to {values.max():g}: expected 0 to 1")
    return np.ascontiguousarray(values.T)  # MATLAB stores columns first


def _codes(values: np.ndarray, scale: _Scale) -> np.ndarray | None:
    """The codes that normalise to `values`, or None where they are not whole numbers but should be.

    Tolerance: eight float32 roundings of the largest value, at least 0.01; a value between codes would be
    off by up to a half.
    """
    levels = mosaic_map(scale.black, values.shape[-2:]).astype(np.float64)
    exact = values * (scale.white - levels) + levels
    codes = np.rint(exact)
    inside = (values > 0) & (values < 1)  # 0 and 1 were clipped and may stand for a fractional level
    off = np.abs(exact - codes)[inside]
    if scale.whole and off.size and off.max() > max(0.01, 8 * scale.white * np.finfo(np.float32).eps):
        return None
    return codes.astype(np.uint16)


def _files(folder: Path, kind: str) -> tuple[str, ...]:
    pattern = re.compile(rf"{folder.name[:4]}_{kind}_RAW_\d+\.mat", re.IGNORECASE)
    found = [p for p in sorted(folder.iterdir()) if pattern.fullmatch(p.name)]
    for path in found:
        check_plain(path, "replace or remove it")
    return tuple(map(str, found))


def _frames(noisy: tuple[str, ...], about: Any) -> tuple[LazyArray, dict[str, Any]]:
    """The frames on the camera's codes where the first one fits them, and the levels that go with them."""
    first = _read_mat(noisy[0])
    black, white = _numbers(about, "BlackLevel"), _numbers(about, "WhiteLevel")
    if black is not None and white is not None:
        scale = _Scale(per_channel(black if black.size == 4 else black[:1]), float(white.max()), True)
        if max(scale.black) < scale.white <= _STORED.white and _codes(first, scale) is not None:
            return _images(noisy, first.shape, scale), {
                "black_level": scale.black,
                "white_level": scale.white,
            }
    return _images(noisy, first.shape, _STORED), {
        "black_level": _STORED.black,
        "white_level": _STORED.white,
        "code_step": 0.0,
    }


def _metadata(folder: Path) -> Any:
    """The metadata of the first frame as nested dicts and lists; empty where the folder holds none."""
    paths = _files(folder, "METADATA")
    if not paths:
        return {}
    with reading(paths[0], "not a readable MATLAB v5 file"):
        check_matlab(paths[0])
        return scipy.io.loadmat(paths[0], simplify_cells=True).get("metadata", {})


def _walk(node: Any) -> Iterator[dict]:
    """Every struct of the metadata, outer ones first: fields may sit in nested directories."""
    if isinstance(node, dict):
        yield node
        for value in node.values():
            yield from _walk(value)
    elif isinstance(node, (list, tuple)) or (isinstance(node, np.ndarray) and node.dtype == object):
        for value in node:
            yield from _walk(value)


def _numbers(about: Any, name: str) -> np.ndarray | None:
    """The first field of this name that is not empty."""
    for node in _walk(about):
        values = node.get(name)
        if isinstance(values, (int, float, np.ndarray)) and np.size(values):
            return np.ravel(values).astype(np.float64)
    return None


def _first(about: Any, name: str) -> float | None:
    values = _numbers(about, name)
    return None if values is None else float(values[0])


def _tag(about: Any, code: int) -> np.ndarray | None:
    """The value of a TIFF tag that MATLAB did not know, by number, wherever it is."""
    for node in _walk(about):
        if (
            np.size(node.get("ID", ())) == 1
            and np.ravel(node["ID"])[0] == code
            and np.size(node.get("Value", ()))
        ):
            return np.ravel(node["Value"]).astype(np.float64)
    return None


def _colour_order(folder: Path, about: Any, camera: str) -> str | None:
    published, tag = _CFA.get(camera), _tag(about, _CFA_PATTERN)
    if tag is None or tag.size != 4:
        return published
    stated = "".join("RGB"[int(c)] if c in (0, 1, 2) else "?" for c in tag)
    if published is not None and stated != published:
        _log.warning("%s: metadata say %s, the data set's table %s for %s", folder, stated, published, camera)
    return stated


def _noise_profile(about: Any, cfa: str | None) -> tuple[PerChannel | None, PerChannel | None]:
    """Variance coefficients in mosaic order: one pair for all, or one for each of red, green and blue."""
    profile = _tag(about, _NOISE_PROFILE)
    if profile is None or cfa is None or profile.size not in (2, 6):
        return None, None
    pairs = profile.reshape(-1, 2)
    order = [
        "RGB".index(c) if len(pairs) == 3 and c in "RGB" else 0 for c in (cfa if cfa != "MONO" else "RRRR")
    ]
    return per_channel(pairs[order, 0]), per_channel(pairs[order, 1])
