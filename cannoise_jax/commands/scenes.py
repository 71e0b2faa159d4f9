"""Clean mosaics for simulation: flats and darks of any size, pictures, arrays, and recordings' own."""

from __future__ import annotations

import struct
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cannoise_jax.recordings.opened import BROKEN_ARRAYS, check_claim
from cannoise_jax.recordings.recording import BadInput, Kind

_PICTURES = (".png", ".tif", ".tiff", ".jpg", ".jpeg")
_SUFFIXES = (*_PICTURES, ".npy", ".h5")


class Clean(NamedTuple):
    """A noise-free mosaic, normalised, and the name under which its recording is stored."""

    name: str
    kind: Kind
    values: Float[np.ndarray, "h w"]


def scenes(text: str, cfa: str, size: tuple[int, int]) -> list[Clean]:
    """The clean mosaics that `--clean` names, all read and checked before anything is written."""
    if text == "dark":
        return [Clean("dark", "dark", np.zeros(size, np.float32))]
    if text.startswith("flat:"):
        try:
            level = float(text.removeprefix("flat:"))
        except ValueError:
            level = float("nan")
        if not 0 <= level <= 1:
            raise BadInput(f"--clean {text}: write flat:LEVEL with a level from 0 to 1, as flat:0.2")
        return [Clean(f"flat_{level:g}", "flat", np.full(size, level, np.float32))]
    path = Path(text)
    if path.is_dir():
        files = sorted(p for p in path.iterdir() if p.suffix.lower() in _SUFFIXES)
        if not files:
            raise BadInput(f"{path}: holds no clean pictures: put {', '.join(_SUFFIXES)} files there")
        named = [_scene(p, cfa) for p in files]
        if len({c.name for c in named}) < len(named):
            raise BadInput(f"{path}: two pictures share a name: their recordings would overwrite each other")
        return named
    if not path.is_file():
        raise BadInput(f"{path}: no such file: name a picture, a folder, flat:LEVEL or dark")
    return [_scene(path, cfa)]


def _scene(path: Path, cfa: str) -> Clean:
    """One clean mosaic of a file: linear values 0 to 1 as [H, W] or RGB [H, W, 3] in .npy; the `clean` of a
    native recording; a picture of 8 bits, taken for sRGB, or of 16 bits, taken for linear."""
    suffix = path.suffix.lower()
    if suffix not in _SUFFIXES:
        raise BadInput(f"{path}: not a clean picture: use {', '.join(_SUFFIXES)}")
    if suffix == ".h5":
        from cannoise_jax.recordings.native import read_recording

        recording = read_recording(path)
        if recording.clean is None:
            raise BadInput(f"{path}: holds no clean image: use a recording with one")
        if recording.cfa != cfa:
            raise BadInput(f"{path}: is {recording.cfa} and the sensor {cfa}: use a scene of the same mosaic")
        values = np.asarray(recording.clean[0] if recording.clean.ndim == 3 else recording.clean)
    else:
        values = _array(path, suffix)
    if values.ndim == 3 and values.shape[2] in (3, 4):
        from cannoise_jax.physics.synthetic.scenes import mosaic

        values = mosaic(values[..., :3], cfa)
    if values.ndim != 2 or min(values.shape) < 2:
        raise BadInput(f"{path}: has shape {values.shape}: use [H, W], or [H, W, 3] in colour")
    if not np.isfinite(values).all() or values.min() < -0.05 or values.max() > 1.5:
        raise BadInput(f"{path}: values must be finite and from 0 (black) to 1 (white)")
    return Clean(path.stem, "scene", np.ascontiguousarray(values, np.float32))


def _array(path: Path, suffix: str) -> np.ndarray:
    try:
        if suffix == ".npy":
            values = np.load(path, allow_pickle=False)
            if np.iscomplexobj(values):
                raise BadInput(f"{path}: holds complex numbers: use real values from 0 to 1")
            return np.asarray(values, np.float32)
        picture = _picture(path, suffix)
    except (*BROKEN_ARRAYS, struct.error) as error:
        if isinstance(error, BadInput):
            raise
        raise BadInput(f"{path}: cannot be read as a picture: {error}") from error
    if picture.dtype == np.uint8:
        encoded = picture.astype(np.float32) / 255
        return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    if picture.dtype == np.uint16:
        return picture.astype(np.float32) / 65535
    return np.asarray(picture, np.float32)


def _picture(path: Path, suffix: str) -> np.ndarray:
    """The pixels of a picture whose size was looked at first."""
    from PIL import Image
    from skimage.io import imread

    if suffix not in (".tif", ".tiff"):
        from cannoise_jax.recordings.opened import any_size

        with warnings.catch_warnings(), any_size(), Image.open(path) as image:
            check_claim(path, (image.height, image.width), 1)
    else:
        import tifffile

        from cannoise_jax.recordings.tiff_chain import check_chain

        check_chain(path)
        with tifffile.TiffFile(path) as file:
            for page in file.pages:
                check_claim(path, page.shape[:2], page.dtype.itemsize if page.dtype else 1)
    return imread(path)
