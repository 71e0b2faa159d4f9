"""Any supported file or folder into a `Recording`, and a folder of them into a `CaptureSet`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from cannoise_jax.recordings import camera_raw, fits, native, sidd, stacks
from cannoise_jax.recordings.metadata import check_overrides
from cannoise_jax.recordings.recording import BadInput, CaptureSet, Recording

_READERS: dict[str, Callable[..., Recording]] = {
    **dict.fromkeys((".h5", ".hdf5", ".hdf"), native.read_recording),
    **dict.fromkeys(fits.SUFFIXES, fits.read_fits),
    **dict.fromkeys(stacks.TIFF_SUFFIXES, stacks.read_tiff),
    **dict.fromkeys(stacks.NUMPY_SUFFIXES, stacks.read_numpy),
    **dict.fromkeys(camera_raw.SUFFIXES, camera_raw.read_camera_raw),
}


def supported() -> str:
    """The suffixes of all formats that can be read."""
    return ", ".join(sorted(_READERS))


def load_recording(path: str | Path, **overrides: Any) -> Recording:
    """A recording from a file of any supported format (or a SIDD instance folder).

    overrides: see `metadata.OVERRIDES`. Raises BadInput for a file that cannot be used.
    """
    check_overrides(overrides)
    path = Path(path)
    if not path.exists():
        raise BadInput(f"{path}: no such file")
    if path.is_dir():
        return sidd.read_sidd(path, **overrides)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise BadInput(f"{path}: unknown format {path.suffix!r}: supported are {supported()}")
    return reader(path, **overrides)


def recording_paths(folder: str | Path) -> list[Path]:
    """The recordings of a folder, by suffix, sorted by name. Raises BadInput when there is none."""
    folder = Path(folder)
    if not folder.is_dir():
        raise BadInput(f"{folder}: no such folder")
    paths = sorted(p for p in folder.iterdir() if _is_recording(p))
    if not paths:
        raise BadInput(f"{folder}: holds no recordings: supported are {supported()}")
    return paths


def load_capture_set(folder: str | Path, **overrides: Any) -> CaptureSet:
    """All recordings of a folder, sorted by name; files of other formats (side-cars, notes) are passed over.

    overrides apply to every recording. Raises BadInput when one of them cannot be used, when there is none,
    or when they name more than one camera.
    """
    recordings = tuple(load_recording(p, **overrides) for p in recording_paths(folder))
    cameras = sorted({r.camera for r in recordings})
    if len(cameras) > 1:
        raise BadInput(f"{folder}: holds {len(cameras)} cameras ({', '.join(cameras)}): one folder a camera")
    return CaptureSet(cameras[0], recordings, str(folder))


def _is_recording(path: Path) -> bool:
    named = path.suffix.lower() in _READERS and not path.name.startswith(".")
    return (named and path.is_file()) or sidd.is_instance(path)
